"""The map between normalised positions and grid coordinates: all of space into the unit cube where it is contracted
(Barron et al., "Mip-NeRF 360", 2022, eq. 10, with the infinity norm)."""

from __future__ import annotations

import torch


def grid_position(p: torch.Tensor, contracted: bool) -> torch.Tensor:
    """Normalised positions (..., 3) → grid coordinates in [0, 1]³."""
    if not contracted:
        return p * 0.5 + 0.5
    r = p.abs().amax(-1, keepdim=True)
    return torch.where(r > 1, p * ((2 - 1 / r.clamp(min=1)) / r.clamp(min=1)), p) * 0.25 + 0.5


def uncontract(u: torch.Tensor) -> torch.Tensor:
    """Inverse of the contraction: grid coordinates (N, 3) in (0, 1)³ → normalised positions."""
    q = (u - 0.5) * 4
    r = q.abs().max(1, keepdim=True).values
    # ‖q‖ = 2 − 1/‖p‖ outside the cube
    return torch.where(r > 1, q / r.clamp(min=1e-9) / (2 - r).clamp(min=1e-4), q)
