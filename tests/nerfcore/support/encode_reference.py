"""What the functions of `encode.py` must give."""

from __future__ import annotations

import torch

PRIMES = (1, 2654435761, 805459861)


def rows_of(corner: torch.Tensor, resolution: int, base: int, size: int) -> torch.Tensor:
    """Table rows (N,) of integer vertices (N, 3)."""
    x, y, z = corner.long().unbind(-1)
    if resolution**3 <= size:
        return base + (z * resolution + y) * resolution + x
    hashed = x ^ (y * PRIMES[1] & 0xFFFFFFFF) ^ (z * PRIMES[2] & 0xFFFFFFFF)
    return base + (hashed & (size - 1))


def forward(
    table: torch.Tensor, levels: list[tuple[int, int, int]], gains: list[float], points: torch.Tensor
) -> torch.Tensor:
    """As `encode.forward`; differentiable in `table` (and `points`)."""
    parts = []
    for (resolution, base, size), gain in zip(levels, gains):
        scaled = points * (resolution - 1)
        corner = scaled.detach().floor().long().clamp(0, resolution - 2)
        f = scaled - corner
        total = torch.zeros(len(points), table.shape[1], dtype=table.dtype, device=table.device)
        for dz in (0, 1):
            for dy in (0, 1):
                for dx in (0, 1):
                    offset = torch.tensor([dx, dy, dz], device=points.device)
                    weight = torch.where(offset == 1, f, 1 - f).prod(-1, keepdim=True)
                    total = total + weight * table[rows_of(corner + offset, resolution, base, size)]
        parts.append(total * gain)
    return torch.cat(parts, 1)


def adam(
    table: torch.Tensor,
    grad: torch.Tensor,
    mean: torch.Tensor,
    square: torch.Tensor,
    rate: float,
    betas: tuple[float, float] = (0.9, 0.99),
    epsilon: float = 1e-15,
) -> None:
    """As `encode.adam`: rows with a zero gradient keep value and moments; the gradient is cleared."""
    rows = (grad * grad).sum(1) > 0
    g = grad[rows]
    mean[rows] = betas[0] * mean[rows] + (1 - betas[0]) * g
    square[rows] = betas[1] * square[rows] + (1 - betas[1]) * g * g
    table[rows] -= rate * mean[rows] / (square[rows].sqrt() + epsilon)
    grad.zero_()
