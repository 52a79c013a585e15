"""From rays to a surface: depths at which rays end, depth maps that confirm each other, distances fused from them.

Depth maps are pinhole images, one behind the other in flat arrays: `depth` (P,) along the optical axis, 0 where unknown
and `FREE` where a ray meets nothing. Devices without Warp leave all but the depths of rays to the host; the torch twins
that tests compare with are in `surface_torch.py`.
"""

from __future__ import annotations

import torch
import warp as wp

from . import surface_torch
from .depth_arrays import MapArrays
from .device import backend_of
from .packed_info import PackedInfo
from .runtime import array, init, launch


@wp.kernel(module="fieldwork_surface")
def quantile_kernel(
    density: wp.array(dtype=float),
    deltas: wp.array(dtype=float),
    t: wp.array(dtype=float),
    starts: wp.array(dtype=int),
    counts: wp.array(dtype=int),
    out: wp.array(dtype=wp.vec4),
    offset: int,
):
    r = wp.tid() + offset
    near = float(0.0)
    middle = float(0.0)
    far = float(0.0)
    passed = float(0.0)  # optical depth
    base = starts[r]
    for k in range(base, base + counts[r]):
        own = density[k] * deltas[k]
        begin = t[k] - 0.5 * deltas[k]
        if own > 0.0:
            # T falls to q at optical depth −ln q: 0.2877 at 3/4, 0.6931 at 1/2, 1.3863 at 1/4.
            if passed < 0.28768 and passed + own >= 0.28768:
                near = begin + (0.28768 - passed) / density[k]
            if passed < 0.69315 and passed + own >= 0.69315:
                middle = begin + (0.69315 - passed) / density[k]
            if passed < 1.38629 and passed + own >= 1.38629:
                far = begin + (1.38629 - passed) / density[k]
        passed += own
    out[r] = wp.vec4(near, middle, far, 1.0 - wp.exp(-passed))


def depth_quantiles(
    density: torch.Tensor, deltas: torch.Tensor, t: torch.Tensor, packed_info: PackedInfo
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Where the transmittance of rays passes 3/4, 1/2 and 1/4, and their opacity, each (R,).

    density, deltas, t (N,) of packed samples as in `march.Samples`; a sample stands for the stretch `deltas` around it.
    Distances are 0 where the ray does not become so opaque.
    """
    if not backend_of(density.device).warp:
        return surface_torch.depth_quantiles(density, deltas, t, packed_info)
    init()
    rays = len(packed_info.starts)
    out = torch.empty(rays, 4, device=density.device)
    inputs = [array(density.contiguous()), array(deltas), array(t), array(packed_info.starts)]
    launch(quantile_kernel, rays, [*inputs, array(packed_info.counts), array(out, wp.vec4)], density.device)
    near, middle, far, opacity = out.unbind(1)
    return near, middle, far, opacity


@wp.func
def read_depth(depth: wp.array(dtype=float), first: int, width: int, height: int, x: float, y: float, gap: float):
    """Depth at pixel coordinates: interpolated (in 1/z, in which planes are linear) where the four pixels around lie
    within the share `gap` of each other; at an outline the nearest pixel's if it is in front, else unknown: half a pixel
    beside an outline nobody knows what is behind. And the nearest pixel's place."""
    column = wp.clamp(int(wp.floor(x)), 0, width - 1)
    row = wp.clamp(int(wp.floor(y)), 0, height - 1)
    place = first + row * width + column
    value = depth[place]
    x0 = int(wp.floor(x - 0.5))
    y0 = int(wp.floor(y - 0.5))
    if x0 >= 0 and y0 >= 0 and x0 + 1 < width and y0 + 1 < height and value > 0.0:
        corner = first + y0 * width + x0
        a = depth[corner]
        b = depth[corner + 1]
        c = depth[corner + width]
        d = depth[corner + width + 1]
        low = wp.min(wp.min(a, b), wp.min(c, d))
        high = wp.max(wp.max(a, b), wp.max(c, d))
        if value - low >= gap * low:
            value = 0.0
        elif low > 0.0 and high - low < gap * low:
            fx = x - 0.5 - float(x0)
            fy = y - 0.5 - float(y0)
            upper = (1.0 - fx) / a + fx / b
            lower = (1.0 - fx) / c + fx / d
            value = 1.0 / ((1.0 - fy) * upper + fy * lower)
    return value, place


@wp.kernel(module="fieldwork_surface")
def fuse_kernel(
    points: wp.array(dtype=wp.vec3),
    depth: wp.array(dtype=float),
    cosine: wp.array(dtype=float),
    spread: wp.array(dtype=float),
    first: wp.array(dtype=int),
    size: wp.array(dtype=int, ndim=2),
    lens: wp.array(dtype=wp.vec4),
    rotation: wp.array(dtype=wp.mat33),
    translation: wp.array(dtype=wp.vec3),
    views: int,
    voxel: float,
    truncation: float,
    free_at: float,
    gap: float,
    apart: float,
    distance: wp.array(dtype=float),
    weight: wp.array(dtype=float),
    known: wp.array(dtype=wp.uint8),
    offset: int,
):
    i = wp.tid() + offset
    p = points[i]
    total = float(0.0)
    total_weight = float(0.0)
    outer = float(0.0)  # the same of non-negative distances alone
    outer_weight = float(0.0)
    seen = int(0)
    free = int(0)
    direction = wp.vec3(0.0, 0.0, 0.0)
    wide = int(0)
    for v in range(views):
        q = rotation[v] * p + translation[v]
        if q[2] > 1e-4:
            l = lens[v]
            x = l[0] * q[0] / q[2] + l[2]
            y = l[1] * q[1] / q[2] + l[3]
            width = size[v, 0]
            height = size[v, 1]
            if x >= 0.0 and y >= 0.0 and x < float(width) and y < float(height):
                value, place = read_depth(depth, first[v], width, height, x, y, gap)
                if value > 0.0:
                    far = wp.length(q)
                    d = (value - q[2]) * far / q[2] * cosine[place]
                    if d > -truncation:
                        scale = l[0] / q[2]
                        sure = wp.min(1.0, voxel / wp.max(spread[place], 1e-6))
                        w = sure * sure * cosine[place] * scale * scale
                        if d < 0.0:
                            behind = 1.0 + d / truncation
                            w *= behind * behind
                        d = wp.min(d, truncation)
                        seen += 1
                        if d > free_at:
                            free += 1
                            w *= 0.1
                        total += w * d
                        total_weight += w
                        if d >= 0.0:
                            outer += w * d
                            outer_weight += w
                        ray = wp.transpose(rotation[v]) * q / far
                        if seen == 1:
                            direction = ray
                        elif wp.dot(direction, ray) < apart:
                            wide = 1
    # A thin sheet: enough views look through this place, so what others see behind it is another side.
    if free >= 2 and float(free) >= 0.15 * float(seen) and outer_weight > 0.0:
        total = outer
        total_weight = outer_weight
    value_out = float(0.0)
    if total_weight > 0.0:
        value_out = total / total_weight
    distance[i] = value_out
    weight[i] = total_weight
    known[i] = wp.uint8(wide)


def fuse(
    points: torch.Tensor, maps: MapArrays, voxel: float, truncation: float, free_at: float, gap: float, apart: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Signed distance (N,) of points (N, 3) from the surface that depth maps show, positive in front of it, its weight
    (N,), and whether (N,) uint8 two views whose directions differ by more than arccos(`apart`) see the point.

    A view's distance is (D − z) · ‖q‖/z · cos θ, from the point q in camera axes along the ray to the surface and from
    there to its plane; beyond `truncation` behind the surface the view says nothing. Weights: cos θ (f/z)² ·
    min(1, voxel/spread)², falling off quadratically behind the surface, a tenth where a view looks
    through: that it does so says little about where the surface is. Where at least two views and 15 % of those that see a point find it more
    than `free_at` in front of their surface, only non-negative distances count: both sides of thin sheets remain.
    `gap`: share by which depths of neighbouring pixels may differ and still be interpolated.
    """
    init()
    device, count = points.device, len(points)
    distance, weight = torch.empty(count, device=device), torch.empty(count, device=device)
    known = torch.empty(count, dtype=torch.uint8, device=device)
    inputs = [array(points.contiguous(), wp.vec3), array(maps.depth), array(maps.cosine), array(maps.spread)]
    inputs += [*maps.cameras(), len(maps), voxel, truncation, free_at, gap, apart]
    launch(fuse_kernel, count, [*inputs, array(distance), array(weight), array(known)], device)
    return distance, weight, known


@wp.kernel(module="fieldwork_surface")
def agree_kernel(
    depth: wp.array(dtype=float),
    first: wp.array(dtype=int),
    size: wp.array(dtype=int, ndim=2),
    lens: wp.array(dtype=wp.vec4),
    rotation: wp.array(dtype=wp.mat33),
    translation: wp.array(dtype=wp.vec3),
    view: int,
    neighbours: wp.array(dtype=int),
    amount: int,
    share: float,
    pixels: float,
    out: wp.array(dtype=int),
    offset: int,
):
    i = wp.tid() + offset
    out[i] = 0
    z = depth[first[view] + i]
    if z <= 0.0 or z > 1e29:
        return
    l = lens[view]
    x = float(i % size[view, 0]) + 0.5
    y = float(i / size[view, 0]) + 0.5
    q = wp.vec3((x - l[2]) / l[0] * z, (y - l[3]) / l[1] * z, z)
    p = wp.transpose(rotation[view]) * (q - translation[view])
    found = int(0)
    for n in range(amount):
        v = neighbours[n]
        o = rotation[v] * p + translation[v]
        if o[2] > 1e-4:
            m = lens[v]
            ox = m[0] * o[0] / o[2] + m[2]
            oy = m[1] * o[1] / o[2] + m[3]
            if ox >= 0.0 and oy >= 0.0 and ox < float(size[v, 0]) and oy < float(size[v, 1]):
                value, _ = read_depth(depth, first[v], size[v, 0], size[v, 1], ox, oy, 0.05)
                if value > 0.0 and value < 1e29 and wp.abs(value - o[2]) < share * o[2]:
                    back = wp.vec3((ox - m[2]) / m[0] * value, (oy - m[3]) / m[1] * value, value)
                    b = rotation[view] * (wp.transpose(rotation[v]) * (back - translation[v])) + translation[view]
                    if b[2] > 1e-4:
                        bx = l[0] * b[0] / b[2] + l[2] - x
                        by = l[1] * b[1] / b[2] + l[3] - y
                        if bx * bx + by * by < pixels * pixels:
                            found += 1
    out[i] = found


def agreement(maps: MapArrays, view: int, neighbours: torch.Tensor, share: float, pixels: float) -> torch.Tensor:
    """How many of the maps `neighbours` (K,) int32 confirm each pixel (H·W,) int32 of one map: their depth there
    differs by less than `share`, and its point returns to within `pixels` of the pixel."""
    init()
    count = int(maps.size[view].prod())
    out = torch.empty(count, dtype=torch.int32, device=maps.depth.device)
    inputs = [array(maps.depth), *maps.cameras(), view, array(neighbours), len(neighbours), share, pixels, array(out)]
    launch(agree_kernel, count, inputs, maps.depth.device)
    return out


@wp.kernel(module="fieldwork_surface")
def sight_kernel(
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    depth: wp.array(dtype=float),
    first: wp.array(dtype=int),
    size: wp.array(dtype=int, ndim=2),
    lens: wp.array(dtype=wp.vec4),
    rotation: wp.array(dtype=wp.mat33),
    translation: wp.array(dtype=wp.vec3),
    views: int,
    tolerance: float,
    out: wp.array(dtype=float, ndim=2),
    offset: int,
):
    i = wp.tid() + offset
    p = points[i]
    n = normals[i]
    for v in range(views):
        out[i, v] = 0.0
        q = rotation[v] * p + translation[v]
        if q[2] > 1e-4:
            l = lens[v]
            x = l[0] * q[0] / q[2] + l[2]
            y = l[1] * q[1] / q[2] + l[3]
            width = size[v, 0]
            height = size[v, 1]
            if x >= 0.0 and y >= 0.0 and x < float(width) and y < float(height):
                value, _ = read_depth(depth, first[v], width, height, x, y, 0.05)
                far = wp.length(q)
                facing = -wp.dot(n, wp.transpose(rotation[v]) * q) / far
                if value > 0.0 and facing > 0.0 and wp.abs(q[2] - value) < tolerance:
                    scale = l[0] / q[2]
                    out[i, v] = facing * scale * scale


def sight(points: torch.Tensor, normals: torch.Tensor, maps: MapArrays, tolerance: float) -> torch.Tensor:
    """How well each view sees surface points: (N, V) cos θ (f/z)² in pixels per unit area of the frame, 0 where the
    point faces away, lies outside the picture or not within `tolerance` of what the view shows."""
    init()
    out = torch.empty(len(points), len(maps), device=points.device)
    inputs = [array(points.contiguous(), wp.vec3), array(normals.contiguous(), wp.vec3), array(maps.depth)]
    launch(sight_kernel, len(points), [*inputs, *maps.cameras(), len(maps), tolerance, array(out)], points.device)
    return out
