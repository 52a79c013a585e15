"""The grid that rays traverse when a trained field is rendered: the occupancy grid's occupied cells, cut finer and read anew.

Fewer of its cells are occupied, and their densities are nearer to what a ray meets, so that a picture needs fewer samples.
`met_cells` tells which cells a picture needs; `read_fine` reads the field there, `refined_grid` makes the grid of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial

import torch

from ..kernels.cells import MOST_CELLS_A_SIDE
from ..kernels.march import sample
from ..kernels.runtime import run_parallel
from ..kernels.traversal import MarchSettings, skip_distances
from .occupancy import OccupancyGrid

# One point is read in each of these octants of a fine cell: each half of it has two of them.
OCTANTS = ((0, 0, 0), (1, 1, 0), (1, 0, 1), (0, 1, 1))
PROBES = len(OCTANTS)
SAVED = 3  # reads of the field that a pixel needs less with it; 0.5 to 3 were measured
LARGEST_HALF = 65504.0  # of float16
CHUNK = 1 << 14
OFFSETS, SPREAD = 1 << 16, 40503  # places within cells, and an odd number that scatters neighbours among them
MET_SAMPLES, MET_PER_BIN = 16, 1.25  # of rays that ask for cells; not tuned


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


@dataclass(frozen=True)
class FineDensity:
    """What was read of the field in finer cells: `coarse` (C,) int32 rising, the occupied cells that were cut, `density` (C,
    factor³) float16 per normalised unit length, 0 where a finer cell is empty; x runs slowest within a cell."""

    coarse: torch.Tensor
    density: torch.Tensor

    def with_more(self, other: FineDensity) -> FineDensity:
        """Both, which have no cell in common."""
        coarse, order = torch.cat([self.coarse, other.coarse]).sort()
        return FineDensity(coarse, torch.cat([self.density, other.density])[order])


@torch.no_grad()
def met_cells(occupancy: OccupancyGrid, rays: Iterable[tuple[torch.Tensor, torch.Tensor]]) -> torch.Tensor:
    """Cells (resolution³,) bool in which rays, given as origins and directions (R, 3), have samples, and those beside them."""
    n = occupancy.config.resolution
    met = torch.zeros(n, n, n, device=occupancy.density.device)
    grid = present_grid(occupancy, MET_PER_BIN)
    for origins, directions in rays:
        found = sample(origins, directions, grid.cells, grid.skip_distance, grid.settings, MET_SAMPLES)
        x, y, z = (found.points * n).long().clamp(0, n - 1).unbind(1)
        met[z, y, x] = 1
    return torch.nn.functional.max_pool3d(met[None], 3, 1, 1).view(-1) > 0


def worth_reading(cells: int, factor: int, pixels: float) -> bool:
    """Whether cutting so many cells into factor³ takes less time than it saves in rendering so many pixels."""
    return cells * factor**3 * PROBES <= pixels * SAVED


@torch.no_grad()
def read_fine(
    occupancy: OccupancyGrid,
    density: Callable[[torch.Tensor], torch.Tensor],
    factor: int,
    cells: torch.Tensor,
    check: Callable[[], None] | None = None,
) -> FineDensity:
    """Cells (C,) int64 cut into factor³, of which those stay occupied where `density` (points (N, 3) in grid coordinates →
    (N,), per normalised unit length) is not negligible at one of a few points; their mean is the density.

    What is found in a cell does not depend on which others are read. `check` is called often, on the CPU by several
    threads, and may raise to stop.
    """
    fine, side = _parts(cells, occupancy.config.resolution, factor), occupancy.config.resolution * factor
    generator = torch.Generator().manual_seed(0)
    offsets = torch.rand(OFFSETS, 3, generator=generator).to(cells.device)
    row = (fine[:, 2] * side + fine[:, 1]) * side + fine[:, 0]
    largest, mean = (torch.zeros(len(fine), device=cells.device) for _ in range(2))

    @torch.no_grad()
    def read(points: torch.Tensor) -> torch.Tensor:
        if check is not None:
            check()
        return density(points)

    for probe, octant in enumerate(OCTANTS):
        within = (offsets[(row * PROBES + probe) * SPREAD % OFFSETS] + torch.tensor(octant, device=cells.device)) / 2
        points = (fine + within) / side
        fresh = torch.cat(run_parallel([partial(read, some) for some in points.split(CHUNK)], cells.device))
        mean += fresh / PROBES
        torch.maximum(largest, fresh, out=largest)
    step = occupancy.step / factor
    mean = mean.clamp(1e-3, min(occupancy.config.optical_depth / step, LARGEST_HALF))
    kept = torch.where(largest * step > occupancy.config.threshold, mean, 0.0)
    return FineDensity(cells.int(), kept.view(len(cells), factor**3).half())


def _parts(coarse: torch.Tensor, n: int, factor: int) -> torch.Tensor:
    """Places (C · factor³, 3) of the parts of cells (C,) of an n³ grid in the grid that is `factor` times finer."""
    axis = torch.arange(factor, device=coarse.device)
    corner = torch.stack([coarse % n, coarse // n % n, coarse // (n * n)], 1)
    return (corner[:, None] * factor + torch.cartesian_prod(axis, axis, axis)).view(-1, 3)


@torch.no_grad()
def refined_grid(occupancy: OccupancyGrid, fine: FineDensity, per_bin: float) -> RenderGrid:
    """The finer grid. Occupied cells that were not read keep their density in all of their parts."""
    parts, n = fine.density.shape[1], occupancy.config.resolution
    factor = round(parts ** (1 / 3))
    side, step = n * factor, occupancy.step / factor
    coarse = (occupancy.cells[:, 0] > 0).nonzero()[:, 0]
    density = occupancy.cells[:, 0].index_select(0, coarse)[:, None].repeat(1, parts)
    density[torch.searchsorted(coarse, fine.coarse.long())] = fine.density.float()
    place = _parts(coarse, n, factor)
    row = (place[:, 2] * side + place[:, 1]) * side + place[:, 0]
    cells = torch.zeros(side**3, 2, device=coarse.device)
    cells[row, 0] = density.view(-1)
    cells[row, 1] = occupancy.importance[coarse].repeat_interleave(parts)
    settings = replace(occupancy.march_settings(), per_bin=per_bin, resolution=side, step=step)
    return RenderGrid(cells, skip_distances((cells[:, 0] > 0).view(side, side, side)), settings)
