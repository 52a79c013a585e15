"""The kernels of `encode.py` for the CPU, with vector types of the compiler.

Warp computes a vector's numbers one by one and looks up strides for each entry of an array; the four features of a vertex
are one register here, which takes less than half the time. Same arguments, same results up to rounding. Arrays are
contiguous.
"""

from __future__ import annotations

import warp as wp

from .encode_torch import BLOCK, FEATURES

feature = wp.types.vector(length=FEATURES, dtype=wp.float32)

FEATURE = """
    typedef float Feature __attribute__((vector_size(16), aligned(4)));
"""

# Of a point's cell in a level: rows a… of the corners with x0 and b… with x1 (y, z), counted from the level's first; and
# the point's place in the cell.
_CELL = """
        const float scale = (float)(resolution - 1);
        const float qx = point[0] * scale, qy = point[1] * scale, qz = point[2] * scale;
        const int last = resolution - 2;
        int ix = (int)qx, iy = (int)qy, iz = (int)qz;
        ix = ix < 0 ? 0 : (ix > last ? last : ix);
        iy = iy < 0 ? 0 : (iy > last ? last : iy);
        iz = iz < 0 ? 0 : (iz > last ? last : iz);
        const float fx = qx - (float)ix, fy = qy - (float)iy, fz = qz - (float)iz;
        size_t a00, a10, a01, a11, b00, b10, b01, b11;
        if ((long long)resolution * resolution * resolution <= (long long)size) {
            const size_t plane = (size_t)resolution * resolution;
            a00 = (size_t)iz * plane + (size_t)iy * resolution + ix;
            a10 = a00 + resolution; a01 = a00 + plane; a11 = a01 + resolution;
            b00 = a00 + 1; b10 = a10 + 1; b01 = a01 + 1; b11 = a11 + 1;
        } else {
            const unsigned mask = (unsigned)size - 1u, x0 = ix, x1 = ix + 1;
            const unsigned y0 = (unsigned)iy * 2654435761u, y1 = y0 + 2654435761u;
            const unsigned z0 = (unsigned)iz * 805459861u, z1 = z0 + 805459861u;
            a00 = (x0 ^ y0 ^ z0) & mask; a10 = (x0 ^ y1 ^ z0) & mask;
            a01 = (x0 ^ y0 ^ z1) & mask; a11 = (x0 ^ y1 ^ z1) & mask;
            b00 = (x1 ^ y0 ^ z0) & mask; b10 = (x1 ^ y1 ^ z0) & mask;
            b01 = (x1 ^ y0 ^ z1) & mask; b11 = (x1 ^ y1 ^ z1) & mask;
        }
"""


# The features of a point, level by level.
ENCODE = (
    FEATURE
    + """
    auto encode_point = [&](const float* point, Feature* encoded) {
    for (int level = 0; level < count; ++level) {
        const float gain = ((const float*)gains.data)[level];
        if (gain == 0.0f) {
            encoded[level] = Feature{0.0f, 0.0f, 0.0f, 0.0f};
            continue;
        }
        const int* layout = (const int*)levels.data + 3 * level;
        const int resolution = layout[0], size = layout[2];
        const Feature* rows = (const Feature*)table.data + layout[1];
"""
    + _CELL
    + """
        const float gx = 1.0f - fx, gy = 1.0f - fy;
        const Feature v00 = rows[a00] * gx + rows[b00] * fx, v10 = rows[a10] * gx + rows[b10] * fx;
        const Feature v01 = rows[a01] * gx + rows[b01] * fx, v11 = rows[a11] * gx + rows[b11] * fx;
        encoded[level] = (v00 * gy + v10 * fy) * ((1.0f - fz) * gain) + (v01 * gy + v11 * fy) * (fz * gain);
    }
    };
"""
)


@wp.func_native(
    ENCODE + "encode_point((const float*)points.data + 3 * (size_t)i, (Feature*)out.data + (size_t)i * count);"
)
def _encode(
    table: wp.array(dtype=feature),
    points: wp.array(dtype=wp.vec3),
    levels: wp.array(dtype=wp.vec3i),
    gains: wp.array(dtype=float),
    out: wp.array(dtype=feature, ndim=2),
    i: int,
    count: int,
): ...


@wp.func_native(
    FEATURE
    + """
    const float gain = ((const float*)gains.data)[level];
    if (gain == 0.0f) return;
    const int* layout = (const int*)levels.data + 3 * level;
    const int resolution = layout[0], size = layout[2];
    const float* point = (const float*)points.data + 3 * (size_t)i;
    Feature* rows = (Feature*)grad_table.data + layout[1];
    unsigned char* flags = (unsigned char*)touched.data + layout[1] / block;
"""
    + _CELL
    + """
    const Feature g = ((const Feature*)grad_out.data)[(size_t)i * count + level] * gain;
    const Feature g0 = g * (1.0f - fx), g1 = g * fx;
    const float w00 = (1.0f - fy) * (1.0f - fz), w10 = fy * (1.0f - fz), w01 = (1.0f - fy) * fz, w11 = fy * fz;
    rows[a00] += g0 * w00; rows[b00] += g1 * w00;
    rows[a10] += g0 * w10; rows[b10] += g1 * w10;
    rows[a01] += g0 * w01; rows[b01] += g1 * w01;
    rows[a11] += g0 * w11; rows[b11] += g1 * w11;
    flags[a00 / block] = 1; flags[b00 / block] = 1; flags[a10 / block] = 1; flags[b10 / block] = 1;
    flags[a01 / block] = 1; flags[b01 / block] = 1; flags[a11 / block] = 1; flags[b11 / block] = 1;
"""
)
def _add_gradient(
    points: wp.array(dtype=wp.vec3),
    grad_out: wp.array(dtype=feature, ndim=2),
    levels: wp.array(dtype=wp.vec3i),
    gains: wp.array(dtype=float),
    grad_table: wp.array(dtype=feature),
    touched: wp.array(dtype=wp.uint8),
    i: int,
    level: int,
    count: int,
    block: wp.uint32,
): ...


@wp.func_native(
    FEATURE
    + """
    Feature* values = (Feature*)table.data, *grads = (Feature*)grad.data;
    Feature* means = (Feature*)mean.data, *squares = (Feature*)square.data;
    int bad = 0;
    for (int row = begin; row < end; ++row) {
        const Feature g = grads[row];
        const Feature gg = g * g;
        const float size = gg[0] + gg[1] + gg[2] + gg[3];
        if (!wp::isfinite(size)) {  // left there it would keep the row from ever moving again
            bad += 1;
        } else if (size > 0.0f) {
            const Feature m = means[row] * beta1 + g * (1.0f - beta1);
            const Feature v = squares[row] * beta2 + gg * (1.0f - beta2);
            values[row] -= rate * m / (__builtin_elementwise_sqrt(v) + epsilon);
            means[row] = m;
            squares[row] = v;
        } else {
            continue;
        }
        grads[row] = Feature{0.0f, 0.0f, 0.0f, 0.0f};
    }
    return bad;
"""
)
def _adam_rows(
    table: wp.array(dtype=feature),
    grad: wp.array(dtype=feature),
    mean: wp.array(dtype=feature),
    square: wp.array(dtype=feature),
    begin: int,
    end: int,
    rate: float,
    beta1: float,
    beta2: float,
    epsilon: float,
) -> int: ...


@wp.kernel(module="fieldwork_encode_host")
def encode_forward(
    table: wp.array(dtype=feature),
    points: wp.array(dtype=wp.vec3),
    levels: wp.array(dtype=wp.vec3i),
    gains: wp.array(dtype=float),
    out: wp.array(dtype=feature, ndim=2),
    offset: int,
):
    _encode(table, points, levels, gains, out, wp.tid() + offset, levels.shape[0])


@wp.kernel(module="fieldwork_encode_host")
def encode_backward(
    points: wp.array(dtype=wp.vec3),
    grad_out: wp.array(dtype=feature, ndim=2),
    levels: wp.array(dtype=wp.vec3i),
    gains: wp.array(dtype=float),
    grad_table: wp.array(dtype=feature),
    touched: wp.array(dtype=wp.uint8),
    offset: int,
):
    # No two threads write a level at the same time: nothing is atomic.
    index = wp.tid() + offset
    level = index / points.shape[0]
    i = index - level * points.shape[0]
    _add_gradient(points, grad_out, levels, gains, grad_table, touched, i, level, levels.shape[0], wp.uint32(BLOCK))


@wp.kernel(module="fieldwork_encode_host")
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
    end = wp.min(begin + BLOCK, table.shape[0])
    bad = _adam_rows(table, grad, mean, square, begin, end, rate, beta1, beta2, epsilon)
    if bad > 0:
        wp.atomic_add(lost, 0, bad)
