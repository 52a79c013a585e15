"""What the networks read of a point besides the grid's features, for CPUs: frequencies of its position, and the blend weight.

torch makes each octave of slices in several passes; here a point's numbers are made at once, with vector types of the
compiler. Same results as `field/encoding.py:frequency_encoding` and `field/blend.py:BlendWeight` up to rounding.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp

from .runtime import array, init, launch

AXES = """
    typedef float Axes __attribute__((vector_size(16), aligned(4)));
    typedef unsigned Bits __attribute__((vector_size(16), aligned(4)));
    typedef unsigned short Halves __attribute__((vector_size(8), aligned(2)));
"""

# sin πt of |t| ≤ ½ by Taylor's series, whose rest is below 6e-8 there; from it sin πc and cos πc of |c| ≤ 1, and higher
# octaves by the double-angle formulas. Numbers are written four at a time, of which what comes next overwrites the
# fourth; a row's last three are written alone.
FREQUENCIES = """
    auto sine_of = [](Axes t) -> Axes {
        const Axes q = t * t;
        return t * (3.14159265f + q * (-5.16771278f + q * (2.55016404f + q * (-0.599264529f
            + q * (0.0821458866f + q * -0.00737043094f)))));
    };
    auto write_frequencies = [&](const float* point, int octaves, auto put) {
        const Axes c = {point[0] * 2.0f - 1.0f, point[1] * 2.0f - 1.0f, point[2] * 2.0f - 1.0f, 0.0f};
        const Axes away = __builtin_elementwise_abs(c);
        Axes sine = sine_of(__builtin_elementwise_copysign(__builtin_elementwise_min(away, 1.0f - away), c));
        Axes cosine = sine_of(0.5f - away);
        put(0, c);
        for (int k = 0; k < octaves; ++k) {
            put(3 + 6 * k, sine);
            put(6 + 6 * k, cosine);
            const Axes twice = 2.0f * sine * cosine;
            cosine = 1.0f - 2.0f * sine * sine;
            sine = twice;
        }
    };
"""

_ROW = """
    const int width = 3 + 6 * octaves;
    {type}* row = ({type}*)out.data + (size_t)i * width;
    write_frequencies((const float*)points.data + 3 * (size_t)i, octaves, [&](int column, Axes value) {{
        {convert}
        if (column + 4 <= width) __builtin_memcpy(row + column, &kept, sizeof(kept));
        else __builtin_memcpy(row + column, &kept, 3 * sizeof({type}));
    }});
"""

# The upper half of a float, rounded to even.
_BFLOAT16 = """
        Bits bits;
        __builtin_memcpy(&bits, &value, sizeof(bits));
        const Halves kept = __builtin_convertvector((bits + 0x7fffu + ((bits >> 16) & 1u)) >> 16, Halves);
"""


TRILINEAR = """
    auto trilinear = [](const float* grid, int n, const float* point) -> float {
        int cell[3];
        float low[3], high[3];
        for (int a = 0; a < 3; ++a) {
            const float p = point[a] * (float)n - 0.5f;
            const int first = (int)p;  // rounded towards 0: below 0 only where the clamp follows
            cell[a] = first < 0 ? 0 : (first > n - 2 ? n - 2 : first);
            const float f = p - (float)cell[a];
            high[a] = f < 0.0f ? 0.0f : (f > 1.0f ? 1.0f : f);
            low[a] = 1.0f - high[a];
        }
        const size_t plane = (size_t)n * n;
        const float* a = grid + (size_t)cell[2] * plane + (size_t)cell[1] * n + cell[0];
        const float* b = a + plane;
        const float near = (a[0] * low[0] + a[1] * high[0]) * low[1] + (a[n] * low[0] + a[n + 1] * high[0]) * high[1];
        const float far = (b[0] * low[0] + b[1] * high[0]) * low[1] + (b[n] * low[0] + b[n + 1] * high[0]) * high[1];
        return near * low[2] + far * high[2];
    };
"""


@wp.func_native(AXES + FREQUENCIES + _ROW.format(type="float", convert="const Axes kept = value;"))
def _frequencies(points: wp.array(dtype=wp.vec3), out: wp.array(dtype=float, ndim=2), i: int, octaves: int): ...


@wp.func_native(AXES + FREQUENCIES + _ROW.format(type="unsigned short", convert=_BFLOAT16))
def _frequencies_half(points: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.int16, ndim=2), i: int, octaves: int): ...


@wp.kernel(module="fieldwork_inputs_host")
def frequencies(points: wp.array(dtype=wp.vec3), out: wp.array(dtype=float, ndim=2), octaves: int, offset: int):
    _frequencies(points, out, wp.tid() + offset, octaves)


@wp.kernel(module="fieldwork_inputs_host")
def frequencies_half(points: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.int16, ndim=2), octaves: int, offset: int):
    _frequencies_half(points, out, wp.tid() + offset, octaves)


@wp.func_native(
    TRILINEAR + "return trilinear((const float*)evidence.data, n, (const float*)points.data + 3 * (size_t)i);"
)
def _trilinear(evidence: wp.array(dtype=float), n: int, points: wp.array(dtype=wp.vec3), i: int) -> float: ...


@wp.kernel(module="fieldwork_inputs_host")
def weights(
    evidence: wp.array(dtype=float),
    n: int,
    points: wp.array(dtype=wp.vec3),
    floor: float,
    rate: float,
    out: wp.array(dtype=float),
    offset: int,
):
    i = wp.tid() + offset
    out[i] = 1.0 - (1.0 - floor) * wp.exp(-rate * _trilinear(evidence, n, points, i))


def encode_frequencies(points: torch.Tensor, octaves: int, dtype: torch.dtype) -> torch.Tensor:
    """Frequencies (N, 3 + 6 · octaves), float32 or bfloat16, of positions (N, 3) in [0, 1]³ on the CPU."""
    init()
    out = torch.empty(len(points), 3 + 6 * octaves, dtype=dtype)
    half = dtype == torch.bfloat16
    kernel, target = (frequencies_half, out.view(torch.int16)) if half else (frequencies, out)
    launch(kernel, len(points), [array(points.contiguous(), wp.vec3), array(target), octaves], points.device)
    return out


def blend_weights(
    evidence: torch.Tensor, resolution: int, points: torch.Tensor, floor: float, rate: float
) -> torch.Tensor:
    """w (N,) of positions (N, 3) in [0, 1]³ from evidence (resolution³,), x fastest, on the CPU, see `field/blend.py`."""
    init()
    out = torch.empty(len(points))
    where = array(points.contiguous(), wp.vec3)
    inputs: list[Any] = [array(evidence), resolution, where, floor, rate, array(out)]
    launch(weights, len(points), inputs, points.device)
    return out
