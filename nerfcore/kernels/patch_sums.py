"""The inner loop of comparing photos: a patch read from another view, at places that an affine map gives.

Twice: for every device, and with vector types of the CPU's compiler, which do it in two fifths of the time.
"""

from __future__ import annotations

import warp as wp

_patch = wp.types.vector(length=25, dtype=float)


@wp.struct
class Patch:
    """Grey values around a pixel, row by row."""

    values: _patch
    mean: float
    variance: float


@wp.struct
class Window:
    """Where the 5 × 5 places of a patch lie in a photo: its first pixel and its width; x, y of the middle one, counted
    from the middle of the photo's first pixel; the way from one place to the next along a row (a) and a column (b)."""

    first: int
    width: int
    x: float
    y: float
    ax: float
    ay: float
    bx: float
    by: float


@wp.func
def bilinear(grey: wp.array(dtype=float), first: int, width: int, x: float, y: float):
    """Grey value at x, y counted from the middle of a photo's first pixel."""
    column = int(x)
    row = int(y)
    fx = x - float(column)
    fy = y - float(row)
    place = first + row * width + column
    upper = grey[place] + fx * (grey[place + 1] - grey[place])
    lower = grey[place + width] + fx * (grey[place + width + 1] - grey[place + width])
    return upper + fy * (lower - upper)


@wp.func
def patch_sums(grey: wp.array(dtype=float), w: Window, patch: Patch):
    """Sums over the window's values, their squares, and their products with the patch's."""
    values = float(0.0)
    squares = float(0.0)
    products = float(0.0)
    for k in range(25):
        i = float(k % 5 - 2)
        j = float(k / 5 - 2)
        g = bilinear(grey, w.first, w.width, w.x + i * w.ax + j * w.bx, w.y + i * w.ay + j * w.by)
        values += g
        squares += g * g
        products += g * patch.values[k]
    return wp.vec3(values, squares, products)


# Eight places at once, in three rounds, and the last one alone: the same numbers in another order.
_HOST = """
#if defined(__CUDA_ARCH__)
    return wp::vec_t<3, float>();
#else
    typedef float Floats __attribute__((vector_size(32)));
    typedef int Ints __attribute__((vector_size(32)));
    const Floats right[3] = {
        {-2, -1, 0, 1, 2, -2, -1, 0}, {1, 2, -2, -1, 0, 1, 2, -2}, {-1, 0, 1, 2, -2, -1, 0, 1}};
    const Floats down[3] = {
        {-2, -2, -2, -2, -2, -1, -1, -1}, {-1, -1, 0, 0, 0, 0, 0, 1}, {1, 1, 1, 1, 2, 2, 2, 2}};
    const float* pixels = (const float*)grey.data + w.first;
    Floats values = {0}, squares = {0}, products = {0};
    for (int round = 0; round < 3; ++round) {
        const Floats x = w.x + right[round] * w.ax + down[round] * w.bx;
        const Floats y = w.y + right[round] * w.ay + down[round] * w.by;
        const Ints column = __builtin_convertvector(x, Ints), row = __builtin_convertvector(y, Ints);
        const Floats fx = x - __builtin_convertvector(column, Floats);
        const Floats fy = y - __builtin_convertvector(row, Floats);
        const Ints place = row * w.width + column;
        Floats a, b, c, d, known;
        for (int k = 0; k < 8; ++k) {
            const float* at = pixels + place[k];
            a[k] = at[0]; b[k] = at[1]; c[k] = at[w.width]; d[k] = at[w.width + 1];
            known[k] = patch.values[8 * round + k];
        }
        const Floats upper = a + fx * (b - a), lower = c + fx * (d - c);
        const Floats g = upper + fy * (lower - upper);
        values += g;
        squares += g * g;
        products += g * known;
    }
    const float x = w.x + 2.0f * w.ax + 2.0f * w.bx, y = w.y + 2.0f * w.ay + 2.0f * w.by;
    const float* at = pixels + (int)y * w.width + (int)x;
    const float fx = x - (float)(int)x, fy = y - (float)(int)y;
    const float upper = at[0] + fx * (at[1] - at[0]);
    const float lower = at[w.width] + fx * (at[w.width + 1] - at[w.width]);
    const float g = upper + fy * (lower - upper);
    wp::vec_t<3, float> sums(g, g * g, g * patch.values[24]);
    for (int k = 0; k < 8; ++k) {
        sums[0] += values[k]; sums[1] += squares[k]; sums[2] += products[k];
    }
    return sums;
#endif
"""


@wp.func_native(_HOST)
def patch_sums_host(grey: wp.array(dtype=float), w: Window, patch: Patch) -> wp.vec3: ...
