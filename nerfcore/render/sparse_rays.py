"""Some of the rays of pictures: enough to tell which cells of a grid the pictures need."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch

from ..data.camera_rays import CameraRays
from ..geometry.cameras import Camera

# Not tuned.
STRIDE = 4  # pixels between the rays, at least
MOST_RAYS = 1 << 18  # of all pictures together, about


def sparse_pixels(width: int, height: int, stride: int, device: torch.device) -> torch.Tensor:
    """Every `stride`-th pixel of every `stride`-th row, as (N, 2) columns and rows."""
    x = torch.arange(min(stride // 2, width - 1), width, stride, device=device)
    y = torch.arange(min(stride // 2, height - 1), height, stride, device=device)
    return torch.cartesian_prod(y, x).flip(1)


def stride_of(pixels: float) -> int:
    """How far apart rays of pictures with so many pixels are."""
    return max(STRIDE, math.ceil(math.sqrt(pixels / MOST_RAYS)))


def sparse_rays(
    cameras: Sequence[Camera], poses: np.ndarray, device: torch.device
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Origins and directions (R, 3) of each camera (pose (4, 4) in the normalised frame)."""
    rays = CameraRays(list(cameras), poses, device, budget=0)
    stride = stride_of(sum(camera.width * camera.height for camera in cameras))
    for number, camera in enumerate(cameras):
        pixels = sparse_pixels(camera.width, camera.height, stride, device)
        pixel = pixels[:, 1] * camera.width + pixels[:, 0]
        origins, directions = rays(torch.full_like(pixel, number), pixel)
        sees = ~directions[:, 0].isnan()
        yield origins[sees].contiguous(), directions[sees].contiguous()
