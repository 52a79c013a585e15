"""The inner loop of comparing photos: a patch read from another view, at places that an affine map gives.

Twice: for every device, and with vector types of the CPU's compiler.
"""

from __future__ import annotations

import torch
import warp as wp

_patch = wp.types.vector(length=25, dtype=float)
WHITE = wp.constant(65535.0)


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


def quads(grey: torch.Tensor) -> torch.Tensor:
    """Each pixel of a picture (H, W) in [0, 1] and those right of it, below, and below and right, as four numbers of 16
    bits: (H·W, 4) int16 to be read as unsigned. What lies between pixels is then one read instead of four. Pixels of the last column
    and row are their own neighbours."""
    padded = torch.nn.functional.pad(grey[None], (0, 1, 0, 1), mode="replicate")[0]
    corners = [padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]]
    numbers = (torch.stack(corners, -1).clamp(0, 1) * float(WHITE)).round().int()
    return torch.where(numbers > 32767, numbers - 65536, numbers).short().reshape(-1, 4)


@wp.func
def corner(quad: wp.uint64, number: int):
    return float((quad >> wp.uint64(16 * number)) & wp.uint64(0xFFFF)) / WHITE


@wp.func
def bilinear(quads: wp.array(dtype=wp.uint64), first: int, width: int, x: float, y: float):
    """Grey value at x, y counted from the middle of a photo's first pixel."""
    column = int(x)
    row = int(y)
    fx = x - float(column)
    fy = y - float(row)
    quad = quads[first + row * width + column]
    upper = corner(quad, 0) + fx * (corner(quad, 1) - corner(quad, 0))
    lower = corner(quad, 2) + fx * (corner(quad, 3) - corner(quad, 2))
    return upper + fy * (lower - upper)


@wp.func
def patch_sums(quads: wp.array(dtype=wp.uint64), w: Window, patch: Patch):
    """Sums over the window's values, their squares, and their products with the patch's."""
    values = float(0.0)
    squares = float(0.0)
    products = float(0.0)
    for k in range(25):
        i = float(k % 5 - 2)
        j = float(k / 5 - 2)
        g = bilinear(quads, w.first, w.width, w.x + i * w.ax + j * w.bx, w.y + i * w.ay + j * w.by)
        values += g
        squares += g * g
        products += g * patch.values[k]
    return wp.vec3(values, squares, products)


# Eight places at once, in three rounds, and the last one alone: the same numbers in another order. Quads of eight places are
# read in an order from which two shuffles bring the upper and the lower corners of all eight together.
_HOST = """
#if defined(__CUDA_ARCH__)
    return wp::vec_t<3, float>();
#else
    typedef float Floats __attribute__((vector_size(32)));
    typedef int Ints __attribute__((vector_size(32)));
    typedef unsigned Words __attribute__((vector_size(32)));
    typedef unsigned long long Quads __attribute__((vector_size(32)));
    const Floats right[3] = {
        {-2, -1, 0, 1, 2, -2, -1, 0}, {1, 2, -2, -1, 0, 1, 2, -2}, {-1, 0, 1, 2, -2, -1, 0, 1}};
    const Floats down[3] = {
        {-2, -2, -2, -2, -2, -1, -1, -1}, {-1, -1, 0, 0, 0, 0, 0, 1}, {1, 1, 1, 1, 2, 2, 2, 2}};
    const unsigned long long* pixels = (const unsigned long long*)quads.data + w.first;
    Floats values = {0}, squares = {0}, products = {0};
    #pragma unroll
    for (int round = 0; round < 3; ++round) {
        const Floats x = w.x + right[round] * w.ax + down[round] * w.bx;
        const Floats y = w.y + right[round] * w.ay + down[round] * w.by;
        const Ints column = __builtin_convertvector(x, Ints), row = __builtin_convertvector(y, Ints);
        const Floats fx = x - __builtin_convertvector(column, Floats);
        const Floats fy = y - __builtin_convertvector(row, Floats);
        const Ints place = row * w.width + column;
        const Quads one = {pixels[place[0]], pixels[place[1]], pixels[place[4]], pixels[place[5]]};
        const Quads two = {pixels[place[2]], pixels[place[3]], pixels[place[6]], pixels[place[7]]};
        const Words upper_pair = __builtin_shufflevector((Words)one, (Words)two, 0, 2, 8, 10, 4, 6, 12, 14);
        const Words lower_pair = __builtin_shufflevector((Words)one, (Words)two, 1, 3, 9, 11, 5, 7, 13, 15);
        const Floats a = __builtin_convertvector((Ints)(upper_pair & 0xFFFFu), Floats);
        const Floats b = __builtin_convertvector((Ints)(upper_pair >> 16), Floats);
        const Floats c = __builtin_convertvector((Ints)(lower_pair & 0xFFFFu), Floats);
        const Floats d = __builtin_convertvector((Ints)(lower_pair >> 16), Floats);
        const Floats upper = a + fx * (b - a), lower = c + fx * (d - c);
        const Floats g = (upper + fy * (lower - upper)) * (1.0f / 65535.0f);
        Floats known;
        __builtin_memcpy(&known, &patch.values[8 * round], 32);
        values += g;
        squares += g * g;
        products += g * known;
    }
    const float x = w.x + 2.0f * w.ax + 2.0f * w.bx, y = w.y + 2.0f * w.ay + 2.0f * w.by;
    const unsigned long long quad = pixels[(int)y * w.width + (int)x];
    const float fx = x - (float)(int)x, fy = y - (float)(int)y;
    const float a = (float)(int)(quad & 0xFFFF), b = (float)(int)(quad >> 16 & 0xFFFF);
    const float c = (float)(int)(quad >> 32 & 0xFFFF), d = (float)(int)(quad >> 48);
    const float upper = a + fx * (b - a), lower = c + fx * (d - c);
    const float g = (upper + fy * (lower - upper)) * (1.0f / 65535.0f);
    // Sums of eight numbers each: halves are added to halves.
    typedef float Four __attribute__((vector_size(16)));
    const Floats ab = __builtin_shufflevector(values, squares, 0, 8, 1, 9, 4, 12, 5, 13)
        + __builtin_shufflevector(values, squares, 2, 10, 3, 11, 6, 14, 7, 15);
    const Floats cc = __builtin_shufflevector(products, products, 0, 0, 1, 1, 4, 4, 5, 5)
        + __builtin_shufflevector(products, products, 2, 2, 3, 3, 6, 6, 7, 7);
    const Floats all = __builtin_shufflevector(ab, cc, 0, 1, 8, 9, 4, 5, 12, 13)
        + __builtin_shufflevector(ab, cc, 2, 3, 10, 11, 6, 7, 14, 15);
    const Four total = __builtin_shufflevector(all, all, 0, 1, 2, 3) + __builtin_shufflevector(all, all, 4, 5, 6, 7);
    return wp::vec_t<3, float>(total[0] + g, total[1] + g * g, total[2] + g * patch.values[24]);
#endif
"""


@wp.func_native(_HOST)
def patch_sums_host(quads: wp.array(dtype=wp.uint64), w: Window, patch: Patch) -> wp.vec3: ...
