"""Device functions of the fused renderer: encodings of one sample, and layers shared by a block of samples.

A block of `lanes` threads works on one sample each. What enters a network is a tile (features × lanes) in shared memory,
a column a sample; so is what passes from layer to layer, and only the last layer hands each thread its column. Matrices
are brought to shared memory and multiplied `MOST_ROWS` rows at a time (`wp.tile_matmul`, half precision in, single
precision sums): a thread holds as many sums in registers. Shared memory is taken inside the functions that need it, so
that a kernel needs no more than its largest network.
"""

from functools import cache
from typing import Any

import warp as wp

from .encode import FEATURES, across, cell_of

half_feature = wp.types.vector(length=FEATURES, dtype=wp.float16)
MOST_ROWS = 32  # measured: docs/experiments.md
GRANULE = 16  # sides of matrices are multiples of this, as the matrix units want them


def padded(size: int) -> int:
    """`size` rounded up to what the matrix units take."""
    return -(-size // GRANULE) * GRANULE


@cache
def half_vector(length: int) -> Any:
    return wp.types.vector(length=length, dtype=wp.float16)


# Warp's own ways from a thread to a tile and back compute every place by divisions, which the compiler moves out of the
# loop over samples into registers that the products need. These take a column as what it is: one of a block's threads.


@wp.func_native("tile.data.ptr[row * WP_TILE_BLOCK_DIM + WP_TILE_THREAD_IDX] = value;")
def put(tile: Any, row: int, value: Any):
    """Write a row of the thread's own column of a tile (rows, lanes) in shared memory."""


@wp.func_native("return WP_TILE_THREAD_IDX;")
def lane() -> int:
    """The thread's own column of tiles."""


@wp.func_native("WP_TILE_SYNC();")
def wait():
    """Wait for the other threads of the block."""


@wp.func_native("""
    WP_TILE_SYNC();  // what others read may lie where the matrix goes
#if defined(__CUDA_ARCH__)
    const float4* from = reinterpret_cast<const float4*>(weights.data + first);  // 8 weights at a time
    float4* to = reinterpret_cast<float4*>(matrix.data.ptr);
    const int pieces = size / 8;
#else
    const wp::half* from = weights.data + first;
    wp::half* to = matrix.data.ptr;
    const int pieces = size;
#endif
    for (int i = WP_TILE_THREAD_IDX; i < pieces; i += WP_TILE_BLOCK_DIM)
        to[i] = from[i];
    WP_TILE_SYNC();
""")
def bring(matrix: Any, weights: wp.array(dtype=wp.float16), first: int, size: int):
    """Copy `size` weights from `first` on to a matrix in shared memory; all that threads wrote before is there then."""


# Without the reduction of large angles, which takes an array of its own.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return sinpif(x);
#else
    return wp::sin(x * 3.14159265f);
#endif
""")
def sine_of_pi(x: float) -> float:
    """sin πx"""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return cospif(x);
#else
    return wp::cos(x * 3.14159265f);
#endif
""")
def cosine_of_pi(x: float) -> float:
    """cos πx"""


@wp.func
def widened(v: half_feature):
    return wp.vec4(float(v[0]), float(v[1]), float(v[2]), float(v[3]))


def part_rows(outputs: int) -> int:
    """Rows of a matrix that are multiplied at a time: as many as divide it, up to `MOST_ROWS`."""
    return next(rows for rows in range(MOST_ROWS, 0, -GRANULE) if outputs % rows == 0)


@cache
def product(inputs: int, rows: int, lanes: int, then: Any) -> Any:
    """A device function: `rows` rows, the first weight of which is at `first`, times a tile (inputs, lanes) half;
    `then` (sums as a tile (rows, lanes) float, `into`, `place`, `scale`) takes the result up."""

    def multiplied(x: Any, weights: wp.array(dtype=wp.float16), first: int, into: Any, place: int, scale: float):
        matrix = wp.tile_empty(shape=(rows, inputs), dtype=wp.float16, storage="shared")
        total = wp.tile_empty(shape=(rows, lanes), dtype=float, storage="shared")
        bring(matrix, weights, first, rows * inputs)
        wp.tile_matmul(matrix, x, total, beta=0.0)
        then(total, into, place, scale)

    return wp.func(multiplied, name=f"product_{inputs}_{rows}_{lanes}_{then.key}")


@cache
def _rectified(rows: int) -> Any:
    def rectified(total: Any, into: Any, place: int, scale: float):
        for k in range(rows):
            put(into, place + k, wp.float16(wp.max(total[k, lane()], 0.0)))

    return wp.func(rectified, name=f"rectified_{rows}")


@cache
def _scaled(rows: int) -> Any:
    def scaled(total: Any, into: Any, place: int, scale: float):
        for k in range(rows):
            put(into, place + k, wp.float16(scale * total[k, lane()]))

    return wp.func(scaled, name=f"scaled_{rows}")


@cache
def layer(inputs: int, outputs: int, lanes: int, hidden: bool) -> Any:
    """A device function: a layer from a tile (inputs, lanes) half, rectified if hidden, else times `scale`, into the
    rows from `place` on of another one."""
    rows = part_rows(outputs)
    part, parts = product(inputs, rows, lanes, (_rectified if hidden else _scaled)(rows)), outputs // rows

    def run(x: Any, weights: wp.array(dtype=wp.float16), first: int, into: Any, place: int, scale: float):
        for k in range(parts):
            part(x, weights, first + k * rows * inputs, into, place + k * rows, scale)

    return wp.func(run, name=f"layer_{inputs}_{outputs}_{lanes}_{int(hidden)}")


@cache
def last_layer(inputs: int, outputs: int, lanes: int) -> Any:
    """A device function: a layer from a tile (inputs, lanes) half to a vector (outputs,) float."""
    rows = part_rows(outputs)
    parts, vector = outputs // rows, wp.types.vector(length=outputs, dtype=wp.float32)
    part_vector = wp.types.vector(length=rows, dtype=wp.float32)

    def part(x: Any, weights: wp.array(dtype=wp.float16), first: int):
        matrix = wp.tile_empty(shape=(rows, inputs), dtype=wp.float16, storage="shared")
        total = wp.tile_empty(shape=(rows, lanes), dtype=float, storage="shared")
        bring(matrix, weights, first, rows * inputs)
        wp.tile_matmul(matrix, x, total, beta=0.0)
        out = part_vector()
        for k in range(rows):
            out[k] = total[k, lane()]
        wait()
        return out

    part_of = wp.func(part, name=f"last_part_{inputs}_{outputs}_{lanes}")

    def last(x: Any, weights: wp.array(dtype=wp.float16), first: int):
        out = vector()
        for k in range(parts):
            values = part_of(x, weights, first + k * rows * inputs)
            for i in range(rows):
                out[k * rows + i] = values[i]
        return out

    return wp.func(last, name=f"last_{inputs}_{outputs}_{lanes}")


@cache
def hidden_layers(sizes: tuple[int, ...], lanes: int) -> Any:
    """A device function: all but the last layer of a ReLU network, of two or three matrix products, from the rows
    0 … sizes[0] − 1 of the tile `x` into the tile `inner` (sizes[-2], lanes), both half; it may overwrite `x`, which
    must have as many rows as the network is wide if there are three. Weights lie row by row and layer by layer from
    `first` on."""
    inputs, width = sizes[0], sizes[1]
    start = layer(inputs, width, lanes, True)
    if len(sizes) == 3:

        def run(x: Any, weights: wp.array(dtype=wp.float16), first: int, inner: Any):
            start(wp.tile_view(x, offset=(0, 0), shape=(inputs, lanes)), weights, first, inner, 0, 1.0)

    elif len(sizes) == 4:
        second = layer(width, width, lanes, True)

        def run(x: Any, weights: wp.array(dtype=wp.float16), first: int, inner: Any):
            start(wp.tile_view(x, offset=(0, 0), shape=(inputs, lanes)), weights, first, inner, 0, 1.0)
            second(inner, weights, first + inputs * width, x, 0, 1.0)
            for k in range(width):
                put(inner, k, x[k, lane()])

    else:
        raise ValueError(f"networks of {len(sizes) - 1} matrix products are not supported")
    return wp.func(run, name="hidden_" + "_".join(map(str, (*sizes[:-1], lanes))))


@cache
def grid_encoding(levels: int) -> Any:
    """A device function: point in [0, 1]³ → features of all levels, trilinear, times `share`, added to the rows of the
    tile `into` from `place` on if `added` is 1, else written there."""

    def encode(
        p: wp.vec3,
        table: wp.array(dtype=half_feature),
        layout: wp.array2d(dtype=int),
        gains: wp.array(dtype=float),
        into: Any,
        place: int,
        share: float,
        added: int,
    ):
        for level in range(layout.shape[0]):  # not unrolled: one level's corners are many registers
            low, high, f = cell_of(p, layout[level, 0], layout[level, 1], layout[level, 2])
            v00 = across(widened(table[low[0]]), widened(table[high[0]]), f[0])
            v10 = across(widened(table[low[1]]), widened(table[high[1]]), f[0])
            v01 = across(widened(table[low[2]]), widened(table[high[2]]), f[0])
            v11 = across(widened(table[low[3]]), widened(table[high[3]]), f[0])
            value = across(across(v00, v10, f[1]), across(v01, v11, f[1]), f[2]) * gains[level]
            row = place + level * FEATURES
            for k in range(FEATURES):
                feature = share * float(wp.float16(value[k]))
                if added == 1:
                    feature += float(into[row + k, lane()])
                put(into, row + k, wp.float16(feature))

    return wp.func(encode, name=f"grid_encoding_{levels}")


@cache
def frequency_encoding(octaves: int, length: int) -> Any:
    """A device function: point in [0, 1]³ → x, then sin and cos of 2^k π x, as `field.encoding` has them, padded with
    zeros to `length`, in the first rows of a tile."""
    used = 3 + 6 * octaves

    def encode(p: wp.vec3, into: Any):
        for a in range(3):
            x = p[a] * 2.0 - 1.0
            sine = sine_of_pi(x)
            cosine = cosine_of_pi(x)
            put(into, a, wp.float16(x))
            for k in range(octaves):
                put(into, 3 + 6 * k + a, wp.float16(sine))
                put(into, 6 + 6 * k + a, wp.float16(cosine))
                twice = 2.0 * sine * cosine
                cosine = 1.0 - 2.0 * sine * sine
                sine = twice
        for k in range(used, length):
            put(into, k, wp.float16(0.0))

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
