"""Photos compared through a surface: what one photo shows of it, and what another shows of the same places.

A surface is given by its depth in each picture. Three kernels: the first reads another photo wherever the surface says that a
pixel's place is seen there, and how this value would change if the surface moved; the second sums up the two along rows of
small windows; the third adds the rows of each window, compares the two in it, and sums up what that says of each pixel's place.
"""

from __future__ import annotations

import torch
import warp as wp

from .depth_arrays import FREE, MapArrays
from .projection import Maps, map_struct, pixel_ray, seen_at
from .runtime import array, init, launch

RADIUS = wp.constant(3)  # pixels from the middle of a window to its side
SIGMA = 1.5  # of the window's weights, in pixels
SLACK, SLACK_SLOPE = wp.constant(2.0), wp.constant(3.0)  # footprints by which something must be nearer to hide a place
FLATTEST = wp.constant(0.2)  # cosine under which another photo sees too little of a surface
GRAZING = wp.constant(0.1)  # cosine at which slopes are capped
NOISE = wp.constant(2.5e-5)  # of the variance of grey values in a window
ALIKE = wp.constant(0.3)  # correlation from which windows count, and
SURE = wp.constant(0.7)  # from which they count fully
HALF = wp.constant(0.5)  # of a window that both photos must show
NOT_SEEN = wp.constant(-1.0)  # grey value of what a photo does not show


@wp.struct
class Read:
    """A grey value, NOT_SEEN where there is none, and its slopes along x and y."""

    value: float
    right: float
    down: float


@wp.func
def read_grey(grey: wp.array(dtype=wp.vec3), maps: Maps, view: int, pixel: wp.vec2):
    """Value and slopes of a photo at pixel coordinates, interpolated; nothing where one of the four pixels is unknown."""
    out = Read()
    width = maps.size[view, 0]
    height = maps.size[view, 1]
    x = wp.clamp(pixel[0] - 0.5, 0.0, float(width) - 1.001)
    y = wp.clamp(pixel[1] - 0.5, 0.0, float(height) - 1.001)
    column = int(x)
    row = int(y)
    place = maps.first[view] + row * width + column
    a = grey[place]
    b = grey[place + 1]
    c = grey[place + width]
    d = grey[place + width + 1]
    out.value = NOT_SEEN
    if wp.min(wp.min(a[0], b[0]), wp.min(c[0], d[0])) >= 0.0:
        fx = x - float(column)
        fy = y - float(row)
        upper = a + fx * (b - a)
        mixed = upper + fy * (c + fx * (d - c) - upper)
        out.value = mixed[0]
        out.right = mixed[1]
        out.down = mixed[2]
    return out


@wp.kernel(module="fieldwork_warping")
def warp_kernel(
    grey: wp.array(dtype=wp.vec3),
    facing: wp.array(dtype=wp.vec3),
    nearest: wp.array(dtype=float),
    maps: Maps,
    near: wp.array(dtype=int),
    view: int,
    out: wp.array(dtype=wp.vec2, ndim=2),
    offset: int,
):
    i = wp.tid() + offset
    width = maps.size[view, 0]
    column = i % width
    row = i / width
    place = maps.first[view] + i
    depth = maps.depth[place]
    for k in range(near.shape[0]):
        out[k, i] = wp.vec2(NOT_SEEN, 0.0)
    if depth > 0.0 and depth < FREE and grey[place][0] >= 0.0:
        ray = pixel_ray(maps.lens[view], float(column) + 0.5, float(row) + 0.5)
        back = wp.transpose(maps.rotation[view])
        point = back * (depth * ray - maps.translation[view])
        normal = facing[i]
        along = back * ray
        # Where the surface moves by one along its normal, the pixel shows a place that moves by this along its ray.
        step = along / wp.min(wp.dot(along, normal), -1.0e-6)
        for k in range(near.shape[0]):
            other = near[k]
            q, pixel, inside = seen_at(maps, other, point)
            if inside:
                cosine = -wp.dot(q, maps.rotation[other] * normal) / wp.length(q)
                slope = wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0)) / wp.max(cosine, GRAZING)
                slack = q[2] / maps.lens[other][0] * (SLACK + SLACK_SLOPE * slope)
                own = maps.first[other] + int(pixel[1]) * maps.size[other, 0] + int(pixel[0])
                if cosine > FLATTEST and nearest[own] > q[2] - slack:
                    found = read_grey(grey, maps, other, pixel)
                    s = maps.rotation[other] * step
                    lens = maps.lens[other]
                    right = lens[0] * (s[0] * q[2] - q[0] * s[2]) / (q[2] * q[2])
                    down = lens[1] * (s[1] * q[2] - q[1] * s[2]) / (q[2] * q[2])
                    if found.value >= 0.0:
                        out[k, i] = wp.vec2(found.value, found.right * right + found.down * down)


@wp.kernel(module="fieldwork_warping")
def rows_kernel(
    grey: wp.array(dtype=wp.vec3),
    maps: Maps,
    view: int,
    warped: wp.array(dtype=wp.vec2, ndim=2),
    bell: wp.array(dtype=float),
    sums: wp.array(dtype=wp.vec3, ndim=3),
    offset: int,
):
    i = wp.tid() + offset
    width = maps.size[view, 0]
    column = i % width
    first = maps.first[view] + i - column
    for k in range(warped.shape[0]):
        means = wp.vec3(0.0, 0.0, 0.0)
        squares = wp.vec3(0.0, 0.0, 0.0)
        for x in range(wp.max(column - RADIUS, 0), wp.min(column + RADIUS + 1, width)):
            theirs = warped[k, i - column + x][0]
            if theirs >= 0.0:
                w = bell[x - column + RADIUS]
                mine = grey[first + x][0]
                means += w * wp.vec3(1.0, mine, theirs)
                squares += w * wp.vec3(mine * mine, theirs * theirs, mine * theirs)
        sums[k, i, 0] = means
        sums[k, i, 1] = squares


@wp.kernel(module="fieldwork_warping")
def compare_kernel(
    grey: wp.array(dtype=wp.vec3),
    maps: Maps,
    view: int,
    warped: wp.array(dtype=wp.vec2, ndim=2),
    sums: wp.array(dtype=wp.vec3, ndim=3),
    bell: wp.array(dtype=float),
    whole: float,
    out: wp.array(dtype=wp.vec3),
    offset: int,
):
    i = wp.tid() + offset
    width = maps.size[view, 0]
    height = maps.size[view, 1]
    column = i % width
    row = i / width
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(warped.shape[0]):
        own = warped[k, i]
        if own[0] >= 0.0:
            means = wp.vec3(0.0, 0.0, 0.0)
            squares = wp.vec3(0.0, 0.0, 0.0)
            for y in range(wp.max(row - RADIUS, 0), wp.min(row + RADIUS + 1, height)):
                w = bell[y - row + RADIUS]
                means += w * sums[k, y * width + column, 0]
                squares += w * sums[k, y * width + column, 1]
            weights = means[0]
            a = means[1] / weights
            b = means[2] / weights
            va = wp.max(squares[0] / weights - a * a, 0.0) + NOISE
            vb = wp.max(squares[1] / weights - b * b, 0.0) + NOISE
            alike = (squares[2] / weights - a * b) / wp.sqrt(va * vb)
            if alike > ALIKE and weights > HALF * whole:
                off = (grey[maps.first[view] + i][0] - a) / wp.sqrt(va) - (own[0] - b) / wp.sqrt(vb)
                slope = own[1] / wp.sqrt(vb)
                sure = wp.min((alike - ALIKE) / (SURE - ALIKE), 1.0) / (1.0 + off * off)
                total += sure * wp.vec3(slope * off, slope * slope, off * off)
    out[i] = total


def photo_forces(
    grey: torch.Tensor, facing: torch.Tensor, nearest: torch.Tensor, maps: MapArrays, view: int, near: torch.Tensor
) -> torch.Tensor:
    """What the photos `near` say of the surface that the pixels of a photo show: (N, 3) of its N pixels the force that pulls
    the surface along its normal, its slope (how firmly it holds where the force is 0) and the misfit; sums over these photos,
    0 where none tells.

    The misfit is the squared difference of grey values, less their mean and over their standard deviation in a window
    around the pixel, weighted by how well the windows correlate and robustly (Geman and McClure). Force and slope are those of
    Gauss and Newton for a shift of the surface, as in Vu et al., "High accuracy and visibility-consistent dense multiview
    stereo" (2012).

    Args:
        grey: (P, 3) of all photos: value in [0, 1], −1 where a photo shows nothing, and its slopes along x and y.
        facing: (N, 3) unit normals, in the frame, of the surface that the pixels show.
        nearest: (P,) the least depth of the surface around each pixel, by which it hides what is behind.
        maps: the depth of the surface in each photo, and the cameras. near: (K,) int32.
    """
    device = grey.device
    init()
    count = int(maps.size[view].prod())
    warped = torch.empty(len(near), count, 2, device=device)
    out = torch.empty(count, 3, device=device)
    struct = map_struct(maps)
    inputs = [array(grey, wp.vec3), array(facing, wp.vec3), array(nearest), struct, array(near), view]
    launch(warp_kernel, count, [*inputs, array(warped, wp.vec2)], device)
    bell = torch.exp(-(torch.arange(-RADIUS, RADIUS + 1.0, device=device) ** 2) / (2 * SIGMA**2))
    sums = torch.empty(len(near), count, 2, 3, device=device)
    shown = [array(grey, wp.vec3), struct, view, array(warped, wp.vec2)]
    launch(rows_kernel, count, [*shown, array(bell), array(sums, wp.vec3)], device)
    whole = float(bell.sum()) ** 2
    launch(compare_kernel, count, [*shown, array(sums, wp.vec3), array(bell), whole, array(out, wp.vec3)], device)
    return out
