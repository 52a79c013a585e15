"""What the functions of `surface.py` must give, all points of a view at once."""

from __future__ import annotations

import math

import torch
from fieldwork.nerfcore.kernels.depth_arrays import FREE, MapArrays
from fieldwork.nerfcore.kernels.packed_info import PackedInfo

LOOKED_UP = 0.05  # share by which depths of neighbouring pixels may differ where a point is looked up


def depth_quantiles(
    density: torch.Tensor, deltas: torch.Tensor, t: torch.Tensor, packed_info: PackedInfo
) -> list[tuple[float, float, float, float]]:
    """As `surface.depth_quantiles`, one ray after the other."""
    out = []
    for begin, count in zip(packed_info.starts.tolist(), packed_info.counts.tolist()):
        found, transmittance = [0.0, 0.0, 0.0], 1.0
        for k in range(begin, begin + count):
            after = transmittance * math.exp(-float(density[k] * deltas[k]))
            for place, share in enumerate((0.75, 0.5, 0.25)):
                if transmittance > share >= after:
                    inside = math.log(transmittance / share) / float(density[k])
                    found[place] = float(t[k] - deltas[k] / 2) + inside
            transmittance = after
        out.append((*found, 1 - transmittance))
    return out


def camera_axes(maps: MapArrays, view: int, points: torch.Tensor) -> torch.Tensor:
    """Points (N, 3) of the frame in a view's axes."""
    return points @ maps.rotation[view].T + maps.translation[view]


def pixels_of(maps: MapArrays, view: int, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """x, y (N,) of points in a view's axes, and whether (N,) they lie in its picture."""
    fx, fy, cx, cy = maps.lens[view].tolist()
    width, height = maps.size[view].tolist()
    x, y = fx * q[:, 0] / q[:, 2] + cx, fy * q[:, 1] / q[:, 2] + cy
    return x, y, (q[:, 2] > 1e-4) & (x >= 0) & (y >= 0) & (x < width) & (y < height)


def unprojected(maps: MapArrays, view: int, x: torch.Tensor, y: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
    """Points (N, 3) of the frame at pixels and depths (N,) of a view."""
    fx, fy, cx, cy = maps.lens[view].tolist()
    q = torch.stack([(x - cx) / fx * z, (y - cy) / fy * z, z], 1)
    return (q - maps.translation[view]) @ maps.rotation[view]


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
    out = torch.where((low >= 0) & (value - low >= gap * low), 0.0, torch.where(smooth, 1 / inverse, value))
    return torch.where(inner, out, value)


def view_distances(
    points: torch.Tensor, maps: MapArrays, view: int, voxel: float, truncation: float, gap: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance (N,) that one view gives to points (N, 3), NaN where it says nothing, and its weight (N,)."""
    q = camera_axes(maps, view, points)
    x, y, inside = pixels_of(maps, view, q)
    width, height = maps.size[view].tolist()
    place = int(maps.first[view]) + y.clamp(0, height - 1).long() * width + x.clamp(0, width - 1).long()
    depth = read_depth(maps, view, x, y, gap)
    far, cosine = q.norm(dim=1), maps.cosine[place]
    d = (depth - q[:, 2]) * far / q[:, 2] * cosine
    sure = (voxel / maps.spread[place].clamp(min=1e-6)).clamp(max=1)
    weight = sure**2 * cosine * (maps.lens[view, 0] / q[:, 2]) ** 2 * (1 + d.clamp(max=0) / truncation) ** 2
    usable = inside & (depth > 0) & (d > -truncation)
    return torch.where(usable, d.clamp(max=truncation), torch.nan), torch.where(usable, weight, 0.0)


def fuse(
    points: torch.Tensor, maps: MapArrays, voxel: float, truncation: float, free_at: float, gap: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """As `surface.fuse`."""
    pairs = [view_distances(points, maps, v, voxel, truncation, gap) for v in range(len(maps))]
    distance, weight = torch.stack([d for d, _ in pairs]), torch.stack([w for _, w in pairs])
    seen = ~distance.isnan()
    value = torch.where(seen, distance, 0.0)
    through = seen & (value > free_at)
    free = through.sum(0)
    weight = torch.where(through, 0.1 * weight, weight)
    outer = weight * (value >= 0)
    inner = weight - outer
    behind = -(inner * value).sum(0) / inner.sum(0).clamp(min=1e-30)
    thin = (free >= 2) & (free >= 0.15 * seen.sum(0)) & (outer.sum(0) > 0) & (behind > free_at)
    used = torch.where(thin, outer, weight)
    total = used.sum(0)
    fused = torch.where(total > 0, (used * value).sum(0) / total.clamp(min=1e-30), 0.0)
    return fused, total


def agreement(maps: MapArrays, view: int, neighbours: list[int], share: float, pixels: float) -> torch.Tensor:
    """As `surface.agreement`."""
    width, height = maps.size[view].tolist()
    z = maps.depth[int(maps.first[view]) :][: width * height]
    pixel = torch.arange(width * height)
    x, y = pixel % width + 0.5, pixel // width + 0.5
    points = unprojected(maps, view, x, y, z)
    found = torch.zeros(len(z), dtype=torch.int32)
    for other in neighbours:
        q = camera_axes(maps, other, points)
        ox, oy, inside = pixels_of(maps, other, q)
        value = read_depth(maps, other, ox, oy, LOOKED_UP)
        back = camera_axes(maps, view, unprojected(maps, other, ox, oy, value))
        bx, by, _ = pixels_of(maps, view, back)
        near = (back[:, 2] > 1e-4) & ((bx - x) ** 2 + (by - y) ** 2 < pixels**2)
        found += inside & (value > 0) & (value < FREE) & ((value - q[:, 2]).abs() < share * q[:, 2]) & near
    return torch.where((z > 0) & (z < FREE), found, 0)


def able_views(maps: MapArrays, view: int, neighbours: list[int], share: float) -> torch.Tensor:
    """As `surface.able_views`."""
    width, height = maps.size[view].tolist()
    z = maps.depth[int(maps.first[view]) :][: width * height]
    pixel = torch.arange(width * height)
    points = unprojected(maps, view, pixel % width + 0.5, pixel // width + 0.5, z)
    able = torch.zeros(len(z), dtype=torch.int32)
    for other in neighbours:
        q = camera_axes(maps, other, points)
        x, y, inside = pixels_of(maps, other, q)
        value = read_depth(maps, other, x, y, LOOKED_UP)
        able += inside & (value >= 0) & ~((value > 0) & (value <= (1 - share) * q[:, 2]))
    return torch.where((z > 0) & (z < FREE), able, 0)


def sight(points: torch.Tensor, normals: torch.Tensor, maps: MapArrays, tolerance: float) -> torch.Tensor:
    """As `surface.sight`."""
    columns = []
    for view in range(len(maps)):
        q = camera_axes(maps, view, points)
        x, y, inside = pixels_of(maps, view, q)
        depth = read_depth(maps, view, x, y, LOOKED_UP)
        center = -maps.translation[view] @ maps.rotation[view]
        facing = (normals * torch.nn.functional.normalize(center - points, dim=1)).sum(1)
        shown = inside & (depth > 0) & (facing > 0) & ((q[:, 2] - depth).abs() < tolerance)
        columns.append(torch.where(shown, facing * (maps.lens[view, 0] / q[:, 2]) ** 2, 0.0))
    return torch.stack(columns, 1)


def slopes(
    points: torch.Tensor, normals: torch.Tensor, maps: MapArrays, tolerance: float, turned: float
) -> torch.Tensor:
    """As `surface.slopes`."""
    counts = torch.zeros(len(points), 2)
    for view in range(len(maps)):
        q = camera_axes(maps, view, points)
        x, y, inside = pixels_of(maps, view, q)
        depth = read_depth(maps, view, x, y, LOOKED_UP)
        center = -maps.translation[view] @ maps.rotation[view]
        facing = (normals * torch.nn.functional.normalize(center - points, dim=1)).sum(1).clamp(-1, 1)
        width, height = maps.size[view].tolist()
        column, row = x.nan_to_num().floor().clamp(0, width - 1), y.nan_to_num().floor().clamp(0, height - 1)
        place = (maps.first[view] + row * width + column).long()
        cosine, sure = maps.cosine[place], maps.certain[place] > 0.5
        near = inside & (depth > 0) & ((q[:, 2] - depth).abs() < tolerance)
        own = near & (facing > 0) & ((facing.acos() - cosine.clamp(max=1).acos()).abs() <= turned)
        counts += torch.stack([own, near & ~own & sure], 1)
    return counts
