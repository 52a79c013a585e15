"""Scalar grids of cells: trilinear reading, and the largest value of the points in each cell.

Values sit at cell centres, (resolution³,) float32, x fastest. The torch twins are in `cells_torch.py`.
"""

from __future__ import annotations

import torch
import warp as wp

from .runtime import array, init, launch
from .walk import cell_index


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
def move_mean(
    points: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=float),
    n: int,
    rate: float,
    grid: wp.array(dtype=float),
    offset: int,
):
    i = wp.tid() + offset
    if values[i] >= 0.0:
        cell = cell_index(points[i], n)
        grid[cell] = grid[cell] + rate * (values[i] - grid[cell])


def average(grid: torch.Tensor, resolution: int, points: torch.Tensor, values: torch.Tensor, rate: float) -> None:
    """Move the cells that hold points (N, 3) towards the points' values (N,) in place, one point after the other:
    grid ← grid + rate · (value − grid). Points with negative values are passed over."""
    init()
    inputs = [array(points, wp.vec3), array(values.contiguous()), resolution, rate, array(grid)]
    launch(move_mean, len(points), inputs, points.device, serial=True)


def trilinear(grid: torch.Tensor, resolution: int, points: torch.Tensor) -> torch.Tensor:
    """Values (N,) at points (N, 3) in [0, 1]³; constant beyond the outermost cell centres."""
    init()
    out = torch.empty(len(points), device=points.device)
    launch(read_trilinear, len(points), [array(grid), resolution, array(points, wp.vec3), array(out)], points.device)
    return out


def scatter_max(resolution: int, points: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Largest non-negative value of the points in each cell, 0 where there is none: (resolution³,)."""
    init()
    grid = torch.zeros(resolution**3, device=points.device)
    inputs = [array(points, wp.vec3), array(values.contiguous()), resolution, array(grid)]
    launch(write_max, len(points), inputs, points.device, serial=True)
    return grid
