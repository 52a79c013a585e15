"""Torch backend of `cells.py`."""

from __future__ import annotations

import torch

FIXED_POINT = float(1 << 20)  # sums of values are integers in units of its inverse
LARGEST = float(1 << 20)  # value; 2²³ points of it fit into a sum


def cell_index(points: torch.Tensor, n: int) -> torch.Tensor:
    """Indices (N,) int64 of the cells of an n³ grid that hold points (N, 3) of [0, 1]³."""
    x, y, z = (points * n).long().clamp(0, n - 1).unbind(-1)
    return (z * n + y) * n + x


def trilinear(grid: torch.Tensor, resolution: int, points: torch.Tensor) -> torch.Tensor:
    """As `cells.trilinear`."""
    n = resolution
    p = points * n - 0.5
    corner = p.floor().long().clamp(0, n - 2)
    high = (p - corner).clamp(0, 1)
    x, y, z = corner.unbind(-1)
    row = (z * n + y) * n + x
    weight = torch.stack([1 - high, high])  # (2, N, 3)
    total = torch.zeros(len(points), device=points.device)
    for dz in (0, 1):
        for dy in (0, 1):
            for dx in (0, 1):
                factor = weight[dx, :, 0] * weight[dy, :, 1] * weight[dz, :, 2]
                total += factor * grid[row + (dz * n + dy) * n + dx]
    return total


def scatter_max(grid: torch.Tensor, resolution: int, points: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """As `cells.scatter_max`; `grid` (resolution³,) holds zeros."""
    return grid.scatter_reduce(0, cell_index(points, resolution), values, "amax")


def observe(
    grid: torch.Tensor, scratch: torch.Tensor, resolution: int, points: torch.Tensor, values: torch.Tensor, decay: float
) -> None:
    """As `cells.observe`."""
    cell = cell_index(points, resolution)
    fresh = scratch.scatter_reduce(0, cell, values, "amax")[cell]
    # Points of one cell write the same number.
    grid[cell] = torch.where(fresh >= 0, torch.maximum(grid[cell] * decay, fresh), grid[cell])


def average(
    grid: torch.Tensor,
    sums: torch.Tensor,
    resolution: int,
    points: torch.Tensor,
    values: torch.Tensor,
    rate: float,
) -> None:
    """As `cells.average`; `sums` as in `cells.MeanScratch`."""
    cell, counted = cell_index(points, resolution), values >= 0
    scaled = values.clamp(0, LARGEST) * FIXED_POINT
    sums.index_add_(0, cell, torch.stack([torch.where(counted, scaled, 0), counted], 1).to(sums.dtype))
    total, count = sums[cell].float().unbind(1)
    mean = total / FIXED_POINT / count.clamp(min=1)
    before = grid[cell]
    # Points of one cell write the same number.
    grid[cell] = before + (1 - (1 - rate) ** count) * (mean - before)
    sums[cell] = 0
