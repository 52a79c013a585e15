"""Training of a field's semantic head alone."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from ..field.hybrid import Geometry, HybridField
from ..progress import Reporter

# Not tuned:
BATCH = 4096  # surfels a step
RATE = 1e-2
POOL, PASSES = 1 << 18, 8  # surfels that the field is read at together, and how often each serves until it is read anew
JITTER = 0.001  # deviation of places around a surfel, of the grid's side: rays sample beside the surface too
MARGIN = 0.5  # by which the logit of the class that is shown is to lead, at most: unsure targets lead by less
LEAST_STEPS, MOST_STEPS = 300, 6000  # the least also where a busy machine has no time for them


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
    than `LEAST_STEPS`; nothing else of the field changes. The loss is the cross-entropy, and that of `lost_lead`.

    Raises:
        Cancelled.
    """
    assert field.semantic_head is not None
    device = next(field.semantic_head.parameters()).device
    place, wanted = torch.from_numpy(position).to(device), torch.from_numpy(target).to(device)
    optimizer = torch.optim.Adam(field.semantic_head.parameters(), RATE)
    some = batches(field, place, wanted)
    begin, steps = time.perf_counter(), 0
    while (done := share_done((time.perf_counter() - begin) / seconds, steps)) < 1:
        report.progress(done, f"step {steps}")
        for group in optimizer.param_groups:
            group["lr"] = RATE * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * done)))
        geometry, soft = next(some)
        logits = field.logits(geometry)
        loss = torch.nn.functional.cross_entropy(logits, soft) + lost_lead(logits, soft)
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


def batches(field: HybridField, place: torch.Tensor, wanted: torch.Tensor) -> Iterator[tuple[Geometry, torch.Tensor]]:
    """Without end, what a field knows of places beside some of the surfels (N, 3), and the soft labels of these, of (N, K).

    Reading the field takes longer than a step of training, so what was read serves several times.
    """
    generator = torch.Generator().manual_seed(0)
    while True:
        pool = torch.randperm(len(place), generator=generator)[:POOL]
        beside = torch.randn(len(pool), 3, generator=generator) * JITTER
        pool, beside = pool.to(place.device), beside.to(place.device)
        with torch.no_grad():
            known = field.geometry((place[pool] + beside).clamp(0, 1))
        for _ in range(PASSES):
            for rows in torch.randperm(len(pool), generator=generator).to(place.device).split(BATCH):
                yield known[rows], wanted[pool[rows]]


def lost_lead(logits: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """By how much, in the mean, logits (N, K) fail to let the most probable class of soft labels (N, K) lead: by what it leads
    in these, `MARGIN` at most. 0 where the logits say what the labels do.

    A head cannot learn all of many unsure labels. Cross-entropy alone then gets the shares of unlikely classes right
    rather than which class is the first, which is what is shown (hinge loss: Crammer and Singer, "On the algorithmic
    implementation of multiclass kernel-based vector machines", 2001).
    """
    if target.shape[1] < 2:
        return logits.new_zeros(())
    first, index = target.topk(2, 1)
    lead = (first[:, 0].log() - first[:, 1].clamp(min=1e-6).log()).clamp(max=MARGIN)
    top = index[:, :1]
    others = logits.scatter(1, top, -torch.inf).amax(1)
    return (others - logits.gather(1, top)[:, 0] + lead).clamp(min=0).mean()


def share_done(time_share: float, steps: int) -> float:
    """How far a training is, 1 at its end, by the share of its time that went by and its steps."""
    return min(max(time_share, steps / MOST_STEPS), steps / LEAST_STEPS)
