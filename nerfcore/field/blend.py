"""The blend weight w of the explicit branch: near 1 where the grid has evidence, w₀ where nothing was seen."""

from __future__ import annotations

import torch
from torch import nn

from ..config import FieldConfig
from ..kernels import cells
from ..kernels.device import on_host
from ..kernels.inputs_host import blend_weights

RESOLUTION = 64  # cells along a side of the grid of evidence; not tuned
SHOWN = 1e-4  # evidence of cells that photos show


class BlendWeight(nn.Module):
    """w(x) = w₀ + (1 − w₀)(1 − exp(−κ E(x))), E trilinear in a grid of evidence (method: exponential moving average
    of rendering weight × share of views that saw the cell). With `blend_by="density"` E holds the moving average of
    the density instead and w₀ is 0, the original formulation."""

    def __init__(self, config: FieldConfig) -> None:
        super().__init__()
        self.floor = config.blend_floor if config.blend_by == "evidence" else 0.0
        self.rate = config.blend_rate if config.blend_by == "evidence" else config.blend_rate * 0.01
        self.by = config.blend_by
        self.warming_up = False
        self.register_buffer("evidence", torch.zeros(RESOLUTION**3))
        self.register_buffer("views", torch.ones(RESOLUTION**3))
        self.evidence: torch.Tensor
        self.views: torch.Tensor

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        """w (N,) in [0, 1], detached, for points (N, 3) in [0, 1]³."""
        if self.warming_up:
            return torch.ones(len(points), device=points.device)
        with torch.no_grad():
            if on_host(points.device):
                return blend_weights(self.evidence, RESOLUTION, points, self.floor, self.rate)
            evidence = cells.trilinear(self.evidence, RESOLUTION, points)
            return 1 - (1 - self.floor) * torch.exp(-self.rate * evidence)

    @torch.no_grad()
    def shown(self, resolution: int) -> torch.Tensor | None:
        """Cells (resolution³,) bool, x fastest, in which samples of training rays had weight; None where that is not known."""
        if self.by != "evidence":
            return None
        axis = torch.arange(resolution, device=self.evidence.device) * RESOLUTION // resolution
        seen = (self.evidence > SHOWN).view(RESOLUTION, RESOLUTION, RESOLUTION)
        return seen[axis][:, axis][:, :, axis].flatten()

    @torch.no_grad()
    def update(self, points: torch.Tensor, weights: torch.Tensor, density: torch.Tensor, decay: float = 0.9) -> None:
        """Take in one batch: points (N, 3), rendering weights (N,), densities (N,)."""
        value = weights if self.by == "evidence" else density
        fresh = cells.scatter_max(RESOLUTION, points, value.detach())
        target = fresh * self.views if self.by == "evidence" else fresh
        self.evidence.copy_(torch.where(fresh > 0, decay * self.evidence + (1 - decay) * target, self.evidence))
