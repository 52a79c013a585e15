"""Depths that photos agree on best: small slanted patches compared between views by normalised cross-correlation.

The idea is that of multi-view stereo by plane sweeping (Goesele et al., "Multi-view stereo for community photo
collections", 2007), begun at the depth a field gives. A patch lies on the plane through a pixel's point with its normal;
where it lies in another view is an affine map there. Cameras and depths are those of `projection.Maps`.
"""

from __future__ import annotations

import torch
import warp as wp

from .depth_arrays import MapArrays
from .patch_sums import Patch, Window, corner, patch_sums, patch_sums_host
from .projection import FARTHEST, NEAREST, Maps, map_struct, pixel_ray, project
from .runtime import array, init, launch

REACH = wp.constant(4)  # a patch has 5 × 5 pixels, two apart: it reaches four pixels from its middle
FLAT = wp.constant(2.0e-5)  # variance of grey values in [0, 1] below which a patch shows nothing
EVEN = wp.constant(1.0e-6)  # variance up to which a window of another view says nothing
STEEPEST = wp.constant(1.0e-2)  # of the normal along the ray: a surface seen more along is not compared
WIDEST = wp.constant(24.0)  # pixels a patch may reach in another view
MIDDLE = wp.constant(6)  # of 13 depths, every second of which is tried, and both beside the best of these
UNSEEN = wp.constant(-2.0)  # correlation with a view that does not show the patch

_tries = wp.types.vector(length=13, dtype=float)
_seven = wp.types.vector(length=7, dtype=float)
_best = wp.types.matrix(shape=(7, 3), dtype=float)


@wp.struct
class RefineParams:
    """See `refine`; turn and shift lead from the view's camera axes into those of its neighbours; host: 1 where the CPU's
    compiler sums up patches."""

    view: int
    neighbours: wp.array(dtype=int)
    turn: wp.array(dtype=wp.mat33)
    shift: wp.array(dtype=wp.vec3)
    least: float
    gain: float
    host: int


@wp.struct
class Pixel:
    """Three places of a patch in camera axes, on the plane through its pixel at depth 1: the pixel itself, and what lies
    four pixels right of it and below."""

    middle: wp.vec3
    right: wp.vec3
    below: wp.vec3


@wp.struct
class Other:
    """The same three places in the camera axes of another view, for depth 1 and without the way between the cameras,
    `shift`: at depth z a place is there z times as much, and the shift."""

    first: int
    width: int
    height: int
    lens: wp.vec4
    middle: wp.vec3
    right: wp.vec3
    below: wp.vec3
    shift: wp.vec3


@wp.func
def read_patch(quads: wp.array(dtype=wp.uint64), maps: Maps, view: int, column: int, row: int):
    """The patch around a pixel of a view."""
    patch = Patch()
    mean = float(0.0)
    square = float(0.0)
    for k in range(25):
        place = (row + (k / 5 - 2) * 2) * maps.size[view, 0] + column + (k % 5 - 2) * 2
        g = corner(quads[maps.first[view] + place], 0)
        patch.values[k] = g
        mean += g
        square += g * g
    mean /= 25.0
    patch.mean = mean
    patch.variance = square / 25.0 - mean * mean
    return patch


@wp.func
def on_plane(lens: wp.vec4, x: float, y: float, normal: wp.vec3, along: float):
    """Where the ray of a pixel meets the plane with this normal and the distance `along` from the camera."""
    r = pixel_ray(lens, x, y)
    return r * (along / wp.min(wp.dot(normal, r), -1e-3))


@wp.func
def other_view(maps: Maps, params: RefineParams, m: int, pixel: Pixel):
    turn = params.turn[m]
    other = Other()
    view = params.neighbours[m]
    other.first = maps.first[view]
    other.width = maps.size[view, 0]
    other.height = maps.size[view, 1]
    other.lens = maps.lens[view]
    other.middle = turn * pixel.middle
    other.right = turn * pixel.right
    other.below = turn * pixel.below
    other.shift = params.shift[m]
    return other


@wp.func
def place_at(lens: wp.vec4, way: wp.vec3, shift: wp.vec3, z: float):
    """Pixel coordinates of a place (see `Other`), and its depth."""
    q = way * z + shift
    place = project(lens, wp.vec3(q[0], q[1], wp.max(q[2], 1e-6)))
    return wp.vec3(place[0], place[1], q[2])


@wp.func
def pixels_per_depth(maps: Maps, params: RefineParams, pixel: Pixel, z: float):
    """How many pixels a step in depth moves the point in other views, in the mean; 0 where that is not known."""
    rate = float(0.0)
    valid = float(0.0)
    for m in range(params.neighbours.shape[0]):
        lens = maps.lens[params.neighbours[m]]
        way = params.turn[m] * pixel.middle
        a = place_at(lens, way, params.shift[m], z)
        b = place_at(lens, way, params.shift[m], z * 1.01)
        if a[2] > NEAREST:
            rate += wp.sqrt((a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1])) / (0.01 * z)
            valid += 1.0
    mean = float(0.0)
    if valid >= 1.0 and rate >= 1e-6:
        mean = rate / valid
    return mean


@wp.func
def correlation(quads: wp.array(dtype=wp.uint64), patch: Patch, other: Other, z: float, host: int):
    """Normalised cross-correlation of a patch with another view, were the pixel's depth z; `UNSEEN` where the patch
    leaves the picture or is stretched too far."""
    middle = place_at(other.lens, other.middle, other.shift, z)
    right = place_at(other.lens, other.right, other.shift, z)
    below = place_at(other.lens, other.below, other.shift, z)
    ax = (right[0] - middle[0]) * 0.5
    ay = (right[1] - middle[1]) * 0.5
    bx = (below[0] - middle[0]) * 0.5
    by = (below[1] - middle[1]) * 0.5
    reach_x = 2.0 * (wp.abs(ax) + wp.abs(bx)) + 1.0
    reach_y = 2.0 * (wp.abs(ay) + wp.abs(by)) + 1.0
    inside = z > NEAREST and middle[2] > NEAREST and middle[0] > reach_x and middle[1] > reach_y
    inside = inside and middle[0] < float(other.width) - reach_x and middle[1] < float(other.height) - reach_y
    result = float(UNSEEN)
    if inside and reach_x < WIDEST and reach_y < WIDEST:
        w = Window()
        w.first = other.first
        w.width = other.width
        w.x = middle[0] - 0.5
        w.y = middle[1] - 0.5
        w.ax = ax
        w.ay = ay
        w.bx = bx
        w.by = by
        sums = wp.vec3()
        if host == 1:
            sums = patch_sums_host(quads, w, patch)
        else:
            sums = patch_sums(quads, w, patch)
        mean = sums[0] / 25.0
        variance = sums[1] / 25.0 - mean * mean
        result = float(0.0)
        if variance > EVEN:  # below it this is rounding
            result = (sums[2] / 25.0 - mean * patch.mean) / wp.sqrt(variance * patch.variance)
    return result


@wp.func
def best_try(tries: _tries, least: float, gain: float):
    """The best of the depths tried, and how far from the middle one the peak lies, in steps: 0 where the photos do not
    say it clearly (see `refine`)."""
    best = int(MIDDLE)
    for t in range(13):
        if tries[t] > tries[best]:
            best = t
    peak = float(0.0)
    moved = wp.abs(float(best - MIDDLE)) > 1.5
    believed = tries[best] >= least and not (moved and tries[best] - tries[MIDDLE] < gain)
    if believed and best > 0 and best < 12:
        curve = tries[best - 1] - 2.0 * tries[best] + tries[best + 1]
        fine = float(0.0)
        if curve < -1e-6:
            fine = wp.clamp(0.5 * (tries[best - 1] - tries[best + 1]) / curve, -0.5, 0.5)
        peak = float(best - MIDDLE) + fine
    return best, peak


@wp.func
def photo_agreement(
    quads: wp.array(dtype=wp.uint64), maps: Maps, params: RefineParams, patch: Patch, pixel: Pixel,
    z: float, step: float, count: int,
):  # fmt: skip
    """Mean correlation of the three views that agree best, or of the fewer whose pictures show the place, −1 where none
    does, at `count` depths, at most seven, of which z is the first."""
    best = _best()
    for n in range(7):
        for rank in range(3):
            best[n, rank] = -1.0
    for m in range(params.neighbours.shape[0]):
        other = other_view(maps, params, m, pixel)
        for n in range(count):
            c = correlation(quads, patch, other, z + float(n) * step, params.host)
            if c > best[n, 0]:
                best[n, 2] = best[n, 1]
                best[n, 1] = best[n, 0]
                best[n, 0] = c
            elif c > best[n, 1]:
                best[n, 2] = best[n, 1]
                best[n, 1] = c
            elif c > best[n, 2]:
                best[n, 2] = c
    agreement = _seven()
    for n in range(7):
        total = best[n, 0]
        shown = float(1.0)
        for rank in range(1, 3):
            if best[n, rank] > -1.0:
                total += best[n, rank]
                shown += 1.0
        agreement[n] = total / shown
    return agreement


@wp.kernel(module="fieldwork_patches")
def refine_kernel(
    quads: wp.array(dtype=wp.uint64),
    normals: wp.array(dtype=wp.vec3),
    maps: Maps,
    params: RefineParams,
    out: wp.array(dtype=float),
    score: wp.array(dtype=float),
    offset: int,
):
    i = wp.tid() + offset
    view = params.view
    z = maps.depth[maps.first[view] + i]
    out[i] = z
    score[i] = -1.0
    width = maps.size[view, 0]
    height = maps.size[view, 1]
    column = i % width
    row = i / width
    border = column < REACH or row < REACH or column >= width - REACH or row >= height - REACH
    if z <= 0.0 or z > FARTHEST or border:
        return
    patch = read_patch(quads, maps, view, column, row)
    if patch.variance < FLAT:
        return
    lens = maps.lens[view]
    x = float(column) + 0.5
    y = float(row) + 0.5
    normal = normals[i]
    along = wp.dot(normal, pixel_ray(lens, x, y))
    if along > -STEEPEST:
        return
    pixel = Pixel()
    pixel.middle = on_plane(lens, x, y, normal, along)
    pixel.right = on_plane(lens, x + 4.0, y, normal, along)
    pixel.below = on_plane(lens, x, y + 4.0, normal, along)
    rate = pixels_per_depth(maps, params, pixel, z)
    if rate <= 0.0:
        return
    step = wp.clamp(maps.spread[maps.first[view] + i] / 3.0, 0.4 / rate, 1.2 / rate)
    tries = _tries()
    for t in range(13):
        tries[t] = -1.0
    coarse = photo_agreement(quads, maps, params, patch, pixel, z - float(MIDDLE) * step, 2.0 * step, 7)
    top = int(0)
    for n in range(7):
        tries[2 * n] = coarse[n]
        if coarse[n] > coarse[top]:
            top = n
    first = 2 * top - 1
    beside = photo_agreement(quads, maps, params, patch, pixel, z + float(first - MIDDLE) * step, 2.0 * step, 2)
    if first >= 0:
        tries[first] = beside[0]
    if first <= 10:
        tries[first + 2] = beside[1]
    best, peak = best_try(tries, params.least, params.gain)
    score[i] = tries[best]
    out[i] = z + peak * step


def refine(
    quads: torch.Tensor, normals: torch.Tensor, maps: MapArrays, view: int, neighbours: torch.Tensor,
    least: float, gain: float, host: bool | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
    """Depths (H·W,) of one map moved to where its photo agrees best with those of the maps `neighbours` (K,) int32, and
    how well (H·W,) they agree there, −1 where that is not known.

    quads (P, 4): the photos as the maps see them, see `patch_sums.quads`; normals (H·W, 3) in camera axes, towards the
    camera. Of thirteen depths around each pixel's, about half its spread apart but 0.4 to 1.2 pixels, every second and both beside the best of
    these are rated by the mean correlation of the three best views. The best one counts if it reaches `least`, exceeds the present one's by `gain` and is not the
    outermost; a parabola places it between its neighbours. `host`: by the code for CPUs; None: where the maps are on one.
    """
    init()
    count = int(maps.size[view].prod())
    out, score = torch.empty(count, device=quads.device), torch.empty(count, device=quads.device)
    turn = maps.rotation[neighbours] @ maps.rotation[view].T
    shift = maps.translation[neighbours] - turn @ maps.translation[view]
    params = RefineParams()
    params.view, params.neighbours, params.least, params.gain = view, array(neighbours), least, gain
    params.turn, params.shift = array(turn, wp.mat33), array(shift, wp.vec3)
    params.host = int(quads.device.type == "cpu") if host is None else int(host)
    inputs = [
        array(quads.view(torch.int64).reshape(-1), wp.uint64),
        array(normals.contiguous(), wp.vec3),
        map_struct(maps),
        params,
        array(out),
        array(score),
    ]
    launch(refine_kernel, count, inputs, quads.device)
    return out, score
