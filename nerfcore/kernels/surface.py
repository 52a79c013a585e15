"""From rays to a surface: depths at which rays end, depth maps that confirm each other, distances fused from them.

Depth maps are pinhole images, one behind the other in flat arrays: `depth` (P,) along the optical axis, 0 where unknown
and `FREE` where a ray meets nothing. Devices without Warp leave all but the depths of rays (`surface_torch.py`) to the
host.
"""

from __future__ import annotations

import torch
import warp as wp

from . import surface_torch
from .depth_arrays import MapArrays
from .device import backend_of
from .packed_info import PackedInfo
from .projection import FARTHEST, NEAREST, Maps, map_struct, pixel_ray, project, read_depth, seen_at
from .runtime import array, init, launch

NOWHERE = wp.constant(1.0e30)  # squared distance in pixels of what lies behind a camera
GAP = wp.constant(0.05)  # share by which depths of neighbouring pixels may differ where a point is only looked up
LOOKS_THROUGH = wp.constant(0.1)  # weight of a view that looks through a place, see `fuse`
FEWEST_THROUGH = wp.constant(2)  # views that make a sheet thin, and
THROUGH_SHARE = wp.constant(0.15)  # their share of those that see a place


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


@wp.struct
class FusionParams:
    """See `fuse`."""

    voxel: float
    truncation: float
    free_at: float
    gap: float


@wp.struct
class Fused:
    """What the views said of a point so far."""

    distance: float  # sum of weight times distance
    weight: float
    outer: float  # the same of non-negative distances alone
    outer_weight: float
    seen: int  # views
    free: int  # views that look through


@wp.func
def view_distance(maps: Maps, view: int, p: wp.vec3, f: FusionParams):
    """Whether a view says something of a point of the frame (1 or 0), its distance, and its weight."""
    known = int(0)
    distance = float(0.0)
    weight = float(0.0)
    q, pixel, inside = seen_at(maps, view, p)
    if inside:
        depth, place = read_depth(maps, view, pixel, f.gap)
        if depth > 0.0:
            far = wp.length(q)
            distance = (depth - q[2]) * far / q[2] * maps.cosine[place]
            if distance > -f.truncation:
                known = 1
                scale = maps.lens[view][0] / q[2]
                sure = wp.min(1.0, f.voxel / wp.max(maps.spread[place], 1e-6))
                weight = sure * sure * maps.cosine[place] * scale * scale
                if distance < 0.0:
                    behind = 1.0 + distance / f.truncation
                    weight *= behind * behind
                distance = wp.min(distance, f.truncation)
    return known, distance, weight


@wp.func
def with_view(fused: Fused, distance: float, weight: float, f: FusionParams):
    """What is known of a point after one more view."""
    w = float(weight)
    fused.seen += 1
    if distance > f.free_at:
        fused.free += 1
        w *= LOOKS_THROUGH
    fused.distance += w * distance
    fused.weight += w
    if distance >= 0.0:
        fused.outer += w * distance
        fused.outer_weight += w
    return fused


@wp.kernel(module="fieldwork_surface")
def fuse_kernel(
    points: wp.array(dtype=wp.vec3),
    maps: Maps,
    f: FusionParams,
    distance: wp.array(dtype=float),
    weight: wp.array(dtype=float),
    offset: int,
):
    i = wp.tid() + offset
    p = points[i]
    fused = Fused()
    for v in range(maps.first.shape[0]):
        seen, d, w = view_distance(maps, v, p, f)
        if seen == 1:
            fused = with_view(fused, d, w, f)
    total = fused.distance
    total_weight = fused.weight
    behind = float(0.0)  # how far this place lies behind the surfaces of those that have it inside, on average
    if fused.weight > fused.outer_weight:
        behind = (fused.outer - fused.distance) / (fused.weight - fused.outer_weight)
    # A thin sheet: enough views look through this place, so what others see before it is another side. Where that is
    # close, views contradict each other: some have what is behind a wire in the wire's place.
    through = fused.free >= FEWEST_THROUGH and float(fused.free) >= THROUGH_SHARE * float(fused.seen)
    through = through and behind > f.free_at
    if through and fused.outer_weight > 0.0:
        total = fused.outer
        total_weight = fused.outer_weight
    mean = float(0.0)
    if total_weight > 0.0:
        mean = total / total_weight
    distance[i] = mean
    weight[i] = total_weight


def fuse(
    points: torch.Tensor, maps: MapArrays, voxel: float, truncation: float, free_at: float, gap: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Signed distance (N,) of points (N, 3) from the surface that depth maps show, positive in front of it, and its weight
    (N,), 0 where no view says anything.

    A view's distance is (D − z) · ‖q‖/z · cos θ, from the point q in camera axes along the ray to the surface and from
    there to its plane; beyond `truncation` behind the surface the view says nothing. Weights: cos θ (f/z)² ·
    min(1, voxel/spread)², falling off quadratically behind the surface, a tenth where a view looks through: that it
    does so says little about where the surface is. Where at least two views and 15 % of those that see a point find it
    more than `free_at` in front of their surface, and those that have it behind theirs have it farther behind than that on
    average, only non-negative distances count: both sides of thin sheets remain, and wires that some views miss.
    `gap`: share by which depths of neighbouring pixels may differ and still be interpolated.
    """
    init()
    device, count = points.device, len(points)
    distance, weight = torch.empty(count, device=device), torch.empty(count, device=device)
    f = FusionParams()
    f.voxel, f.truncation, f.free_at, f.gap = voxel, truncation, free_at, gap
    inputs = [array(points.contiguous(), wp.vec3), map_struct(maps), f, array(distance), array(weight)]
    launch(fuse_kernel, count, inputs, device)
    return distance, weight


@wp.func
def point_at(maps: Maps, view: int, pixel: wp.vec2, depth: float):
    """The point of the frame that a view's pixel shows at a depth."""
    ray = pixel_ray(maps.lens[view], pixel[0], pixel[1])
    q = wp.vec3(ray[0] * depth, ray[1] * depth, depth)
    return wp.transpose(maps.rotation[view]) * (q - maps.translation[view])


@wp.func
def returns_to(maps: Maps, view: int, pixel: wp.vec2, other: int, place: wp.vec2, depth: float):
    """Distance in pixels, squared, of a view's pixel from where that view sees what another one shows at `place`,
    `depth` from its camera."""
    p = point_at(maps, other, place, depth)
    back = maps.rotation[view] * p + maps.translation[view]
    apart = float(NOWHERE)
    if back[2] > NEAREST:
        off = project(maps.lens[view], back)
        dx = off[0] - pixel[0]
        dy = off[1] - pixel[1]
        apart = dx * dx + dy * dy
    return apart


@wp.kernel(module="fieldwork_surface")
def agree_kernel(
    maps: Maps,
    view: int,
    neighbours: wp.array(dtype=int),
    share: float,
    pixels: float,
    enough: int,
    out: wp.array(dtype=int),
    offset: int,
):
    i = wp.tid() + offset
    out[i] = 0
    z = maps.depth[maps.first[view] + i]
    if z <= 0.0 or z > FARTHEST:
        return
    pixel = wp.vec2(float(i % maps.size[view, 0]) + 0.5, float(i / maps.size[view, 0]) + 0.5)
    p = point_at(maps, view, pixel, z)
    found = int(0)
    for n in range(neighbours.shape[0]):
        if found >= enough:
            break
        v = neighbours[n]
        o, place, inside = seen_at(maps, v, p)
        if inside:
            depth, _ = read_depth(maps, v, place, GAP)
            same = depth > 0.0 and depth < FARTHEST and wp.abs(depth - o[2]) < share * o[2]
            if same and returns_to(maps, view, pixel, v, place, depth) < pixels * pixels:
                found += 1
    out[i] = found


def agreement(
    maps: MapArrays, view: int, neighbours: torch.Tensor, share: float, pixels: float, enough: int = 1 << 30
) -> torch.Tensor:
    """How many of the maps `neighbours` (K,) int32 confirm each pixel (H·W,) int32 of one map: their depth there
    differs by less than `share`, and its point returns to within `pixels` of the pixel. Counted no farther than to
    `enough`."""
    init()
    count = int(maps.size[view].prod())
    out = torch.empty(count, dtype=torch.int32, device=maps.depth.device)
    inputs = [map_struct(maps), view, array(neighbours), share, pixels, enough, array(out)]
    launch(agree_kernel, count, inputs, maps.depth.device)
    return out


@wp.kernel(module="fieldwork_surface")
def able_kernel(
    maps: Maps,
    view: int,
    neighbours: wp.array(dtype=int),
    share: float,
    enough: int,
    out: wp.array(dtype=int),
    offset: int,
):
    i = wp.tid() + offset
    out[i] = 0
    z = maps.depth[maps.first[view] + i]
    if z <= 0.0 or z > FARTHEST:
        return
    pixel = wp.vec2(float(i % maps.size[view, 0]) + 0.5, float(i / maps.size[view, 0]) + 0.5)
    p = point_at(maps, view, pixel, z)
    able = int(0)
    for n in range(neighbours.shape[0]):
        if able >= enough:
            break
        v = neighbours[n]
        o, place, inside = seen_at(maps, v, p)
        if inside:
            depth, _ = read_depth(maps, v, place, GAP)
            if depth == 0.0 or depth > (1.0 - share) * o[2]:
                able += 1
    out[i] = able


def able_views(
    maps: MapArrays, view: int, neighbours: torch.Tensor, share: float, enough: int = 1 << 30
) -> torch.Tensor:
    """How many of the maps `neighbours` (K,) int32 could show what each pixel (H·W,) int32 of one map does: it lies in their
    photo (their depths are below 0 beside it), and nothing they know is nearer there by more than `share`. Counted no
    farther than to `enough`."""
    init()
    count = int(maps.size[view].prod())
    out = torch.empty(count, dtype=torch.int32, device=maps.depth.device)
    inputs = [map_struct(maps), view, array(neighbours), share, enough, array(out)]
    launch(able_kernel, count, inputs, maps.depth.device)
    return out


@wp.kernel(module="fieldwork_surface")
def sight_kernel(
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    maps: Maps,
    tolerance: float,
    out: wp.array(dtype=float, ndim=2),
    offset: int,
):
    i = wp.tid() + offset
    p = points[i]
    n = normals[i]
    for v in range(maps.first.shape[0]):
        out[i, v] = 0.0
        q, pixel, inside = seen_at(maps, v, p)
        if inside:
            depth, _ = read_depth(maps, v, pixel, GAP)
            facing = -wp.dot(n, wp.transpose(maps.rotation[v]) * q) / wp.length(q)
            if depth > 0.0 and facing > 0.0 and wp.abs(q[2] - depth) < tolerance:
                scale = maps.lens[v][0] / q[2]
                out[i, v] = facing * scale * scale


def sight(points: torch.Tensor, normals: torch.Tensor, maps: MapArrays, tolerance: float) -> torch.Tensor:
    """How well each view sees surface points: (N, V) cos θ (f/z)² in pixels per unit area of the frame, 0 where the
    point faces away, lies outside the picture or not within `tolerance` of what the view shows."""
    init()
    out = torch.empty(len(points), len(maps), device=points.device)
    inputs = [array(points.contiguous(), wp.vec3), array(normals.contiguous(), wp.vec3)]
    launch(sight_kernel, len(points), [*inputs, map_struct(maps), tolerance, array(out)], points.device)
    return out


@wp.kernel(module="fieldwork_surface")
def slopes_kernel(
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    maps: Maps,
    tolerance: float,
    turned: float,
    out: wp.array(dtype=wp.vec2),
    offset: int,
):
    i = wp.tid() + offset
    p = points[i]
    n = normals[i]
    own = float(0.0)
    other = float(0.0)
    for v in range(maps.first.shape[0]):
        q, pixel, inside = seen_at(maps, v, p)
        if inside:
            depth, place = read_depth(maps, v, pixel, GAP)
            if depth > 0.0 and wp.abs(q[2] - depth) < tolerance:
                facing = wp.clamp(-wp.dot(n, wp.transpose(maps.rotation[v]) * q) / wp.length(q), -1.0, 1.0)
                shown = wp.acos(wp.min(maps.cosine[place], 1.0))
                if facing > 0.0 and wp.abs(wp.acos(facing) - shown) <= turned:
                    own += 1.0
                elif maps.certain[place] > 0.5:
                    other += 1.0
    out[i] = wp.vec2(own, other)


def slopes(
    points: torch.Tensor, normals: torch.Tensor, maps: MapArrays, tolerance: float, turned: float
) -> torch.Tensor:
    """How many views show something within `tolerance` of surface points (N, 3) that is as steep to their ray as the point
    with its normal (N, 3), to `turned` (radians), and how many something that is not and whose slope is certain: (N, 2)."""
    init()
    out = torch.empty(len(points), 2, device=points.device)
    inputs = [array(points.contiguous(), wp.vec3), array(normals.contiguous(), wp.vec3)]
    launch(
        slopes_kernel, len(points), [*inputs, map_struct(maps), tolerance, turned, array(out, wp.vec2)], points.device
    )
    return out
