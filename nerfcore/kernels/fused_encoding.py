"""Device functions of the fused renderer: encodings of one sample, into a block's shared memory (see `fused_network`)."""

from functools import cache
from typing import Any

import warp as wp

from .encode import FEATURES, across, cell_of

half_feature = wp.types.vector(length=FEATURES, dtype=wp.float16)


@wp.func_native("reinterpret_cast<wp::half*>(memory.data.ptr)[place] = value;")
def put(memory: Any, place: int, value: wp.float16):
    """Write to shared memory."""


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


@wp.func_native("""
    float four[4] = {a, b, c, d};
    wp::half* to = reinterpret_cast<wp::half*>(memory.data.ptr) + place;
    for (int k = 0; k < 4; ++k) four[k] = share * float(wp::half(four[k])) + (added ? float(to[k]) : 0.0f);
#if defined(__CUDA_ARCH__)
    uint2 packed;
    packed.x = wp::half(four[0]).u | unsigned(wp::half(four[1]).u) << 16;
    packed.y = wp::half(four[2]).u | unsigned(wp::half(four[3]).u) << 16;
    *reinterpret_cast<uint2*>(to) = packed;
#else
    for (int k = 0; k < 4; ++k) to[k] = wp::half(four[k]);
#endif
""")
def put_four(memory: Any, place: int, a: float, b: float, c: float, d: float, share: float, added: int):
    """Four numbers, times `share`, added to what is in shared memory from `place` on if `added` is 1, else written there;
    `place` is a multiple of four."""


@cache
def grid_encoding(levels: int) -> Any:
    """A device function: point in [0, 1]³ → features of all levels, trilinear, times `share`, added to what is in shared
    memory from `place` on if `added` is 1, else written there."""

    def encode(
        p: wp.vec3,
        table: wp.array(dtype=half_feature),
        layout: wp.array2d(dtype=int),
        gains: wp.array(dtype=float),
        memory: Any,
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
            put_four(memory, place + level * FEATURES, value[0], value[1], value[2], value[3], share, added)

    return wp.func(encode, name=f"grid_encoding_{levels}")


@cache
def frequency_encoding(octaves: int, length: int) -> Any:
    """A device function: point in [0, 1]³ → x, then sin and cos of 2^k π x, as `field.encoding` has them, padded with
    zeros to `length`, in shared memory from `place` on."""
    used = 3 + 6 * octaves

    def encode(p: wp.vec3, memory: Any, place: int):
        for a in range(3):
            x = p[a] * 2.0 - 1.0
            sine = sine_of_pi(x)
            cosine = cosine_of_pi(x)
            put(memory, place + a, wp.float16(x))
            for k in range(octaves):
                put(memory, place + 3 + 6 * k + a, wp.float16(sine))
                put(memory, place + 6 + 6 * k + a, wp.float16(cosine))
                twice = 2.0 * sine * cosine
                cosine = 1.0 - 2.0 * sine * sine
                sine = twice
        for k in range(used, length):
            put(memory, place + k, wp.float16(0.0))

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
