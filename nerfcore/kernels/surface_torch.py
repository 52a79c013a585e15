"""Torch twins of `surface.py`; depths of rays are the torch backend's, the rest is slow."""

from __future__ import annotations

import math

import torch

from .composite_torch import rows_of_rays
from .depth_arrays import MapArrays
from .packed_info import PackedInfo


def depth_quantiles(
    density: torch.Tensor, deltas: torch.Tensor, t: torch.Tensor, packed_info: PackedInfo
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """As `surface.depth_quantiles`; the torch backend's."""
    if not len(density):
        nothing = torch.zeros(len(packed_info.starts), device=density.device)
        return nothing, nothing, nothing, nothing
    own, _, _ = rows_of_rays(density * deltas, packed_info)
    begin, _, _ = rows_of_rays(t - deltas / 2, packed_info)
    slope, _, _ = rows_of_rays(density, packed_info)
    after = torch.cumsum(own, 1)
    before = after - own
    found = []
    for share in (0.75, 0.5, 0.25):
        level = -math.log(share)
        inside = (before < level) & (after >= level)
        found.append(torch.where(inside, begin + (level - before) / slope.clamp(min=1e-30), 0.0).amax(1))
    near, middle, far = found
    return near, middle, far, 1 - torch.exp(-own.sum(1))


def read_depth(maps: MapArrays, view: int, x: torch.Tensor, y: torch.Tensor, gap: float) -> torch.Tensor:
    """As `surface.read_depth`: depth (N,) of one map at pixel coordinates (N,)."""
    width, height = maps.size[view].tolist()
    image = maps.depth[int(maps.first[view]) :][: width * height].view(height, width)
    value = image[y.long().clamp(0, height - 1), x.long().clamp(0, width - 1)]
    x0, y0 = (x - 0.5).floor().long(), (y - 0.5).floor().long()
    inner = (x0 >= 0) & (y0 >= 0) & (x0 + 1 < width) & (y0 + 1 < height) & (value > 0)
    x0, y0 = x0.clamp(0, width - 2), y0.clamp(0, height - 2)
    corners = torch.stack([image[y0, x0], image[y0, x0 + 1], image[y0 + 1, x0], image[y0 + 1, x0 + 1]])
    low, high = corners.min(0).values, corners.max(0).values
    fx, fy = x - 0.5 - x0, y - 0.5 - y0
    share = torch.stack([(1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx])
    smooth = (low > 0) & (high - low < gap * low)
    inverse = (share / corners.clamp(min=1e-9)).sum(0)
    out = torch.where(value - low >= gap * low, 0.0, torch.where(smooth, 1 / inverse, value))
    return torch.where(inner, out, value)


def view_distances(
    points: torch.Tensor, maps: MapArrays, view: int, voxel: float, truncation: float, gap: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance (N,) that one view gives to points (N, 3), NaN where it says nothing, and its weight (N,)."""
    q = points @ maps.rotation[view].T + maps.translation[view]
    fx, fy, cx, cy = maps.lens[view].tolist()
    width, height = maps.size[view].tolist()
    x, y = fx * q[:, 0] / q[:, 2] + cx, fy * q[:, 1] / q[:, 2] + cy
    inside = (q[:, 2] > 1e-4) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    place = int(maps.first[view]) + y.clamp(0, height - 1).long() * width + x.clamp(0, width - 1).long()
    depth = read_depth(maps, view, x, y, gap)
    far, cosine = q.norm(dim=1), maps.cosine[place]
    d = (depth - q[:, 2]) * far / q[:, 2] * cosine
    weight = (voxel / maps.spread[place].clamp(min=1e-6)).clamp(max=1) ** 2 * cosine * (fx / q[:, 2]) ** 2
    weight = weight * (1 + d.clamp(max=0) / truncation) ** 2
    usable = inside & (depth > 0) & (d > -truncation)
    return torch.where(usable, d.clamp(max=truncation), torch.nan), torch.where(usable, weight, 0.0)


def fuse(
    points: torch.Tensor, maps: MapArrays, voxel: float, truncation: float, free_at: float, gap: float, apart: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """As `surface.fuse`."""
    pairs = [view_distances(points, maps, v, voxel, truncation, gap) for v in range(len(maps))]
    distance, weight = torch.stack([d for d, _ in pairs]), torch.stack([w for _, w in pairs])
    seen = ~distance.isnan()
    value = torch.where(seen, distance, 0.0)
    through = seen & (value > free_at)
    free = through.sum(0)
    weight = torch.where(through, 0.1 * weight, weight)
    outer = weight * (value >= 0)
    thin = (free >= 2) & (free >= 0.15 * seen.sum(0)) & (outer.sum(0) > 0)
    used = torch.where(thin, outer, weight)
    total = used.sum(0)
    fused = torch.where(total > 0, (used * value).sum(0) / total.clamp(min=1e-30), 0.0)
    centers = torch.stack([-maps.translation[v] @ maps.rotation[v] for v in range(len(maps))])
    ray = torch.nn.functional.normalize(points - centers[:, None], dim=2)
    first = seen.float().argmax(0)
    toward = ray[first, torch.arange(len(points))]
    known = (seen & ((ray * toward).sum(2) < apart)).any(0)
    return fused, total, known.to(torch.uint8)
