"""The field of S-NeRF++: a hash grid with a semantic head. Its pipeline for street data (foreground objects, LiDAR and
depth completion, generated views) is no part of a field and not here.

Source: Chen et al., “S-NeRF++: Autonomous Driving Simulation via Neural Reconstruction and Generation”, 2024, section 3.
"""

from __future__ import annotations

import torch

from ...data.pixels import Batch
from ...field.mlp import MLP
from .instant_ngp import BETAS, EPSILON, GEOMETRY, NETWORK_DECAY, RATE, WIDTH, InstantNGP
from .method import Setup
from .semantic_nerf import WEIGHT, logits_loss


class SNeRFPP(InstantNGP):
    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self.semantic = MLP(GEOMETRY, setup.classes, WIDTH, layers=3).to(setup.device)
        self.optimizer = torch.optim.Adam(self.network_parameters(), RATE, BETAS, EPSILON, weight_decay=NETWORK_DECAY)

    def logits(self, points: torch.Tensor, raw: torch.Tensor) -> torch.Tensor:
        return self.semantic(raw, self.dtype).float()

    def label_loss(self, logits: torch.Tensor | None, batch: Batch) -> torch.Tensor:
        assert logits is not None
        return WEIGHT * logits_loss(logits, batch.label)
