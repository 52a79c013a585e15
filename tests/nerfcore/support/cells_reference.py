"""What the functions of `cells.py` must give."""

from __future__ import annotations

import torch


def trilinear(grid: torch.Tensor, resolution: int, points: torch.Tensor) -> torch.Tensor:
    """As `cells.trilinear`."""
    n = resolution
    p = points * n - 0.5
    corner = p.floor().long().clamp(0, n - 2)
    f = (p - corner).clamp(0, 1)
    total = torch.zeros(len(points), device=points.device)
    for dz in (0, 1):
        for dy in (0, 1):
            for dx in (0, 1):
                offset = torch.tensor([dx, dy, dz], device=points.device)
                x, y, z = (corner + offset).unbind(-1)
                total = total + torch.where(offset == 1, f, 1 - f).prod(-1) * grid[(z * n + y) * n + x]
    return total


def scatter_max(resolution: int, points: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """As `cells.scatter_max`."""
    n = resolution
    x, y, z = (points * n).long().clamp(0, n - 1).unbind(-1)
    grid = torch.zeros(n**3, device=points.device)
    return grid.scatter_reduce(0, (z * n + y) * n + x, values, "amax")


def observe(
    grid: torch.Tensor, scratch: torch.Tensor, resolution: int, points: torch.Tensor, values: torch.Tensor, decay: float
) -> None:
    """As `cells.observe`."""
    n = resolution
    x, y, z = (points * n).long().clamp(0, n - 1).unbind(-1)
    fresh = scratch.scatter_reduce(0, (z * n + y) * n + x, values, "amax")
    seen = fresh >= 0
    grid[seen] = torch.maximum(grid[seen] * decay, fresh[seen])


def average(grid: torch.Tensor, resolution: int, points: torch.Tensor, values: torch.Tensor, rate: float) -> None:
    """As `cells.average`, without its scratch."""
    n = resolution
    x, y, z = (points * n).long().clamp(0, n - 1).unbind(-1)
    found: dict[int, list[float]] = {}
    for cell, value in zip(((z * n + y) * n + x).tolist(), values.tolist()):
        if value >= 0:
            found.setdefault(cell, []).append(value)
    for cell, several in found.items():
        grid[cell] += (1 - (1 - rate) ** len(several)) * (sum(several) / len(several) - grid[cell])
