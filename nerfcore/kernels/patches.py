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
from .projection import FARTHEST, NEAREST, Maps, map_struct, pixel_ray
from .runtime import array, init, launch

BESIDE = wp.constant(2.0)  # pixels from one value of a patch to the next
SETTLED = wp.constant(0.9)  # correlation of a depth better than those beside it, from which farther ones are not tried
REACH = wp.constant(4)  # a patch has 5 × 5 pixels, two apart: it reaches four pixels from its middle
FLAT = wp.constant(2.0e-5)  # variance of grey values in [0, 1] below which a patch shows nothing
EVEN = wp.constant(1.0e-6)  # variance up to which a window of another view says nothing
STEEPEST = wp.constant(1.0e-2)  # of the normal along the ray: a surface seen more along is not compared
WIDEST = wp.constant(24.0)  # pixels a patch may reach in another view
MIDDLE = wp.constant(6)  # of 13 depths
UNSEEN = wp.constant(-2.0)  # correlation with a view that does not show the patch

_tries = wp.types.vector(length=13, dtype=float)
_best = wp.types.matrix(shape=(3, 3), dtype=float)


@wp.struct
class RefineParams:
    """See `refine`. turn and shift lead from the view's camera axes to pixels of its neighbours, in homogeneous coordinates.
    host: 1 where the CPU's compiler sums up patches."""

    view: int
    neighbours: wp.array(dtype=int)
    turn: wp.array(dtype=wp.mat33)
    shift: wp.array(dtype=wp.vec3)
    least: float
    gain: float
    host: int


@wp.struct
class Spot:
    """Where a pixel's ray meets a plane at depth 1, and how this place moves with the pixel: from one value of its patch to
    the next one right and below. In camera axes, or as homogeneous pixel coordinates of another view."""

    place: wp.vec3
    right: wp.vec3
    below: wp.vec3


@wp.struct
class Other:
    """Another view: a pixel's spot in it, where it has depth z, is `spot.place` times z, and the shift."""

    first: int
    width: int
    height: int
    spot: Spot
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
def spot_of(lens: wp.vec4, x: float, y: float, normal: wp.vec3):
    """A pixel's spot on the plane with this normal, and the normal's part along the ray."""
    r = pixel_ray(lens, x, y)
    along = wp.dot(normal, r)
    spot = Spot()
    spot.place = r
    spot.right = wp.vec3(BESIDE / lens[0], 0.0, 0.0) - r * (BESIDE / lens[0] * normal[0] / along)
    spot.below = wp.vec3(0.0, BESIDE / lens[1], 0.0) - r * (BESIDE / lens[1] * normal[1] / along)
    return spot, along


@wp.func
def other_view(maps: Maps, params: RefineParams, m: int, spot: Spot):
    view = params.neighbours[m]
    other = Other()
    other.first = maps.first[view]
    other.width = maps.size[view, 0]
    other.height = maps.size[view, 1]
    other.spot.place = params.turn[m] * spot.place
    other.spot.right = params.turn[m] * spot.right
    other.spot.below = params.turn[m] * spot.below
    other.shift = params.shift[m]
    return other


@wp.func
def pixels_per_depth(params: RefineParams, place: wp.vec3, z: float):
    """How many pixels a step in depth moves the place of a spot in other views, in the mean; 0 where that is not known."""
    rate = float(0.0)
    valid = float(0.0)
    for m in range(params.neighbours.shape[0]):
        way = params.turn[m] * place
        q = way * z + params.shift[m]
        if q[2] > NEAREST:
            rate += wp.length(wp.vec2(way[0] * q[2] - way[2] * q[0], way[1] * q[2] - way[2] * q[1])) / (q[2] * q[2])
            valid += 1.0
    mean = float(0.0)
    if valid >= 1.0 and rate >= 1e-6:
        mean = rate / valid
    return mean


@wp.func
def window_at(other: Other, z: float):
    """Where a patch lies in another view, were the pixel's depth z, and whether it does: not where it leaves the picture
    or is stretched too far."""
    q = other.spot.place * z + other.shift
    nearness = 1.0 / wp.max(q[2], 1e-6)
    x = q[0] * nearness
    y = q[1] * nearness
    w = Window()
    w.first = other.first
    w.width = other.width
    w.x = x - 0.5
    w.y = y - 0.5
    w.ax = (other.spot.right[0] - x * other.spot.right[2]) * z * nearness
    w.ay = (other.spot.right[1] - y * other.spot.right[2]) * z * nearness
    w.bx = (other.spot.below[0] - x * other.spot.below[2]) * z * nearness
    w.by = (other.spot.below[1] - y * other.spot.below[2]) * z * nearness
    reach_x = 2.0 * (wp.abs(w.ax) + wp.abs(w.bx)) + 1.0
    reach_y = 2.0 * (wp.abs(w.ay) + wp.abs(w.by)) + 1.0
    inside = z > NEAREST and q[2] > NEAREST and x > reach_x and y > reach_y
    inside = inside and x < float(other.width) - reach_x and y < float(other.height) - reach_y
    return w, inside and reach_x < WIDEST and reach_y < WIDEST


@wp.func
def correlation(sums: wp.vec3, patch: Patch):
    """Normalised cross-correlation of a patch and the window that has these sums, see `patch_sums`."""
    mean = sums[0] / 25.0
    variance = sums[1] / 25.0 - mean * mean
    agreed = float(0.0)
    if variance > EVEN:  # below it this is rounding
        agreed = (sums[2] / 25.0 - mean * patch.mean) / wp.sqrt(variance * patch.variance)
    return agreed


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
    quads: wp.array(dtype=wp.uint64), maps: Maps, params: RefineParams, patch: Patch, spot: Spot,
    z: float, step: float, count: int,
):  # fmt: skip
    """Mean correlation of the three views that agree best, or of the fewer whose pictures show the place, −1 where none
    does, at `count` depths, at most three, of which z is the first."""
    best = _best()
    for n in range(3):
        for rank in range(3):
            best[n, rank] = -1.0
    for m in range(params.neighbours.shape[0]):
        other = other_view(maps, params, m, spot)
        for n in range(count):
            w, inside = window_at(other, z + float(n) * step)
            c = float(UNSEEN)
            if inside:
                sums = wp.vec3()
                if params.host == 1:
                    sums = patch_sums_host(quads, w, patch)
                else:
                    sums = patch_sums(quads, w, patch)
                c = correlation(sums, patch)
            if c > best[n, 0]:
                best[n, 2] = best[n, 1]
                best[n, 1] = best[n, 0]
                best[n, 0] = c
            elif c > best[n, 1]:
                best[n, 2] = best[n, 1]
                best[n, 1] = c
            elif c > best[n, 2]:
                best[n, 2] = c
    agreement = wp.vec3()
    for n in range(3):
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
    spot, along = spot_of(maps.lens[view], float(column) + 0.5, float(row) + 0.5, normals[i])
    if along > -STEEPEST:
        return
    rate = pixels_per_depth(params, spot.place, z)
    if rate <= 0.0:
        return
    step = wp.clamp(maps.spread[maps.first[view] + i] / 3.0, 0.4 / rate, 1.2 / rate)
    tries = _tries()
    for t in range(13):
        tries[t] = -1.0
    rounds = int(4)  # not a constant: Warp would write the loop out
    best = int(MIDDLE)
    for n in range(rounds):
        first = int(4)
        count = int(3)
        if n == 1:
            first = 0
            count = 2
        elif n == 2:
            first = 10
            count = 2
        elif n == 3:
            first = best - 1
            count = 2
        settled = best == MIDDLE and tries[MIDDLE] >= SETTLED
        if n == 0 or n == 3 or not settled:
            found = photo_agreement(
                quads, maps, params, patch, spot, z + float(first - MIDDLE) * step, 2.0 * step, count
            )
            for k in range(3):
                t = first + 2 * k
                if k < count and t >= 0 and t <= 12:
                    tries[t] = found[k]
                    if tries[t] > tries[best]:
                        best = t
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
    camera. Thirteen depths around each pixel's, about half its spread apart but 0.4 to 1.2 pixels, are rated by the mean
    correlation of the three best views: the middle one and the second beside it on each side; every second farther away,
    unless the middle one is the best and reaches `SETTLED`; and both beside the best. The best one counts if it reaches
    `least`, exceeds the present one's by `gain` and is not the outermost; a parabola places it between its neighbours.
    `host`: by the code for CPUs; None: where the maps are on one.
    """
    init()
    count = int(maps.size[view].prod())
    out, score = torch.empty(count, device=quads.device), torch.empty(count, device=quads.device)
    lens = maps.lens[neighbours]
    pixels = torch.zeros(len(lens), 3, 3, device=lens.device)
    pixels[:, 0, 0], pixels[:, 1, 1], pixels[:, 0, 2], pixels[:, 1, 2], pixels[:, 2, 2] = *lens.T, 1.0
    turn = pixels @ maps.rotation[neighbours] @ maps.rotation[view].T
    shift = (pixels @ maps.translation[neighbours, :, None])[..., 0] - turn @ maps.translation[view]
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
