"""What the kernels of `march.py` must give, one ray and one bin at a time."""

from __future__ import annotations

import math

import torch
from fieldwork.nerfcore.geometry.contraction import grid_position
from fieldwork.nerfcore.kernels.traversal import MAX_BINS, MAX_SKIP, PDF_DEFAULT, PDF_UNIFORM, MarchSettings

EARLY_STOP = 1e-4
BLOCK = 4


def skip_distance(occupied: torch.Tensor, block: torch.Tensor) -> int:
    """How many blocks around one (x, y, z), itself included, are empty in all directions, at most MAX_SKIP."""
    for radius in range(MAX_SKIP):
        low, high = ((block - radius) * BLOCK).clamp(min=0).tolist(), ((block + radius + 1) * BLOCK).tolist()
        if bool(occupied[low[2] : high[2], low[1] : high[1], low[0] : high[0]].any()):
            return radius
    return MAX_SKIP


def traverse(
    origin: torch.Tensor, direction: torch.Tensor, jitter: float, cells: torch.Tensor, s: MarchSettings
) -> list[tuple[float, float, float]]:
    """The occupied bins of one ray: (middle, length, weight), front to back."""
    n = s.resolution
    occupied = (cells[:, 0] > 0).view(n, n, n)
    low, high = s.near, s.far
    inverse = 1 / torch.where(direction.abs() < 1e-9, 1e-9, direction)
    if s.contracted and s.empty_distance > 0:
        entry = torch.minimum((-1 - origin) * inverse, (1 - origin) * inverse).max()
        low = max(low, min(s.empty_distance, 0.8 * float(entry)))
    if not s.contracted:
        a, b = (-1 - origin) * inverse, (1 - origin) * inverse
        low = max(low, float(torch.minimum(a, b).max()))
        high = min(high, float(torch.maximum(a, b).min()))
    t, transmittance, bins = low + jitter * s.step, 1.0, []
    for _ in range(int(MAX_BINS)):
        if t >= high:
            break
        p = origin + direction * t
        r = float(p.abs().max())
        length = s.step * r * math.sqrt(r) if s.contracted and r > 1 else s.step
        u = grid_position(p, s.contracted)
        x, y, z = (u * n).long().clamp(0, n - 1).tolist()
        density, importance = cells[(z * n + y) * n + x].tolist()
        if density > 0:
            if s.mode == PDF_UNIFORM:
                weight = 1.0
            elif s.mode == PDF_DEFAULT:
                alpha = 1 - math.exp(-density * length)
                weight = transmittance * alpha * (1 + s.beta * importance) + s.epsilon
            else:
                weight = density * importance + 1e-6
            bins.append((t, length, weight))
            if s.mode == PDF_DEFAULT:
                transmittance *= math.exp(-density * length)
                if transmittance < EARLY_STOP:
                    break
            t += length
        elif s.contracted and float((u - 0.5).abs().max()) >= 0.25:
            t += length
        else:
            block = torch.tensor([x, y, z]) // BLOCK
            skip, border = skip_distance(occupied, block), 0.25 if s.contracted else 0.0
            begin = (block - skip + 1) * BLOCK if skip else torch.tensor([x, y, z])
            end = (block + skip) * BLOCK if skip else begin + 1
            edge = torch.where(direction > 0, (end / n).clamp(max=1 - border), (begin / n).clamp(min=border))
            leave = max(float(((edge - u) * inverse).min()) * (4 if s.contracted else 2), 0.0)
            t += max(1.0, math.floor(leave / s.step + 0.5)) * s.step
    return bins


def sample_ray(
    bins: list[tuple[float, float, float]], count: int, shift: list[float]
) -> tuple[list[float], list[float]]:
    """Distances and lengths of `count` samples on one ray by inverting the bins' cumulative weight."""
    total = sum(weight for _, _, weight in bins)
    share = total / count
    sample_t, deltas = [], [0.0] * count
    below = 0.0
    for middle, length, weight in bins:
        above = below + weight
        for k in range(count):
            target = (k + shift[k]) * share
            if len(sample_t) == k and target <= above:
                sample_t.append(middle + ((target - below) / weight - 0.5) * length)
            overlap = max(0.0, min((k + 1) * share, above) - max(k * share, below))
            deltas[k] += overlap / weight * length
        below = above
    return sample_t + [bins[-1][0]] * (count - len(sample_t)), deltas
