"""Semantic-NeRF: NeRF with a semantic head that does not see the view direction; logits are composited.

Source: Zhi et al., “In-Place Scene Labelling and Understanding with Implicit Scene Representation”, 2021, eq. 4 to 6.
"""

from __future__ import annotations

import torch
from torch.nn.functional import cross_entropy

from ...data.pixels import VOID, Batch
from .method import Setup
from .nerf import Composited, NeRF

WEIGHT = 0.04


def logits_loss(logits: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
    """Cross-entropy of composited logits (R, K) with class indices (R,); void is left out, 0 where all is void."""
    known = labels != VOID
    total = cross_entropy(logits, labels.where(known, torch.zeros_like(labels)), reduction="none")
    return (total * known).sum() / known.sum().clamp(min=1)


class SemanticNeRF(NeRF):
    def __init__(self, setup: Setup) -> None:
        super().__init__(setup, classes=setup.classes)

    def loss_of(self, composited: Composited, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
        loss, mse = super().loss_of(composited, batch)
        assert composited.logits is not None
        return loss + WEIGHT * logits_loss(composited.logits, batch.label), mse
