"""Training of a field's semantic head alone."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
import torch

from ..field.hybrid import HybridField
from ..progress import Reporter

# Not tuned:
BATCH = 4096  # surfels a step
RATE = 3e-3
JITTER = 0.001  # deviation of places around a surfel, of the grid's side: rays sample beside the surface too
LEAST_STEPS, MOST_STEPS = 300, 3000  # the least also where a busy machine has no time for them


@dataclass(frozen=True)
class Learned:
    """How a head was trained, and the class index (N,) it gives to each surfel."""

    steps: int
    seconds: float
    predicted: np.ndarray


def train_head(
    field: HybridField, position: np.ndarray, target: np.ndarray, seconds: float, report: Reporter
) -> Learned:
    """Train the semantic head of a field on points (N, 3) of the grid with soft labels (N, K), for some seconds, but no less
    than `LEAST_STEPS`; nothing else of the field changes. The loss is the cross-entropy.

    Raises:
        Cancelled.
    """
    assert field.semantic_head is not None
    device = next(field.semantic_head.parameters()).device
    place, wanted = torch.from_numpy(position).to(device), torch.from_numpy(target).to(device)
    generator = torch.Generator().manual_seed(0)
    optimizer = torch.optim.Adam(field.semantic_head.parameters(), RATE)
    begin, steps = time.perf_counter(), 0
    while (done := share_done((time.perf_counter() - begin) / seconds, steps)) < 1:
        report.progress(done, f"step {steps}")
        for group in optimizer.param_groups:
            group["lr"] = RATE * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * done)))
        chosen = torch.randint(len(place), (min(BATCH, len(place)),), generator=generator).to(device)
        beside = torch.randn(len(chosen), 3, generator=generator).to(device) * JITTER
        with torch.no_grad():
            geometry = field.geometry((place[chosen] + beside).clamp(0, 1))
        loss = torch.nn.functional.cross_entropy(field.logits(geometry), wanted[chosen])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        steps += 1
    found = []
    with torch.no_grad():
        for part in place.split(BATCH):
            report.check()
            found.append(field.logits(field.geometry(part)).argmax(1).cpu())
    return Learned(steps, time.perf_counter() - begin, torch.cat(found).numpy())


def share_done(time_share: float, steps: int) -> float:
    """How far a training is, 1 at its end, by the share of its time that went by and its steps."""
    return min(max(time_share, steps / MOST_STEPS), steps / LEAST_STEPS)
