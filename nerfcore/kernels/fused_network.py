"""Device functions of the fused renderer: encodings of one sample, and layers shared by a block of samples.

A block of `lanes` threads works on one sample each. What a sample knows of itself is a vector in its thread; a layer
joins the vectors of the block into a tile (features × lanes), multiplies it with the layer's matrix in one
`wp.tile_matmul` (half precision in, single precision sums) and hands each thread its column. Shared memory is taken
inside `layer` only, so that the kernel needs no more than its largest layer.
"""

from functools import cache
from typing import Any

import warp as wp

from .encode import FEATURES, across, cell_of

half_feature = wp.types.vector(length=FEATURES, dtype=wp.float16)
GRANULE = 16  # sides of matrices are multiples of this, as the matrix units want them


def padded(size: int) -> int:
    """`size` rounded up to what the matrix units take."""
    return -(-size // GRANULE) * GRANULE


@cache
def half_vector(length: int) -> Any:
    return wp.types.vector(length=length, dtype=wp.float16)


@wp.func
def rectified(x: float):
    return wp.float16(wp.max(x, 0.0))


@wp.func
def widened(v: half_feature):
    return wp.vec4(float(v[0]), float(v[1]), float(v[2]), float(v[3]))


@cache
def layer(inputs: int, outputs: int, lanes: int, hidden: bool) -> Any:
    """A device function x (inputs,) → W x (outputs,), W at `row` of the packed weights.

    A hidden layer's result is rectified and half precision; the last layer's is single precision.
    """

    def hidden_layer(x: half_vector(inputs), weights: wp.array2d(dtype=wp.float16), row: int):
        matrix = wp.tile_load(weights, shape=(outputs, inputs), offset=(row, 0), storage="shared")
        total = wp.tile_empty(shape=(outputs, lanes), dtype=float, storage="shared")
        wp.tile_matmul(matrix, wp.tile(x), total, beta=0.0)
        return wp.untile(wp.tile_map(rectified, total))

    def last_layer(x: half_vector(inputs), weights: wp.array2d(dtype=wp.float16), row: int):
        matrix = wp.tile_load(weights, shape=(outputs, inputs), offset=(row, 0), storage="shared")
        total = wp.tile_empty(shape=(outputs, lanes), dtype=float, storage="shared")
        wp.tile_matmul(matrix, wp.tile(x), total, beta=0.0)
        return wp.untile(total)

    function = hidden_layer if hidden else last_layer
    name = f"{function.__name__}_{inputs}_{outputs}_{lanes}"
    return wp.func(function, name=name)


@cache
def network(sizes: tuple[int, ...], lanes: int) -> Any:
    """A device function of a ReLU network: x (sizes[0],) half → (sizes[-1],) float; layers lie `sizes[k + 1]` rows
    after one another in the packed weights. Two or three matrix products."""
    if len(sizes) == 3:
        first = layer(sizes[0], sizes[1], lanes, True)
        last = layer(sizes[1], sizes[2], lanes, False)
        after = wp.constant(sizes[1])

        def run(x: half_vector(sizes[0]), weights: wp.array2d(dtype=wp.float16), row: int):
            return last(first(x, weights, row), weights, row + after)

    elif len(sizes) == 4:
        first = layer(sizes[0], sizes[1], lanes, True)
        second = layer(sizes[1], sizes[2], lanes, True)
        last = layer(sizes[2], sizes[3], lanes, False)
        after, later = wp.constant(sizes[1]), wp.constant(sizes[1] + sizes[2])

        def run(x: half_vector(sizes[0]), weights: wp.array2d(dtype=wp.float16), row: int):
            return last(second(first(x, weights, row), weights, row + after), weights, row + later)

    else:
        raise ValueError(f"networks of {len(sizes) - 1} matrix products are not supported")
    return wp.func(run, name="network_" + "_".join(map(str, (*sizes, lanes))))


@cache
def grid_encoding(levels: int, length: int) -> Any:
    """A device function: point in [0, 1]³ → features of all levels, trilinear, padded with zeros to `length`."""
    vector = half_vector(length)

    def encode(
        p: wp.vec3, table: wp.array(dtype=half_feature), layout: wp.array2d(dtype=int), gains: wp.array(dtype=float)
    ):
        out = vector()
        for level in range(levels):
            low, high, f = cell_of(p, layout[level, 0], layout[level, 1], layout[level, 2])
            v00 = across(widened(table[low[0]]), widened(table[high[0]]), f[0])
            v10 = across(widened(table[low[1]]), widened(table[high[1]]), f[0])
            v01 = across(widened(table[low[2]]), widened(table[high[2]]), f[0])
            v11 = across(widened(table[low[3]]), widened(table[high[3]]), f[0])
            value = across(across(v00, v10, f[1]), across(v01, v11, f[1]), f[2]) * gains[level]
            for k in range(FEATURES):
                out[level * FEATURES + k] = wp.float16(value[k])
        return out

    return wp.func(encode, name=f"grid_encoding_{levels}_{length}")


@cache
def frequency_encoding(octaves: int, length: int) -> Any:
    """A device function: point in [0, 1]³ → x, then sin and cos of 2^k π x, as `field.encoding` has them."""
    vector = half_vector(length)

    def encode(p: wp.vec3):
        out = vector()
        for a in range(3):
            x = p[a] * 2.0 - 1.0
            sine = wp.sin(wp.pi * x)
            cosine = wp.cos(wp.pi * x)
            out[a] = wp.float16(x)
            for k in range(octaves):
                out[3 + 6 * k + a] = wp.float16(sine)
                out[6 + 6 * k + a] = wp.float16(cosine)
                twice = 2.0 * sine * cosine
                cosine = 1.0 - 2.0 * sine * sine
                sine = twice
        return out

    return wp.func(encode, name=f"frequency_encoding_{octaves}_{length}")


harmonics = wp.types.vector(length=16, dtype=wp.float32)


@wp.func
def spherical_harmonics(d: wp.vec3):
    """The 16 real spherical harmonics of degree < 4, as `field.encoding` has them."""
    x = d[0]
    y = d[1]
    z = d[2]
    xx = x * x
    yy = y * y
    zz = z * z
    return harmonics(
        0.28209479,
        -0.48860251 * y,
        0.48860251 * z,
        -0.48860251 * x,
        1.09254843 * x * y,
        -1.09254843 * y * z,
        0.31539157 * (3.0 * zz - 1.0),
        -1.09254843 * x * z,
        0.54627422 * (xx - yy),
        -0.59004359 * y * (3.0 * xx - yy),
        2.89061144 * x * y * z,
        -0.45704580 * y * (5.0 * zz - 1.0),
        0.37317633 * z * (5.0 * zz - 3.0),
        -0.45704580 * x * (5.0 * zz - 1.0),
        1.44530572 * z * (xx - yy),
        -0.59004359 * x * (xx - 3.0 * yy),
    )
