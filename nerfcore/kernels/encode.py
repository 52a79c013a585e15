"""Trilinear encoding of points on a multi-resolution vertex grid, its gradient, and Adam on touched entries.

One table holds all levels, `FEATURES` float32 a vertex. A level is *dense* when its (resolution)³ vertices fit its
share of the table, else *hashed* (Müller et al., "Instant Neural Graphics Primitives", 2022, eq. 4).
The torch backend is in `encode_torch.py`; the kernels that the CPU runs instead of those below, in `encode_host.py`.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any

import torch
import warp as wp

from . import encode_host, encode_torch
from .device import backend_of, on_host
from .encode_torch import BLOCK, FEATURES
from .runtime import array, init, launch, load, run_parallel, small_tensor

feature = wp.types.vector(length=FEATURES, dtype=wp.float32)

# Primes of the spatial hash; the first is 1 so that neighbours along x share cache lines.
P1 = wp.constant(wp.uint32(2654435761))
P2 = wp.constant(wp.uint32(805459861))


@wp.func
def corner_rows(ix: int, iy: int, iz: int, resolution: int, size: int, base: int):
    """Table rows of the four corner pairs along x: (x0y0z0, x0y1z0, x0y0z1, x0y1z1) and the same with x1."""
    side = wp.int64(resolution)
    # In 32 bits resolution³ would overflow from 1291 on.
    if side * side * side <= wp.int64(size):
        row = base + (iz * resolution + iy) * resolution + ix
        plane = resolution * resolution
        low = wp.vec4i(row, row + resolution, row + plane, row + plane + resolution)
        return low, low + wp.vec4i(1, 1, 1, 1)
    mask = wp.uint32(size - 1)
    x0 = wp.uint32(ix)
    x1 = wp.uint32(ix + 1)
    y0 = wp.uint32(iy) * P1
    y1 = wp.uint32(iy + 1) * P1
    z0 = wp.uint32(iz) * P2
    z1 = wp.uint32(iz + 1) * P2
    h00 = y0 ^ z0
    h10 = y1 ^ z0
    h01 = y0 ^ z1
    h11 = y1 ^ z1
    low = wp.vec4i(
        base + int((x0 ^ h00) & mask),
        base + int((x0 ^ h10) & mask),
        base + int((x0 ^ h01) & mask),
        base + int((x0 ^ h11) & mask),
    )
    high = wp.vec4i(
        base + int((x1 ^ h00) & mask),
        base + int((x1 ^ h10) & mask),
        base + int((x1 ^ h01) & mask),
        base + int((x1 ^ h11) & mask),
    )
    return low, high


@wp.func
def cell_of(p: wp.vec3, resolution: int, base: int, size: int):
    """Table rows of the corners of the cell that holds a point of [0, 1]³, as `corner_rows` has them, and the point's
    place in the cell."""
    q = p * float(resolution - 1)
    ix = wp.clamp(int(q[0]), 0, resolution - 2)
    iy = wp.clamp(int(q[1]), 0, resolution - 2)
    iz = wp.clamp(int(q[2]), 0, resolution - 2)
    low, high = corner_rows(ix, iy, iz, resolution, size, base)
    return low, high, q - wp.vec3(float(ix), float(iy), float(iz))


@wp.func
def across(low: Any, high: Any, f: float):
    """From `low` at f = 0 to `high` at 1."""
    return low * (1.0 - f) + high * f


@wp.kernel(module="fieldwork_encode")
def encode_forward(
    table: wp.array(dtype=feature),
    points: wp.array(dtype=wp.vec3),
    levels: wp.array(dtype=wp.vec3i),
    gains: wp.array(dtype=float),
    out: wp.array(dtype=feature, ndim=2),
    offset: int,
):
    i = wp.tid() + offset
    p = points[i]
    for level in range(levels.shape[0]):
        gain = gains[level]
        if gain == 0.0:
            out[i, level] = feature()
            continue
        layout = levels[level]
        low, high, f = cell_of(p, layout[0], layout[1], layout[2])
        v00 = across(table[low[0]], table[high[0]], f[0])
        v10 = across(table[low[1]], table[high[1]], f[0])
        v01 = across(table[low[2]], table[high[2]], f[0])
        v11 = across(table[low[3]], table[high[3]], f[0])
        out[i, level] = across(v00, v10, f[1]) * ((1.0 - f[2]) * gain) + across(v01, v11, f[1]) * (f[2] * gain)


@wp.func
def add(target: wp.array(dtype=feature), touched: wp.array(dtype=wp.uint8), row: int, value: feature):
    wp.atomic_add(target, row, value)
    touched[row / BLOCK] = wp.uint8(1)


@wp.kernel(module="fieldwork_encode")
def encode_backward(
    points: wp.array(dtype=wp.vec3),
    grad_out: wp.array(dtype=feature, ndim=2),
    levels: wp.array(dtype=wp.vec3i),
    gains: wp.array(dtype=float),
    grad_table: wp.array(dtype=feature),
    touched: wp.array(dtype=wp.uint8),
    offset: int,
):
    # All points of a level after those of the level before: its threads write near each other.
    index = wp.tid() + offset
    level = index / points.shape[0]
    gain = gains[level]
    if gain == 0.0:
        return
    i = index - level * points.shape[0]
    g = grad_out[i, level] * gain
    if wp.dot(g, g) == 0.0:
        return  # unused entries all lie at one point, where their threads would wait for each other
    layout = levels[level]
    low, high, f = cell_of(points[i], layout[0], layout[1], layout[2])
    g0 = g * (1.0 - f[0])
    g1 = g * f[0]
    w00 = (1.0 - f[1]) * (1.0 - f[2])
    w10 = f[1] * (1.0 - f[2])
    w01 = (1.0 - f[1]) * f[2]
    w11 = f[1] * f[2]
    add(grad_table, touched, low[0], g0 * w00)
    add(grad_table, touched, high[0], g1 * w00)
    add(grad_table, touched, low[1], g0 * w10)
    add(grad_table, touched, high[1], g1 * w10)
    add(grad_table, touched, low[2], g0 * w01)
    add(grad_table, touched, high[2], g1 * w01)
    add(grad_table, touched, low[3], g0 * w11)
    add(grad_table, touched, high[3], g1 * w11)


@wp.kernel(module="fieldwork_encode")
def adam_touched(
    table: wp.array(dtype=feature),
    grad: wp.array(dtype=feature),
    mean: wp.array(dtype=feature),
    square: wp.array(dtype=feature),
    touched: wp.array(dtype=wp.uint8),
    rate: float,
    beta1: float,
    beta2: float,
    epsilon: float,
    lost: wp.array(dtype=int),
    offset: int,
):
    block = wp.tid() + offset
    if touched[block] == wp.uint8(0):
        return
    touched[block] = wp.uint8(0)
    begin = block * BLOCK
    for row in range(begin, wp.min(begin + BLOCK, table.shape[0])):
        g = grad[row]
        size = wp.dot(g, g)
        if not wp.isfinite(size):
            # Left there it would keep the row from ever moving again.
            wp.atomic_add(lost, 0, 1)
            grad[row] = feature()
        elif size > 0.0:
            m = mean[row] * beta1 + g * (1.0 - beta1)
            v = square[row] * beta2 + wp.cw_mul(g, g) * (1.0 - beta2)
            value = table[row]
            for k in range(FEATURES):
                value[k] = value[k] - rate * m[k] / (wp.sqrt(v[k]) + epsilon)
            mean[row] = m
            square[row] = v
            table[row] = value
            grad[row] = feature()


def forward(
    table: torch.Tensor,
    levels: list[tuple[int, int, int]],
    gains: list[float],
    points: torch.Tensor,
    factors: torch.Tensor | None = None,
) -> torch.Tensor:
    """Encode `points` (N, 3) in [0, 1]³ → features (N, levels · FEATURES) float32.

    Args:
        table: (rows, FEATURES) float32.
        levels: (resolution, first row, rows) of each level.
        gains: factor of each level's features (coarse-to-fine fading).
        factors: `gains` (L,) float32 on the device, where the caller keeps them: a recording of this reads them there.
    """
    device = points.device
    if not backend_of(device).warp:
        return encode_torch.forward(table, levels, gains, points)
    init()
    out = torch.empty(len(points), len(levels), FEATURES, device=device)
    layout, factors = _on_device(levels, gains, factors, device)
    inputs = [array(table, feature), array(points, wp.vec3), array(layout, wp.vec3i), array(factors)]
    kernel = encode_host.encode_forward if on_host(device) else encode_forward
    launch(kernel, len(points), [*inputs, array(out, feature)], device)
    return out.flatten(1)


def _on_device(
    levels: list[tuple[int, int, int]], gains: list[float], factors: torch.Tensor | None, device: torch.device
) -> tuple[torch.Tensor, torch.Tensor]:
    """Layout (L, 3) int32 and factors (L,) float32 of the levels."""
    factors = _kept(tuple(gains), torch.float32, device) if factors is None else factors
    return _kept(tuple(levels), torch.int32, device), factors


# A step reads them many times, and they change only while levels fade in.
_kept = lru_cache(maxsize=64)(small_tensor)


def scatter(
    grad_table: torch.Tensor,
    touched: torch.Tensor,
    levels: list[tuple[int, int, int]],
    gains: list[float],
    parts: list[tuple[torch.Tensor, torch.Tensor]],
    factors: torch.Tensor | None = None,
) -> None:
    """Add the gradient of `forward` to `grad_table` (rows, FEATURES) and mark touched blocks (uint8).

    Args:
        factors: as for `forward`.
        parts: points (N, 3) and the gradient (N, levels · FEATURES) float32 of their features, any number of times.

    On the CPU each level is one task, so no two threads write the same row and the sum has a fixed order.
    On CUDA all levels of a part are one launch, and rows are summed with atomics.
    """
    if not backend_of(grad_table.device).warp:
        return encode_torch.scatter(grad_table, touched, levels, gains, parts)
    init()
    rows, flags = array(grad_table, feature), array(touched)
    arrays = [
        (array(points, wp.vec3), array(grad.reshape(len(points), len(levels), FEATURES), feature))
        for points, grad in parts
        if len(points)
    ]
    device = grad_table.device

    layout, factors = _on_device(levels, gains, factors, device)
    shared = [array(layout, wp.vec3i), array(factors), rows, flags]
    if not backend_of(device).host_threads:
        for where, grad in arrays:
            launch(encode_backward, len(levels) * where.shape[0], [where, grad, *shared], device)
        return
    kernel = encode_host.encode_backward if on_host(device) else encode_backward
    load(kernel, device)

    def one_level(index: int) -> None:
        for where, grad in arrays:
            count = where.shape[0]
            wp.launch(kernel, dim=count, inputs=[where, grad, *shared, index * count], device="cpu")

    # Levels share no block (rows are padded to BLOCK), so their flags do not race either.
    active = [index for index in range(len(levels)) if gains[index] != 0.0]
    run_parallel([partial(one_level, index) for index in reversed(active)], device)


def adam(
    table: torch.Tensor,
    grad: torch.Tensor,
    mean: torch.Tensor,
    square: torch.Tensor,
    touched: torch.Tensor,
    lost: torch.Tensor,
    rate: float,
    betas: tuple[float, float] = (0.9, 0.99),
    epsilon: float = 1e-15,
) -> None:
    """One Adam step on the rows whose gradient is not zero; gradients and flags are cleared.

    `rate` already holds the bias correction. Rows never touched keep their value and moments ("lazy" Adam), and so do
    those whose gradient is not finite: their number is added to `lost` (1,) int32.
    """
    if not backend_of(table.device).warp:
        return encode_torch.adam(table, grad, mean, square, touched, lost, rate, betas, epsilon)
    init()
    launch(
        encode_host.adam_touched if on_host(table.device) else adam_touched,
        len(touched),
        [array(table, feature), array(grad, feature), array(mean, feature), array(square, feature), array(touched)]
        + [rate, betas[0], betas[1], epsilon, array(lost)],
        table.device,
    )
