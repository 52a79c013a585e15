"""Depths that photos agree on best: small slanted patches compared between views by normalised cross-correlation.

The idea is that of multi-view stereo by plane sweeping (Goesele et al., "Multi-view stereo for community photo
collections", 2007), begun at the depth a field gives. Arrays are those of `surface.MapArrays`.
"""

from __future__ import annotations

import torch
import warp as wp

from .depth_arrays import MapArrays
from .runtime import array, init, launch

REACH = wp.constant(4)  # a patch has 5 × 5 pixels, two apart: it reaches four pixels from its middle
FLAT = wp.constant(2.0e-5)  # variance of grey values in [0, 1] below which a patch shows nothing

_patch = wp.types.vector(length=25, dtype=float)
_tries = wp.types.vector(length=13, dtype=float)


@wp.func
def _flow(
    ray: wp.vec3, x: float, y: float, z: float, normal: wp.vec3, along: float, lens: wp.vec4, turn: wp.mat33,
    shift: wp.vec3, other: wp.vec4,
):  # fmt: skip
    """Where a pixel of the plane through (ray · z) with a normal lies in another view; the third number is its depth."""
    r = wp.vec3((x - lens[2]) / lens[0], (y - lens[3]) / lens[1], 1.0)
    q = turn * (r * (z * along / wp.min(wp.dot(normal, r), -1e-3))) + shift
    d = wp.max(q[2], 1e-6)
    return wp.vec3(other[0] * q[0] / d + other[2], other[1] * q[1] / d + other[3], q[2])


@wp.kernel(module="fieldwork_patches")
def refine_kernel(
    grey: wp.array(dtype=float),
    depth: wp.array(dtype=float),
    normals: wp.array(dtype=wp.vec3),
    spread: wp.array(dtype=float),
    first: wp.array(dtype=int),
    size: wp.array(dtype=int, ndim=2),
    lens: wp.array(dtype=wp.vec4),
    rotation: wp.array(dtype=wp.mat33),
    translation: wp.array(dtype=wp.vec3),
    view: int,
    neighbours: wp.array(dtype=int),
    amount: int,
    least: float,
    gain: float,
    out: wp.array(dtype=float),
    score: wp.array(dtype=float),
    offset: int,
):
    i = wp.tid() + offset
    begin = first[view]
    z0 = depth[begin + i]
    out[i] = z0
    score[i] = -1.0
    width = size[view, 0]
    height = size[view, 1]
    column = i % width
    row = i / width
    reach = REACH
    if z0 <= 0.0 or z0 > 1e29 or column < reach or row < reach or column >= width - reach or row >= height - reach:
        return
    patch = _patch()
    mean = float(0.0)
    square = float(0.0)
    for k in range(25):
        g = grey[begin + (row + (k / 5 - 2) * 2) * width + column + (k % 5 - 2) * 2]
        patch[k] = g
        mean += g
        square += g * g
    mean /= 25.0
    variance = square / 25.0 - mean * mean
    if variance < FLAT:
        return
    l = lens[view]
    x = float(column) + 0.5
    y = float(row) + 0.5
    ray = wp.vec3((x - l[2]) / l[0], (y - l[3]) / l[1], 1.0)
    n = normals[i]
    along = wp.dot(n, ray)
    if along > -1e-2:
        return
    # How many pixels a step in depth moves the point, in the mean over the views.
    rate = float(0.0)
    valid = float(0.0)
    for m in range(amount):
        v = neighbours[m]
        turn = rotation[v] * wp.transpose(rotation[view])
        shift = translation[v] - turn * translation[view]
        a = _flow(ray, x, y, z0, n, along, l, turn, shift, lens[v])
        b = _flow(ray, x, y, z0 * 1.01, n, along, l, turn, shift, lens[v])
        if a[2] > 1e-4:
            rate += wp.sqrt((a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1])) / (0.01 * z0)
            valid += 1.0
    if valid < 1.0 or rate < 1e-6:
        return
    rate /= valid
    step = wp.clamp(spread[begin + i] / 3.0, 0.4 / rate, 1.2 / rate)
    tries = _tries()
    for t in range(13):
        z = z0 + float(t - 6) * step
        first_best = float(-1.0)
        second_best = float(-1.0)
        third_best = float(-1.0)
        if z > 1e-4:
            for m in range(amount):
                v = neighbours[m]
                turn = rotation[v] * wp.transpose(rotation[view])
                shift = translation[v] - turn * translation[view]
                middle = _flow(ray, x, y, z, n, along, l, turn, shift, lens[v])
                right = _flow(ray, x + 4.0, y, z, n, along, l, turn, shift, lens[v])
                below = _flow(ray, x, y + 4.0, z, n, along, l, turn, shift, lens[v])
                ax = (right[0] - middle[0]) * 0.5
                ay = (right[1] - middle[1]) * 0.5
                bx = (below[0] - middle[0]) * 0.5
                by = (below[1] - middle[1]) * 0.5
                reach_x = 2.0 * (wp.abs(ax) + wp.abs(bx)) + 1.0
                reach_y = 2.0 * (wp.abs(ay) + wp.abs(by)) + 1.0
                inside = middle[2] > 1e-4 and middle[0] > reach_x and middle[1] > reach_y
                inside = inside and middle[0] < float(size[v, 0]) - reach_x and middle[1] < float(size[v, 1]) - reach_y
                if inside and reach_x < 24.0 and reach_y < 24.0:
                    other = float(0.0)
                    other_square = float(0.0)
                    product = float(0.0)
                    base = first[v]
                    w = size[v, 0]
                    for k in range(25):
                        i0 = float(k % 5 - 2)
                        j0 = float(k / 5 - 2)
                        px = middle[0] + i0 * ax + j0 * bx - 0.5
                        py = middle[1] + i0 * ay + j0 * by - 0.5
                        cx = int(px)
                        cy = int(py)
                        fx = px - float(cx)
                        fy = py - float(cy)
                        place = base + cy * w + cx
                        upper = grey[place] + fx * (grey[place + 1] - grey[place])
                        lower = grey[place + w] + fx * (grey[place + w + 1] - grey[place + w])
                        g = upper + fy * (lower - upper)
                        other += g
                        other_square += g * g
                        product += g * patch[k]
                    other /= 25.0
                    spread_there = other_square / 25.0 - other * other
                    c = (product / 25.0 - other * mean) / wp.sqrt(wp.max(spread_there * variance, 1e-14))
                    if c > first_best:
                        third_best = second_best
                        second_best = first_best
                        first_best = c
                    elif c > second_best:
                        third_best = second_best
                        second_best = c
                    elif c > third_best:
                        third_best = c
        tries[t] = (first_best + second_best + third_best) / 3.0
    best = int(6)
    for t in range(13):
        if tries[t] > tries[best]:
            best = t
    score[i] = tries[best]
    moved = wp.abs(float(best - 6)) > 1.5
    if tries[best] < least or (moved and tries[best] - tries[6] < gain) or best == 0 or best == 12:
        return
    curve = tries[best - 1] - 2.0 * tries[best] + tries[best + 1]
    fine = float(0.0)
    if curve < -1e-6:
        fine = wp.clamp(0.5 * (tries[best - 1] - tries[best + 1]) / curve, -0.5, 0.5)
    out[i] = z0 + (float(best - 6) + fine) * step


def refine(
    grey: torch.Tensor, normals: torch.Tensor, maps: MapArrays, view: int, neighbours: torch.Tensor,
    least: float, gain: float,
) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
    """Depths (H·W,) of one map moved to where its photo agrees best with those of the maps `neighbours` (K,) int32, and
    how well (H·W,) they agree there, −1 where that is not known.

    grey (P,) in [0, 1]: the photos as the maps see them; normals (H·W, 3) in camera axes, towards the camera. Thirteen
    depths around each pixel's, about half its spread apart but 0.4 to 1.2 pixels, are rated by the mean correlation
    of the three best views. The best one counts if it reaches `least`, exceeds the present one's by `gain` and is not the
    outermost; a parabola places it between its neighbours.
    """
    init()
    count = int(maps.size[view].prod())
    out, score = torch.empty(count, device=grey.device), torch.empty(count, device=grey.device)
    inputs = [array(grey), array(maps.depth), array(normals.contiguous(), wp.vec3), array(maps.spread)]
    inputs += [*maps.cameras(), view, array(neighbours), len(neighbours), least, gain, array(out), array(score)]
    launch(refine_kernel, count, inputs, grey.device)
    return out, score
