"""Torch backend of `surface.py`: depths of rays."""

from __future__ import annotations

import math

import torch

from .composite_torch import rows_of_rays
from .packed_info import PackedInfo


def depth_quantiles(
    density: torch.Tensor, deltas: torch.Tensor, t: torch.Tensor, packed_info: PackedInfo
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """As `surface.depth_quantiles`."""
    if not len(density):
        nothing = torch.zeros(len(packed_info.starts), device=density.device)
        return nothing, nothing, nothing, nothing
    own, _, _ = rows_of_rays(density * deltas, packed_info)
    begin, _, _ = rows_of_rays(t - deltas / 2, packed_info)
    slope, _, _ = rows_of_rays(density, packed_info)
    after = torch.cumsum(own, 1)
    before = after - own
    found = []
    for share in (0.75, 0.5, 0.25):
        level = -math.log(share)
        inside = (before < level) & (after >= level)
        found.append(torch.where(inside, begin + (level - before) / slope.clamp(min=1e-30), 0.0).amax(1))
    near, middle, far = found
    return near, middle, far, 1 - torch.exp(-own.sum(1))
