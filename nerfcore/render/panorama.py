"""The environment of a run as one equirectangular picture, for what renders without the field."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from ..field.environment import EnvironmentRays
from ..kernels.voxel_field import VoxelRays
from .model import Model

HEIGHT = 1024  # pixels from pole to pole, 0.18° each; not tuned
CHUNK = 1 << 16


@torch.no_grad()
def panorama(model: Model, check: Callable[[], None], height: int = HEIGHT) -> np.ndarray:
    """The environment of a model that has one: (H, 2H, 4) uint8, sRGB and class index + 1, 0 where it is void. The middle
    of the picture looks along x of the normalised frame, its left quarter along y, and its top along z."""
    assert model.environment is not None
    pixels = []
    for part in _directions(height).to(model.device).split(CHUNK):
        check()
        seen = model.environment.rays(model.field, part, torch.ones_like(part[:, 0]))
        index = torch.zeros_like(part[:, :1])
        if seen.probabilities is not None:
            likely, best = seen.probabilities.max(1)
            index[:, 0] = torch.where(likely > 0, best + 1, 0)
        pixels.append(torch.cat([(seen.color * 255).round(), index], 1).to(torch.uint8).cpu())
    return torch.cat(pixels).view(height, 2 * height, 4).numpy()


def _directions(height: int) -> torch.Tensor:
    """Unit directions (2H², 3) of the pixels' centres, row by row."""
    elevation = (0.5 - (torch.arange(height) + 0.5) / height) * torch.pi
    turn = (0.5 - (torch.arange(2 * height) + 0.5) / (2 * height)) * 2 * torch.pi
    elevation, turn = torch.meshgrid(elevation, turn, indexing="ij")
    flat = elevation.cos()
    return torch.stack([flat * turn.cos(), flat * turn.sin(), elevation.sin()], -1).reshape(-1, 3)


class Panorama:
    """A picture that `panorama` made, read by directions.

    Args:
        picture: (H, 2H, 4) uint8. classes: number of them.
    """

    def __init__(self, picture: np.ndarray, classes: int, device: torch.device) -> None:
        self.classes = classes
        # A column of the other side at both ends: it goes on there.
        closed = np.concatenate([picture[:, -1:], picture, picture[:, :1]], 1)
        self.pixels = torch.from_numpy(closed).permute(2, 0, 1)[None].float().to(device)

    def behind(self, directions: torch.Tensor, rays: VoxelRays) -> EnvironmentRays:
        """What is behind a baked field that rays (R,) with these directions (R, 3) have met."""
        width = self.pixels.shape[3]
        turn = torch.atan2(directions[:, 1], directions[:, 0])
        elevation = torch.asin(directions[:, 2].clamp(-1, 1))
        # −1 and 1 are the outer edges of the picture with its added columns.
        place = torch.stack([-turn / torch.pi * (width - 2) / width, -elevation / torch.pi * 2], 1)[None, None]
        read = torch.nn.functional.grid_sample
        color = read(self.pixels[:, :3], place, padding_mode="border", align_corners=False)[0, :, 0].T / 255
        index = read(self.pixels[:, 3:], place, mode="nearest", padding_mode="border", align_corners=False)
        probabilities = None
        if self.classes:
            probabilities = torch.nn.functional.one_hot(index[0, 0, 0].long(), self.classes + 1)[:, 1:].float()
        return EnvironmentRays(color, probabilities, 1 - rays.opacity)
