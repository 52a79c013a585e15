"""Torch backend of `voxel_march.py`: all rays take one step after the other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch

from ..geometry.contraction import grid_position
from .traversal import BEFORE_CUBE, EARLY_STOP, MAX_BINS, MarchSettings
from .voxel_field import CELLS, VERTICES, VIEWS, VoxelField, VoxelRays, cell_length

_CORNERS = [(corner & 1, corner >> 1 & 1, corner >> 2) for corner in range(8)]


@dataclass(frozen=True)
class _Step:
    """Where N of the rays take a sample: rays (N,) their numbers, t (N,), corners (N, 8) the vertices around it and
    shares (N, 8) their trilinear weights."""

    rays: torch.Tensor
    t: torch.Tensor
    corners: torch.Tensor
    shares: torch.Tensor


def _bounds(origins: torch.Tensor, inverse: torch.Tensor, s: MarchSettings) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance of the first sample and of the end (R,)."""
    one, other = (-1 - origins) * inverse, (1 - origins) * inverse
    entry, leave = torch.minimum(one, other).amax(1), torch.maximum(one, other).amin(1)
    low, high = torch.full_like(entry, s.near), torch.full_like(entry, s.far)
    if not s.contracted:
        low, high = torch.maximum(low, entry), torch.minimum(high, leave)
    elif s.empty_distance > 0:
        low = torch.maximum(low, (float(BEFORE_CUBE) * entry).clamp(max=s.empty_distance))
    return low + 0.5 * s.step, high


def _leap(
    u: torch.Tensor, inverse: torch.Tensor, p: torch.Tensor, distance: torch.Tensor, n: int, wide: bool
) -> torch.Tensor:
    """As `voxel_march.leap` for N rays; wide: space is contracted."""
    block, reach = (u * n).floor(), distance[:, None].float()
    low, high = (block - reach + 1) / n, (block + reach) / n
    border = 0.25 if wide else 0.0
    ends = torch.where(inverse > 0, high.clamp(max=1 - border), low.clamp(min=border))
    straight = ((ends - u) * inverse).amin(1).clamp(min=0)
    if not wide:
        return 2 * straight
    r = p.abs().amax(1)
    free = torch.minimum(u - low, high - u).amin(1).clamp(0, 1)
    return torch.where(r <= 1, 4 * straight, free * (0.5 * r).clamp(min=3))


def _steps(
    origins: torch.Tensor,
    directions: torch.Tensor,
    index: torch.Tensor,
    n: int,
    s: MarchSettings,
    transmittance: torch.Tensor,
    ends: torch.Tensor | None = None,
) -> Iterator[_Step]:
    """The samples of rays (R, 3), one a ray at a time, while the caller lowers their transmittance (R,) in place."""
    inverse = 1 / torch.where(directions.abs() < 1e-9, 1e-9, directions)
    t, high = _bounds(origins, inverse, s)
    high = high if ends is None else torch.minimum(high, ends)
    for _ in range(int(MAX_BINS)):
        rays = ((t < high) & (transmittance >= float(EARLY_STOP))).nonzero()[:, 0]
        if len(rays) == 0:
            return
        now, d = t[rays], directions[rays]
        p = origins[rays] + d * now[:, None]
        r = p.abs().amax(1)
        length = torch.where(r > 1, s.step * r * r.sqrt(), s.step) if s.contracted else torch.full_like(now, s.step)
        u = grid_position(p, s.contracted).clamp(0, 1)
        block = (u * n).long().clamp(max=n - 1)
        entry = index[(block[:, 2] * n + block[:, 1]) * n + block[:, 0]].long()
        empty = entry <= 0
        away = _leap(u, inverse[rays], p, -entry, n, s.contracted) + 0.5 * length
        t[rays] += torch.where(empty, away, length)
        used = (~empty).nonzero()[:, 0]
        if len(used) == 0:
            continue
        local = (u[used] * n - block[used]) * CELLS
        corner = local.long().clamp(max=CELLS - 1)
        f = local - corner
        first = (entry[used] - 1) * VERTICES**3 + (corner[:, 2] * VERTICES + corner[:, 1]) * VERTICES + corner[:, 0]
        corners = torch.stack([first + (z * VERTICES + y) * VERTICES + x for x, y, z in _CORNERS], 1)
        weights = [torch.where(torch.tensor(c, device=f.device) > 0, f, 1 - f).prod(1) for c in _CORNERS]
        yield _Step(rays[used], now[used], corners, torch.stack(weights, 1))


def unpacked(texels: torch.Tensor) -> torch.Tensor:
    """The bytes (…, 4) int64, lowest first, of texels (…) int32."""
    value = texels.long()
    return torch.stack([value >> shift & 255 for shift in (0, 8, 16, 24)], -1)


def march(
    origins: torch.Tensor, directions: torch.Tensor, field: VoxelField, s: MarchSettings, ends: torch.Tensor
) -> VoxelRays:
    """As `voxel_march.march`."""
    count, device = len(origins), origins.device
    color, depth = torch.zeros(count, 3, device=device), torch.zeros(count, device=device)
    probabilities = torch.zeros(count, field.classes, device=device)
    transmittance = torch.ones(count, device=device)
    exponent = s.step / cell_length(field.blocks, s.contracted)
    words = field.vertices.view(-1, 4)
    for step in _steps(origins, directions, field.index, field.blocks, s, transmittance, ends):
        texels = unpacked(words[step.corners]).float()  # (N, 8, 4 texels, 4 bytes)
        parts = step.shares * texels[..., 0, 3] / 255
        root = parts.sum(1)
        alpha = 1 - (1 - root * root).clamp(min=0) ** exponent
        if field.classes:
            # The first of equal corners, as in the kernel.
            nearest = texels[torch.arange(len(root), device=device), parts.argmax(1)]
            top, second, share = nearest[:, 1, 3].long(), nearest[:, 3, 3].long(), nearest[:, 2, 3] / 255
            alpha = alpha * (share * field.class_opacity[top] + (1 - share) * field.class_opacity[second])
            weight = transmittance[step.rays] * alpha
            probabilities.index_put_((step.rays, top), weight * share, accumulate=True)
            probabilities.index_put_((step.rays, second), weight * (1 - share), accumulate=True)
        weight = transmittance[step.rays] * alpha
        mixed = (step.shares[..., None, None] * texels[..., :3]).sum(1)  # (N, 4, 3)
        slope = ((mixed[:, 1:] - 127.5) * directions[step.rays][..., None]).sum(1)
        seen = (mixed[:, 0] / 255 + slope * (field.harmonic_range / 127.5)).clamp(0, 1)
        color[step.rays] += weight[:, None] * seen
        depth[step.rays] += weight * step.t
        transmittance[step.rays] *= 1 - alpha
    return VoxelRays(color, 1 - transmittance, depth, probabilities if field.classes else None)


def add_views(
    views: torch.Tensor,
    origins: torch.Tensor,
    directions: torch.Tensor,
    cameras: torch.Tensor,
    index: torch.Tensor,
    roots: torch.Tensor,
    s: MarchSettings,
) -> None:
    """As `voxel_march.add_views`."""
    transmittance = torch.ones(len(origins), device=origins.device)
    by_vertex, n = len(views) == len(roots), round(len(index) ** (1 / 3))
    flat = views.view(-1)
    for step in _steps(origins, directions, index, n, s, transmittance):
        root = (step.shares * roots[step.corners].float() / 255).sum(1)
        alpha = (root * root).clamp(max=1)
        weight = transmittance[step.rays] * alpha
        camera = cameras[step.rays].long()[:, None]
        places = step.corners if by_vertex else step.corners[:, :1] // VERTICES**3
        share = (weight[:, None] * step.shares if by_vertex else weight[:, None]) * 32767
        code = torch.where(share.int() > 0, share.int() * 65536 + camera.int(), 0)
        slot = places * VIEWS + camera % VIEWS
        flat.scatter_reduce_(0, slot.reshape(-1), code.reshape(-1), "amax")
        transmittance[step.rays] *= 1 - alpha
