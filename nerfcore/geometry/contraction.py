"""The map between normalised positions and grid coordinates: all of space into the unit cube where it is contracted
(Barron et al., "Mip-NeRF 360", 2022, eq. 10, with the infinity norm)."""

from __future__ import annotations

import torch


def grid_position(p: torch.Tensor, contracted: bool) -> torch.Tensor:
    """Normalised positions (..., 3) → grid coordinates in [0, 1]³."""
    if not contracted:
        return p * 0.5 + 0.5
    r = p.abs().amax(-1, keepdim=True).clamp(min=1)
    return p * ((2 - 1 / r) / r) * 0.25 + 0.5


def uncontract(u: torch.Tensor) -> torch.Tensor:
    """Inverse of the contraction: grid coordinates (N, 3) in (0, 1)³ → normalised positions."""
    q = (u - 0.5) * 4
    r = q.abs().max(1, keepdim=True).values
    # ‖q‖ = 2 − 1/‖p‖ outside the cube
    return torch.where(r > 1, q / r.clamp(min=1e-9) / (2 - r).clamp(min=1e-4), q)


def thinning(u: torch.Tensor) -> torch.Tensor:
    """By how much contracted space is shorter than space at grid coordinates (N, 3), (N,): 1 in the cube, 1 / r² where
    the largest coordinate is r > 1. A density that is multiplied by it is one of grid lengths: what it has outside of
    the cube stays transparent unless the field means it, though space has no end there."""
    return (2 - 4 * (u - 0.5).abs().amax(-1)).clamp(0, 1).square()


def horizon(directions: torch.Tensor) -> torch.Tensor:
    """Grid coordinates (N, 3) on the border of the unit cube, where rays with these directions (N, 3) end: infinitely
    far away where space is contracted, whatever their origin."""
    return (directions / directions.abs().amax(-1, keepdim=True) * 0.5 + 0.5).clamp(0, 1)
