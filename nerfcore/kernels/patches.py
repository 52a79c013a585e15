"""Depths that photos agree on best: small slanted patches compared between views by normalised cross-correlation.

The idea is that of multi-view stereo by plane sweeping (Goesele et al., "Multi-view stereo for community photo
collections", 2007), begun at the depth a field gives. A patch lies on the plane through a pixel's point with its normal;
where it lies in another view is an affine map there. Cameras and depths are those of `projection.Maps`.
"""

from __future__ import annotations

import torch
import warp as wp

from .depth_arrays import MapArrays
from .patch_sums import Patch, Window, patch_sums, patch_sums_host
from .projection import FARTHEST, NEAREST, Maps, map_struct, pixel_ray, project
from .runtime import array, init, launch

REACH = wp.constant(4)  # a patch has 5 × 5 pixels, two apart: it reaches four pixels from its middle
FLAT = wp.constant(2.0e-5)  # variance of grey values in [0, 1] below which a patch shows nothing
STEEPEST = wp.constant(1.0e-2)  # of the normal along the ray: a surface seen more along is not compared
WIDEST = wp.constant(24.0)  # pixels a patch may reach in another view
MIDDLE = wp.constant(6)  # of 13 depths, every second of which is tried, and both beside the best of these
UNSEEN = wp.constant(-2.0)  # correlation with a view that does not show the patch

_tries = wp.types.vector(length=13, dtype=float)


@wp.struct
class RefineParams:
    """See `refine`; host: 1 where the CPU's compiler sums up patches."""

    view: int
    neighbours: wp.array(dtype=int)
    least: float
    gain: float
    host: int


@wp.struct
class Pixel:
    """A pixel with the normal of its surface, in camera axes; along: of the normal on the ray, negative towards the
    camera."""

    x: float
    y: float
    lens: wp.vec4
    normal: wp.vec3
    along: float


@wp.struct
class Other:
    """Another view: its lens, and how points get there from the axes of the first one."""

    view: int
    lens: wp.vec4
    turn: wp.mat33
    shift: wp.vec3


@wp.func
def read_patch(grey: wp.array(dtype=float), maps: Maps, view: int, column: int, row: int):
    """The patch around a pixel of a view."""
    patch = Patch()
    mean = float(0.0)
    square = float(0.0)
    for k in range(25):
        g = grey[maps.first[view] + (row + (k / 5 - 2) * 2) * maps.size[view, 0] + column + (k % 5 - 2) * 2]
        patch.values[k] = g
        mean += g
        square += g * g
    mean /= 25.0
    patch.mean = mean
    patch.variance = square / 25.0 - mean * mean
    return patch


@wp.func
def other_view(maps: Maps, view: int, v: int):
    other = Other()
    other.view = v
    other.lens = maps.lens[v]
    other.turn = maps.rotation[v] * wp.transpose(maps.rotation[view])
    other.shift = maps.translation[v] - other.turn * maps.translation[view]
    return other


@wp.func
def flow(pixel: Pixel, other: Other, right: float, down: float, z: float):
    """Where what lies `right` and `down` of a pixel appears in another view, on the plane through the pixel at depth z;
    the third number is its depth there."""
    r = pixel_ray(pixel.lens, pixel.x + right, pixel.y + down)
    q = other.turn * (r * (z * pixel.along / wp.min(wp.dot(pixel.normal, r), -1e-3))) + other.shift
    place = project(other.lens, wp.vec3(q[0], q[1], wp.max(q[2], 1e-6)))
    return wp.vec3(place[0], place[1], q[2])


@wp.func
def pixels_per_depth(maps: Maps, params: RefineParams, pixel: Pixel, z: float):
    """How many pixels a step in depth moves the point in other views, in the mean; 0 where that is not known."""
    rate = float(0.0)
    valid = float(0.0)
    for m in range(params.neighbours.shape[0]):
        other = other_view(maps, params.view, params.neighbours[m])
        a = flow(pixel, other, 0.0, 0.0, z)
        b = flow(pixel, other, 0.0, 0.0, z * 1.01)
        if a[2] > NEAREST:
            rate += wp.sqrt((a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1])) / (0.01 * z)
            valid += 1.0
    mean = float(0.0)
    if valid >= 1.0 and rate >= 1e-6:
        mean = rate / valid
    return mean


@wp.func
def correlation(grey: wp.array(dtype=float), maps: Maps, patch: Patch, pixel: Pixel, other: Other, z: float, host: int):
    """Normalised cross-correlation of a patch with another view, were the pixel's depth z; `UNSEEN` where the patch
    leaves the picture or is stretched too far."""
    middle = flow(pixel, other, 0.0, 0.0, z)
    right = flow(pixel, other, 4.0, 0.0, z)
    below = flow(pixel, other, 0.0, 4.0, z)
    ax = (right[0] - middle[0]) * 0.5
    ay = (right[1] - middle[1]) * 0.5
    bx = (below[0] - middle[0]) * 0.5
    by = (below[1] - middle[1]) * 0.5
    reach_x = 2.0 * (wp.abs(ax) + wp.abs(bx)) + 1.0
    reach_y = 2.0 * (wp.abs(ay) + wp.abs(by)) + 1.0
    width = maps.size[other.view, 0]
    height = maps.size[other.view, 1]
    inside = middle[2] > NEAREST and middle[0] > reach_x and middle[1] > reach_y
    inside = inside and middle[0] < float(width) - reach_x and middle[1] < float(height) - reach_y
    result = float(UNSEEN)
    if inside and reach_x < WIDEST and reach_y < WIDEST:
        w = Window()
        w.first = maps.first[other.view]
        w.width = width
        w.x = middle[0] - 0.5
        w.y = middle[1] - 0.5
        w.ax = ax
        w.ay = ay
        w.bx = bx
        w.by = by
        sums = wp.vec3()
        if host == 1:
            sums = patch_sums_host(grey, w, patch)
        else:
            sums = patch_sums(grey, w, patch)
        mean = sums[0] / 25.0
        variance = sums[1] / 25.0 - mean * mean
        result = (sums[2] / 25.0 - mean * patch.mean) / wp.sqrt(wp.max(variance * patch.variance, 1e-14))
    return result


@wp.func
def photo_agreement(
    grey: wp.array(dtype=float), maps: Maps, params: RefineParams, patch: Patch, pixel: Pixel, z: float
):
    """Mean correlation of the three views that agree best, were the pixel's depth z, or of the fewer whose pictures show the
    place; −1 where none does."""
    first = float(-1.0)
    second = float(-1.0)
    third = float(-1.0)
    if z > NEAREST:
        for m in range(params.neighbours.shape[0]):
            other = other_view(maps, params.view, params.neighbours[m])
            c = correlation(grey, maps, patch, pixel, other, z, params.host)
            if c > first:
                third = second
                second = first
                first = c
            elif c > second:
                third = second
                second = c
            elif c > third:
                third = c
    total = first
    shown = float(1.0)
    if second > -1.0:
        total += second
        shown += 1.0
    if third > -1.0:
        total += third
        shown += 1.0
    return total / shown


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


@wp.kernel(module="fieldwork_patches")
def refine_kernel(
    grey: wp.array(dtype=float),
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
    patch = read_patch(grey, maps, view, column, row)
    if patch.variance < FLAT:
        return
    pixel = Pixel()
    pixel.x = float(column) + 0.5
    pixel.y = float(row) + 0.5
    pixel.lens = maps.lens[view]
    pixel.normal = normals[i]
    pixel.along = wp.dot(pixel.normal, pixel_ray(pixel.lens, pixel.x, pixel.y))
    if pixel.along > -STEEPEST:
        return
    rate = pixels_per_depth(maps, params, pixel, z)
    if rate <= 0.0:
        return
    step = wp.clamp(maps.spread[maps.first[view] + i] / 3.0, 0.4 / rate, 1.2 / rate)
    tries = _tries()
    for t in range(13):
        tries[t] = -1.0
    coarse = int(MIDDLE)
    for n in range(9):
        t = 2 * n
        if n >= 7:
            t = coarse + 2 * (n - 7) - 1
        if t >= 0 and t <= 12:
            tries[t] = photo_agreement(grey, maps, params, patch, pixel, z + float(t - MIDDLE) * step)
            if n < 7 and tries[t] > tries[coarse]:
                coarse = t
    best, peak = best_try(tries, params.least, params.gain)
    score[i] = tries[best]
    out[i] = z + peak * step


def refine(
    grey: torch.Tensor, normals: torch.Tensor, maps: MapArrays, view: int, neighbours: torch.Tensor,
    least: float, gain: float, host: bool | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
    """Depths (H·W,) of one map moved to where its photo agrees best with those of the maps `neighbours` (K,) int32, and
    how well (H·W,) they agree there, −1 where that is not known.

    grey (P,) in [0, 1]: the photos as the maps see them; normals (H·W, 3) in camera axes, towards the camera. Of thirteen
    depths around each pixel's, about half its spread apart but 0.4 to 1.2 pixels, every second and both beside the best of
    these are rated by the mean correlation of the three best views. The best one counts if it reaches `least`, exceeds the present one's by `gain` and is not the
    outermost; a parabola places it between its neighbours. `host`: by the code for CPUs; None: where the maps are on one.
    """
    init()
    count = int(maps.size[view].prod())
    out, score = torch.empty(count, device=grey.device), torch.empty(count, device=grey.device)
    params = RefineParams()
    params.view, params.neighbours, params.least, params.gain = view, array(neighbours), least, gain
    params.host = int(grey.device.type == "cpu") if host is None else int(host)
    inputs = [array(grey), array(normals.contiguous(), wp.vec3), map_struct(maps), params, array(out), array(score)]
    launch(refine_kernel, count, inputs, grey.device)
    return out, score
