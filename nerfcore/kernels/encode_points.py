"""Gradient of the grid encoding with respect to the encoded points, for the refinement of camera poses.

Inside a cell the encoding is trilinear, so its gradient jumps at cell faces and grows with a level's resolution;
`gains` may therefore weigh fine levels less than the encoding itself does (Lin et al., "BARF", 2021, section 3.3).
The torch twin is autograd through `encode_torch.forward`.
"""

from __future__ import annotations

import torch
import warp as wp

from .encode import FEATURES, corner_rows, feature
from .runtime import array, init, launch


@wp.kernel(module="fieldwork_encode_points")
def encode_points_backward(
    table: wp.array(dtype=feature),
    points: wp.array(dtype=wp.vec3),
    grad_out: wp.array(dtype=feature, ndim=2),
    level: int,
    resolution: int,
    base: int,
    size: int,
    gain: float,
    grad_points: wp.array(dtype=wp.vec3),
    offset: int,
):
    i = wp.tid() + offset
    scale = float(resolution - 1)
    p = points[i] * scale
    ix = wp.clamp(int(p[0]), 0, resolution - 2)
    iy = wp.clamp(int(p[1]), 0, resolution - 2)
    iz = wp.clamp(int(p[2]), 0, resolution - 2)
    fx = p[0] - float(ix)
    fy = p[1] - float(iy)
    fz = p[2] - float(iz)
    low, high = corner_rows(ix, iy, iz, resolution, size, base)
    g = grad_out[i, level]
    # Projected on the incoming gradient the eight corners are numbers; then it is scalar trilinear interpolation.
    a00 = wp.dot(g, table[low[0]])
    a10 = wp.dot(g, table[low[1]])
    a01 = wp.dot(g, table[low[2]])
    a11 = wp.dot(g, table[low[3]])
    b00 = wp.dot(g, table[high[0]])
    b10 = wp.dot(g, table[high[1]])
    b01 = wp.dot(g, table[high[2]])
    b11 = wp.dot(g, table[high[3]])
    gx = 1.0 - fx
    gy = 1.0 - fy
    gz = 1.0 - fz
    dx = ((b00 - a00) * gy + (b10 - a10) * fy) * gz + ((b01 - a01) * gy + (b11 - a11) * fy) * fz
    c00 = a00 * gx + b00 * fx
    c10 = a10 * gx + b10 * fx
    c01 = a01 * gx + b01 * fx
    c11 = a11 * gx + b11 * fx
    dy = (c10 - c00) * gz + (c11 - c01) * fz
    dz = (c01 - c00) * gy + (c11 - c10) * fy
    grad_points[i] = grad_points[i] + wp.vec3(dx, dy, dz) * (gain * scale)


def backward_points(
    table: torch.Tensor,
    levels: list[tuple[int, int, int]],
    gains: list[float],
    points: torch.Tensor,
    grad_out: torch.Tensor,
) -> torch.Tensor:
    """Gradient (N, 3) of `encode.forward` with respect to `points` (N, 3), given that of its result (N, L · FEATURES).

    Each point is one thread and levels follow one another, so nothing races. Arguments as for `encode.forward`.
    """
    init()
    out = torch.zeros_like(points)
    grad = array(grad_out.reshape(len(points), len(levels), FEATURES), feature)
    rows, where, target = array(table, feature), array(points, wp.vec3), array(out, wp.vec3)
    for index, (resolution, base, size) in enumerate(levels):
        if gains[index] != 0.0:
            inputs = [rows, where, grad, index, resolution, base, size, gains[index], target]
            launch(encode_points_backward, len(points), inputs, points.device)
    return out
