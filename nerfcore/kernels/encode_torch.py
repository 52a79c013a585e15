"""Torch backend of `encode.py` and `encode_points.py`."""

from __future__ import annotations

from collections.abc import Iterator

import torch

FEATURES = 4
BLOCK = 16  # vertices that share one "touched" flag of the optimiser
PRIMES = (1, 2654435761, 805459861)
Levels = list[tuple[int, int, int]]


def rows_of(corner: torch.Tensor, resolution: int, base: int, size: int) -> torch.Tensor:
    """Table rows (N,) of integer vertices (N, 3)."""
    x, y, z = corner.long().unbind(-1)
    if resolution**3 <= size:
        return base + (z * resolution + y) * resolution + x
    hashed = x ^ (y * PRIMES[1] & 0xFFFFFFFF) ^ (z * PRIMES[2] & 0xFFFFFFFF)
    return base + (hashed & (size - 1))


def _corners(
    points: torch.Tensor, level: tuple[int, int, int]
) -> Iterator[tuple[tuple[int, int, int], torch.Tensor, torch.Tensor]]:
    """The eight corners of the cells that hold points (N, 3): which corner, table rows (N,), place in the cell (N, 3)."""
    resolution, base, size = level
    scaled = points * (resolution - 1)
    cell = scaled.detach().long().clamp(0, resolution - 2)
    place = scaled - cell
    for dz in (0, 1):
        for dy in (0, 1):
            for dx in (0, 1):
                corner = torch.stack([cell[:, 0] + dx, cell[:, 1] + dy, cell[:, 2] + dz], 1)
                yield (dx, dy, dz), rows_of(corner, resolution, base, size), place


def _along(place: torch.Tensor, corner: tuple[int, int, int], axis: int) -> torch.Tensor:
    return place[:, axis] if corner[axis] else 1 - place[:, axis]


def _weight(place: torch.Tensor, corner: tuple[int, int, int]) -> torch.Tensor:
    """Trilinear weight (N, 1) of a corner."""
    return (_along(place, corner, 0) * _along(place, corner, 1) * _along(place, corner, 2))[:, None]


def forward(table: torch.Tensor, levels: Levels, gains: list[float], points: torch.Tensor) -> torch.Tensor:
    """As `encode.forward`; differentiable in `table` and `points`."""
    parts = []
    for level, gain in zip(levels, gains):
        total = torch.zeros(len(points), table.shape[1], dtype=table.dtype, device=table.device)
        if gain != 0.0:
            for corner, rows, place in _corners(points, level):
                total = total + _weight(place, corner) * table[rows]
            total = total * gain
        parts.append(total)
    return torch.cat(parts, 1)


@torch.no_grad()
def scatter(
    grad_table: torch.Tensor,
    touched: torch.Tensor,
    levels: Levels,
    gains: list[float],
    parts: list[tuple[torch.Tensor, torch.Tensor]],
) -> None:
    """As `encode.scatter`."""
    for points, grad in parts:
        of_levels = grad.reshape(len(points), len(levels), FEATURES)
        for index, (level, gain) in enumerate(zip(levels, gains)):
            if gain == 0.0:
                continue
            upstream = of_levels[:, index] * gain
            for corner, rows, place in _corners(points, level):
                grad_table.index_add_(0, rows, _weight(place, corner) * upstream)
                touched[rows // BLOCK] = 1


@torch.no_grad()
def backward_points(
    table: torch.Tensor, levels: Levels, gains: list[float], points: torch.Tensor, grad_out: torch.Tensor
) -> torch.Tensor:
    """As `encode_points.backward_points`."""
    out = torch.zeros_like(points)
    of_levels = grad_out.reshape(len(points), len(levels), FEATURES)
    for index, (level, gain) in enumerate(zip(levels, gains)):
        if gain == 0.0:
            continue
        for corner, rows, place in _corners(points, level):
            value = (of_levels[:, index] * table[rows]).sum(1) * (gain * (level[0] - 1))
            for axis in range(3):
                others = [_along(place, corner, other) for other in range(3) if other != axis]
                slope = value * others[0] * others[1]
                out[:, axis] += slope if corner[axis] else -slope
    return out


@torch.no_grad()
def adam(
    table: torch.Tensor,
    grad: torch.Tensor,
    mean: torch.Tensor,
    square: torch.Tensor,
    touched: torch.Tensor,
    lost: torch.Tensor,
    rate: float,
    betas: tuple[float, float] = (0.9, 0.99),
    epsilon: float = 1e-15,
) -> None:
    """As `encode.adam`."""
    blocks = touched.nonzero()[:, 0]
    rows = (blocks[:, None] * BLOCK + torch.arange(BLOCK, device=blocks.device)).view(-1)
    g = grad[rows]
    size = (g * g).sum(1)
    finite = torch.isfinite(size)
    lost += (~finite).sum().to(lost.dtype)
    grad[rows] = 0
    touched.zero_()
    used = finite & (size > 0)
    rows, g = rows[used], g[used]
    m = betas[0] * mean[rows] + (1 - betas[0]) * g
    v = betas[1] * square[rows] + (1 - betas[1]) * g * g
    mean[rows], square[rows] = m, v
    table[rows] -= rate * m / (v.sqrt() + epsilon)
