"""Normals of a depth map, from the differences of its depths."""

from __future__ import annotations

import torch
import warp as wp

from .depth_arrays import FREE
from .projection import pixel_ray
from .runtime import array, init, launch

EVERYTHING = wp.constant(FREE)
BETTER = wp.constant(0.999)  # of the change so far: what is hardly better does not replace what was found first


@wp.func
def point_at(depth: wp.array(dtype=float), lens: wp.vec4, width: int, column: int, row: int):
    """What a pixel shows, in camera axes; depth 0 where nothing is known or there."""
    z = depth[row * width + column]
    if z >= EVERYTHING:
        z = 0.0
    return pixel_ray(lens, float(column) + 0.5, float(row) + 0.5) * z


@wp.func
def slope(
    depth: wp.array(dtype=float), lens: wp.vec4, width: int, height: int, column: int, row: int, along: wp.vec2i,
    jump: float,
):  # fmt: skip
    """Difference of a pixel's point to a neighbour along an axis, for each pixel: of the two sides, over two pixels or
    one, the one whose depth is nearest; 0 where none is solid or continues the surface: depths differ by less than the
    share `jump`."""
    p = point_at(depth, lens, width, column, row)
    found = wp.vec3()
    best = float(EVERYTHING)
    for k in range(4):
        step = 2 - k / 2
        side = 1 - 2 * (k % 2)
        x = column + side * step * along[0]
        y = row + side * step * along[1]
        if x >= 0 and y >= 0 and x < width and y < height:
            q = point_at(depth, lens, width, x, y)
            change = wp.abs(q[2] - p[2]) / float(step)
            if q[2] > 0.0 and change < jump * p[2] and change < BETTER * best:
                found = (q - p) * (float(side) / float(step))
                best = change
    return found


@wp.kernel(module="fieldwork_depth_normals")
def normal_kernel(
    depth: wp.array(dtype=float), lens: wp.vec4, width: int, jump: float, out: wp.array(dtype=wp.vec3), offset: int
):
    i = wp.tid() + offset
    out[i] = wp.vec3()
    column = i % width
    row = i / width
    p = point_at(depth, lens, width, column, row)
    if p[2] <= 0.0:
        return
    height = depth.shape[0] / width
    right = slope(depth, lens, width, height, column, row, wp.vec2i(1, 0), jump)
    below = slope(depth, lens, width, height, column, row, wp.vec2i(0, 1), jump)
    normal = wp.cross(right, below)
    size = wp.length(normal)
    if size > 0.0:
        out[i] = normal * (-wp.sign(wp.dot(normal, p)) / size)


def depth_normals(depth: torch.Tensor, lens: tuple[float, float, float, float], jump: float) -> torch.Tensor:
    """Unit normals (H, W, 3) in camera axes, towards the camera, of depths (H, W) float32 along the optical axis of a
    pinhole, 0 where nothing is known and `FREE` where nothing is; 0 there and at outlines, where no neighbour's depth is
    within the share `jump`.

    lens: fx, fy, cx, cy in pixels.
    """
    init()
    height, width = depth.shape
    out = torch.empty(height, width, 3, device=depth.device)
    inputs = [array(depth.reshape(-1)), wp.vec4(*lens), width, jump, array(out.reshape(-1, 3), wp.vec3)]
    launch(normal_kernel, height * width, inputs, depth.device)
    return out
