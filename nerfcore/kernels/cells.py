"""Scalar grids of cells: trilinear reading, and the largest and the mean value of the points in each cell.

Values sit at cell centres, (resolution³,) float32, x fastest. The torch backend is in `cells_torch.py`.
"""

from __future__ import annotations

import torch
import warp as wp

from . import cells_torch
from .device import backend_of
from .runtime import array, init, launch
from .traversal import cell_index

MOST_CELLS_A_SIDE = 1290  # of a grid whose cells are numbered in 32 bits: 1290³ < 2³¹ < 1291³
FIXED_POINT = wp.constant(cells_torch.FIXED_POINT)
LARGEST = wp.constant(cells_torch.LARGEST)


@wp.func
def trilinear_at(grid: wp.array(dtype=float), n: int, point: wp.vec3):
    """Value of an n³ grid at a point in [0, 1]³; constant beyond the outermost cell centres."""
    p = point * float(n) - wp.vec3(0.5, 0.5, 0.5)
    ix = wp.clamp(int(wp.floor(p[0])), 0, n - 2)
    iy = wp.clamp(int(wp.floor(p[1])), 0, n - 2)
    iz = wp.clamp(int(wp.floor(p[2])), 0, n - 2)
    fx = wp.clamp(p[0] - float(ix), 0.0, 1.0)
    fy = wp.clamp(p[1] - float(iy), 0.0, 1.0)
    fz = wp.clamp(p[2] - float(iz), 0.0, 1.0)
    total = float(0.0)
    for corner in range(4):
        dy = corner & 1
        dz = corner >> 1
        row = ((iz + dz) * n + iy + dy) * n + ix
        w = wp.where(dy == 1, fy, 1.0 - fy) * wp.where(dz == 1, fz, 1.0 - fz)
        total += w * ((1.0 - fx) * grid[row] + fx * grid[row + 1])
    return total


@wp.kernel(module="fieldwork_cells")
def read_trilinear(
    grid: wp.array(dtype=float), n: int, points: wp.array(dtype=wp.vec3), out: wp.array(dtype=float), offset: int
):
    i = wp.tid() + offset
    out[i] = trilinear_at(grid, n, points[i])


@wp.kernel(module="fieldwork_cells")
def write_max(
    points: wp.array(dtype=wp.vec3), values: wp.array(dtype=float), n: int, grid: wp.array(dtype=float), offset: int
):
    i = wp.tid() + offset
    wp.atomic_max(grid, cell_index(points[i], n), values[i])


@wp.kernel(module="fieldwork_cells")
def take_max(
    points: wp.array(dtype=wp.vec3),
    n: int,
    decay: float,
    fresh: wp.array(dtype=float),
    grid: wp.array(dtype=float),
    offset: int,
):
    i = wp.tid() + offset
    cell = cell_index(points[i], n)
    # Of all points in a cell one takes the value; a cell that decayed twice would depend on the order of threads.
    value = wp.atomic_exch(fresh, cell, -1.0)
    if value >= 0.0:
        grid[cell] = wp.max(grid[cell] * decay, value)


def observe(
    grid: torch.Tensor, scratch: torch.Tensor, resolution: int, points: torch.Tensor, values: torch.Tensor, decay: float
) -> None:
    """Update the cells that hold points (N, 3) in place: grid ← max(decay · grid, largest value of the points in it).

    `scratch` (resolution³,) must be −1 everywhere and is so again afterwards. Points with negative values are passed
    over.
    """
    if not backend_of(points.device).warp:
        return cells_torch.observe(grid, scratch, resolution, points, values, decay)
    init()
    where = array(points, wp.vec3)
    launch(
        write_max,
        len(points),
        [where, array(values.contiguous()), resolution, array(scratch)],
        points.device,
        serial=True,
    )
    launch(take_max, len(points), [where, resolution, decay, array(scratch), array(grid)], points.device, serial=True)


@wp.kernel(module="fieldwork_cells")
def add_values(
    points: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=float),
    n: int,
    sums: wp.array(dtype=wp.int64, ndim=2),
    offset: int,
):
    i = wp.tid() + offset
    if values[i] >= 0.0:
        cell = cell_index(points[i], n)
        wp.atomic_add(sums, cell, 0, wp.int64(wp.min(values[i], LARGEST) * FIXED_POINT))
        wp.atomic_add(sums, cell, 1, wp.int64(1))


@wp.kernel(module="fieldwork_cells")
def take_mean(
    points: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=float),
    n: int,
    rate: float,
    sums: wp.array(dtype=wp.int64, ndim=2),
    grid: wp.array(dtype=float),
    offset: int,
):
    i = wp.tid() + offset
    if values[i] >= 0.0:
        cell = cell_index(points[i], n)
        # One of the points in a cell takes their sum, whichever comes first.
        count = float(wp.atomic_exch(sums, cell, 1, wp.int64(0)))
        if count > 0.0:
            mean = float(sums[cell, 0]) / FIXED_POINT / count
            sums[cell, 0] = wp.int64(0)
            share = rate
            if count > 1.0:
                share = 1.0 - wp.pow(1.0 - rate, count)
            grid[cell] = grid[cell] + share * (mean - grid[cell])


class MeanScratch:
    """What `average` sums up in: sums (n³, 2) int64, of values in units of 2⁻²⁰, so that the order of the points
    changes nothing, and their number, side by side because memory is what it waits for; zero between calls."""

    def __init__(self, cells: int, device: torch.device) -> None:
        # Without 64-bit atomics (MPS) the sums are floats, whose last bits follow the order of the points.
        exact = torch.int64 if backend_of(device).has_float64 else torch.float32
        self.sums = torch.zeros(cells, 2, dtype=exact, device=device)


def average(
    grid: torch.Tensor,
    scratch: MeanScratch,
    resolution: int,
    points: torch.Tensor,
    values: torch.Tensor,
    rate: float,
) -> None:
    """Move the cells that hold points (N, 3) towards the mean of the points' values (N,) in place, as far as one step
    at `rate` for each of the n points would: grid ← grid + (1 − (1 − rate)ⁿ) · (mean − grid).

    Points with negative values are passed over. The order of the points does not matter.
    """
    if not backend_of(points.device).warp:
        return cells_torch.average(grid, scratch.sums, resolution, points, values, rate)
    init()
    read, sums = [array(points, wp.vec3), array(values.contiguous()), resolution], array(scratch.sums)
    launch(add_values, len(points), [*read, sums], points.device, serial=True)
    launch(take_mean, len(points), [*read, rate, sums, array(grid)], points.device, serial=True)


def trilinear(grid: torch.Tensor, resolution: int, points: torch.Tensor) -> torch.Tensor:
    """Values (N,) at points (N, 3) in [0, 1]³; constant beyond the outermost cell centres."""
    if not backend_of(points.device).warp:
        return cells_torch.trilinear(grid, resolution, points)
    init()
    out = torch.empty(len(points), device=points.device)
    launch(read_trilinear, len(points), [array(grid), resolution, array(points, wp.vec3), array(out)], points.device)
    return out


def scatter_max(resolution: int, points: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Largest non-negative value of the points in each cell, 0 where there is none: (resolution³,)."""
    grid = torch.zeros(resolution**3, device=points.device)
    if not backend_of(points.device).warp:
        return cells_torch.scatter_max(grid, resolution, points, values)
    init()
    inputs = [array(points, wp.vec3), array(values.contiguous()), resolution, array(grid)]
    launch(write_max, len(points), inputs, points.device, serial=True)
    return grid
