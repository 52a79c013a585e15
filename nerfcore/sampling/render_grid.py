"""The grid that rays traverse when a trained field is rendered: the occupancy grid's occupied cells, cut finer and read anew.

Fewer of its cells are occupied, and their densities are nearer to what a ray meets, so that a picture needs fewer samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch

from ..kernels.cells import MOST_CELLS_A_SIDE
from ..kernels.runtime import run_parallel
from ..kernels.traversal import MarchSettings, skip_distances
from .occupancy import OccupancyGrid

PROBES = 4  # points read in each fine cell; not tuned
SAVED = 8  # samples that a pixel needs less with it, about; not tuned
CHUNK = 1 << 14


@dataclass(frozen=True)
class RenderGrid:
    """What rays traverse: cells (resolution³, 2) and skip_distance as `kernels.march.sample` takes them, and the settings."""

    cells: torch.Tensor
    skip_distance: torch.Tensor
    settings: MarchSettings


def present_grid(occupancy: OccupancyGrid, per_bin: float) -> RenderGrid:
    """The occupancy grid as it is."""
    settings = replace(occupancy.march_settings(), per_bin=per_bin)
    return RenderGrid(occupancy.cells, occupancy.skip_distance, settings)


def largest_factor(resolution: int, factor: int) -> int:
    """How many times finer a grid may be made, at most `factor`: kernels number its cells in 32 bits."""
    while factor > 1 and resolution * factor > MOST_CELLS_A_SIDE:
        factor //= 2
    return factor


@torch.no_grad()
def refined_grid(
    occupancy: OccupancyGrid,
    density: Callable[[torch.Tensor], torch.Tensor],
    factor: int,
    per_bin: float,
    pixels: float,
    check: Callable[[], None] | None = None,
) -> RenderGrid | None:
    """Every occupied cell cut into factor³, of which those stay occupied where `density` (points (N, 3) in grid coordinates →
    (N,), per normalised unit length) is not negligible at one of a few random points; their mean is the density.

    None where reading the cells takes longer than it saves in rendering so many `pixels`.
    `check` is called often, on the CPU by several threads, and may raise to stop.
    """
    factor = largest_factor(occupancy.config.resolution, factor)
    coarse = (occupancy.cells[:, 0] > 0).nonzero()[:, 0]
    if factor == 1 or len(coarse) * factor**3 * PROBES > pixels * SAVED:
        return None
    device, n = coarse.device, occupancy.config.resolution
    axis = torch.arange(factor, device=device)
    part = torch.cartesian_prod(axis, axis, axis)
    corner = torch.stack([coarse % n, coarse // n % n, coarse // (n * n)], 1)
    fine = (corner[:, None] * factor + part).view(-1, 3)
    generator = torch.Generator(device).manual_seed(0)  # the same picture every time
    side = n * factor
    largest, mean = (torch.zeros(len(fine), device=device) for _ in range(2))

    @torch.no_grad()
    def read(points: torch.Tensor) -> torch.Tensor:
        if check is not None:
            check()
        return density(points)

    for _ in range(PROBES):
        points = (fine + torch.rand(fine.shape, device=device, generator=generator)) / side
        fresh = torch.cat(run_parallel([partial(read, some) for some in points.split(CHUNK)], device))
        mean += fresh / PROBES
        torch.maximum(largest, fresh, out=largest)
    step = occupancy.step / factor
    row = (fine[:, 2] * side + fine[:, 1]) * side + fine[:, 0]
    occupied = largest * step > occupancy.config.threshold
    cells = torch.zeros(side**3, 2, device=device)
    cells[row, 0] = torch.where(occupied, mean.clamp(1e-3, occupancy.config.optical_depth / step), 0.0)
    cells[row, 1] = occupancy.importance[coarse].repeat_interleave(factor**3)
    settings = replace(occupancy.march_settings(), per_bin=per_bin, resolution=side, step=step)
    return RenderGrid(cells, skip_distances((cells[:, 0] > 0).view(side, side, side)), settings)
