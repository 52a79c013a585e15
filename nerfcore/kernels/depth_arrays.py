"""Depth maps as kernels read them."""

from __future__ import annotations

from dataclasses import dataclass

import torch

FREE = 1e30  # depth of a ray that meets nothing


@dataclass(frozen=True)
class MapArrays:
    """V depth maps in one frame, P pixels together.

    depth (P,); cosine (P,) of the angle between ray and surface normal; spread (P,) between transmittance 3/4 and 1/4
    along the axis; certain (P,) 1 where the depth's slope can be relied on, else 0; first (V,) int32 first pixel of a map;
    size (V, 2) int32 width and height; lens (V, 4) fx, fy, cx, cy; rotation (V, 3, 3) and translation (V, 3): camera axes
    from the frame.
    """

    depth: torch.Tensor
    cosine: torch.Tensor
    spread: torch.Tensor
    certain: torch.Tensor
    first: torch.Tensor
    size: torch.Tensor
    lens: torch.Tensor
    rotation: torch.Tensor
    translation: torch.Tensor

    def __len__(self) -> int:
        return len(self.first)
