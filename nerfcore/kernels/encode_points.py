"""Gradient of the grid encoding with respect to the encoded points, for the refinement of camera poses.

Inside a cell the encoding is trilinear, so its gradient jumps at cell faces and grows with a level's resolution;
`gains` may therefore weigh fine levels less than the encoding itself does (Lin et al., "BARF", 2021, section 3.3).
The torch backend is in `encode_torch.py`.
"""

from __future__ import annotations

import torch
import warp as wp

from . import encode_torch
from .device import backend_of
from .encode import FEATURES, across, cell_of, feature
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
    low, high, f = cell_of(points[i], resolution, base, size)
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
    dx = across(across(b00 - a00, b10 - a10, f[1]), across(b01 - a01, b11 - a11, f[1]), f[2])
    c00 = across(a00, b00, f[0])
    c10 = across(a10, b10, f[0])
    c01 = across(a01, b01, f[0])
    c11 = across(a11, b11, f[0])
    dy = across(c10 - c00, c11 - c01, f[2])
    dz = across(c01 - c00, c11 - c10, f[1])
    grad_points[i] = grad_points[i] + wp.vec3(dx, dy, dz) * (gain * float(resolution - 1))


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
    if not backend_of(points.device).warp:
        return encode_torch.backward_points(table, levels, gains, points, grad_out)
    init()
    out = torch.zeros_like(points)
    grad = array(grad_out.reshape(len(points), len(levels), FEATURES), feature)
    rows, where, target = array(table, feature), array(points, wp.vec3), array(out, wp.vec3)
    for index, (resolution, base, size) in enumerate(levels):
        if gains[index] != 0.0:
            inputs = [rows, where, grad, index, resolution, base, size, gains[index], target]
            launch(encode_points_backward, len(points), inputs, points.device)
    return out
