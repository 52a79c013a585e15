"""The coarse march of `march.py` for the CPU: sixteen rays at a time, with vector types of the compiler.

Each bin of a ray waits for the one before, so that one ray alone leaves most of a core idle. Same results up to
rounding.
"""

from __future__ import annotations

import warp as wp

from .traversal import GridArrays, MarchParams

LANES = 16


@wp.struct
class CoarseArrays:
    """Where the results of the coarse march are written, see `march.coarse_march`."""

    total_weight: wp.array(dtype=float)
    t_first: wp.array(dtype=float)
    t_last: wp.array(dtype=float)
    bin_counts: wp.array(dtype=int)


# Comparisons give −1 or 0 in each lane; e^x of x ≤ 0 by 2^whole · 2^rest, the latter by its series, right to 2e-7.
_LANES = """
    enum { LANES = 16, DEFAULT = 0, UNIFORM = 1 };
    typedef float F __attribute__((vector_size(64), aligned(4)));
    typedef int I __attribute__((vector_size(64), aligned(4)));
    auto least = [](F a, F b) -> F { return __builtin_elementwise_min(a, b); };
    auto most = [](F a, F b) -> F { return __builtin_elementwise_max(a, b); };
    auto absolute = [](F a) -> F { return __builtin_elementwise_abs(a); };
    auto below = [](F a) -> F { return __builtin_elementwise_floor(a); };
    auto exponential = [&](F x) -> F {
        const F y = most(x * 1.44269504f, F{} - 126.0f);
        const F whole = below(y);
        const F f = (y - whole) * 0.693147181f;
        const F series = 1.0f + f * (1.0f + f * (0.5f + f * (0.166666667f + f * (0.0416666667f
            + f * (0.00833333333f + f * (0.00138888889f + f * 0.000198412698f))))));
        const I bits = (__builtin_convertvector(whole, I) + 127) << 23;
        F power;
        __builtin_memcpy(&power, &bits, sizeof(power));
        return series * power;
    };
    auto index_of = [](F x, F y, F z, int n) -> I {
        auto cell = [n](F u) -> I {
            const I i = __builtin_convertvector(u * (float)n, I);
            return __builtin_elementwise_min(__builtin_elementwise_max(i, I{}), I{} + (n - 1));
        };
        return (cell(z) * n + cell(y)) * n + cell(x);
    };
"""


@wp.func_native(
    _LANES
    + """
    const int first = group * LANES, n = m.n, blocks = m.n / 4, left = count - first;
    F o[3] = {}, d[3], inverse[3], shift{};
    for (int a = 0; a < 3; ++a) d[a] = F{} + 1.0f;
    for (int lane = 0; lane < LANES && lane < left; ++lane) {
        for (int a = 0; a < 3; ++a) {
            o[a][lane] = ((const float*)origins.data)[3 * (size_t)(first + lane) + a];
            d[a][lane] = ((const float*)directions.data)[3 * (size_t)(first + lane) + a];
        }
        shift[lane] = ((const float*)jitter.data)[first + lane];
    }
    F lo = F{} + m.near, hi = F{} + m.far, entry = F{} - 1.0e9f;
    for (int a = 0; a < 3; ++a) {
        inverse[a] = 1.0f / (absolute(d[a]) < 1.0e-9f ? F{} + 1.0e-9f : d[a]);
        const F t0 = (-1.0f - o[a]) * inverse[a], t1 = (1.0f - o[a]) * inverse[a];
        entry = most(entry, least(t0, t1));
        if (m.contracted == 0) {
            lo = most(lo, least(t0, t1));
            hi = least(hi, most(t0, t1));
        }
    }
    if (m.contracted == 1 && m.empty_distance > 0.0f) lo = most(lo, least(F{} + m.empty_distance, 0.8f * entry));
    F t = lo + shift * m.step, transmittance = F{} + 1.0f, weight{}, front = F{} - 1.0f, back = F{} - 1.0f;
    I occupied_bins{}, alive = t < hi;
    for (int lane = left < 0 ? 0 : left; lane < LANES; ++lane) alive[lane] = 0;
    const float side = m.contracted ? 4.0f : 2.0f, border = m.contracted ? 0.25f : 0.0f, bins = side / m.step;
    for (int bin = 0; bin < 4096 && __builtin_reduce_or(alive); ++bin) {
        F u[3], far{}, length = F{} + m.step;
        for (int a = 0; a < 3; ++a) {
            u[a] = o[a] + d[a] * t;
            far = most(far, absolute(u[a]));
        }
        if (m.contracted == 0) {
            for (int a = 0; a < 3; ++a) u[a] = u[a] * 0.5f + 0.5f;
        } else {
            const I outside = far > 1.0f;
            const F r = outside ? far : F{} + 1.0f;
            length = outside ? m.step * r * __builtin_elementwise_sqrt(r) : length;
            const F scale = outside ? (2.0f - 1.0f / r) / r : F{} + 1.0f;
            for (int a = 0; a < 3; ++a) u[a] = u[a] * scale * 0.25f + 0.5f;
        }
        const I block = index_of(u[0], u[1], u[2], blocks), cell = index_of(u[0], u[1], u[2], n);
        I skip{};
        F density{}, importance{};
        for (int lane = 0; lane < LANES; ++lane) {
            if (!alive[lane]) continue;
            skip[lane] = ((const unsigned char*)grid.skip_distance.data)[block[lane]];
            if (skip[lane]) continue;  // the grid's cells are in no cache, their blocks are
            const float* read = (const float*)grid.cells.data + 2 * (size_t)cell[lane];
            density[lane] = read[0];
            importance[lane] = read[1];
        }
        const I occupied = density > 0.0f;
        F advance = length;
        if (__builtin_reduce_or(occupied)) {
            const F through = exponential(-density * length);
            F gained;
            if (m.mode == DEFAULT) gained = transmittance * (1.0f - through) * (1.0f + m.beta * importance) + m.epsilon;
            else if (m.mode == UNIFORM) gained = F{} + 1.0f;
            else gained = density * importance + 1.0e-6f;
            weight += occupied ? gained : F{};
            front = (occupied & (front < 0.0f)) ? t : front;
            back = occupied ? t : back;
            occupied_bins -= occupied;
            if (m.mode == DEFAULT) transmittance = occupied ? transmittance * through : transmittance;
        }
        if (__builtin_reduce_or(alive & ~occupied)) {
            const I whole_blocks = skip > 0;
            const F cells = whole_blocks ? F{} + (float)blocks : F{} + (float)n;
            const F radius = whole_blocks ? __builtin_convertvector(skip - 1, F) : F{};
            F away = F{} + 1.0e9f;
            I middle = I{} - 1;
            for (int a = 0; a < 3; ++a) {
                const F place = u[a] * cells, corner = below(place);
                const F high = least(corner + 1.0f + radius, cells - border * cells), low = most(corner - radius, border * cells);
                away = least(away, ((d[a] > 0.0f ? high : low) - place) * inverse[a]);
                middle &= absolute(u[a] - 0.5f) < 0.25f;
            }
            const F leave = most(away, F{}) / cells;
            F skipped = most(F{} + 1.0f, below(leave * bins + 0.5f)) * m.step;
            if (m.contracted) skipped = middle ? skipped : length;
            advance = occupied ? advance : skipped;
        }
        t = alive ? t + advance : t;
        alive &= t < hi;
        if (m.mode == DEFAULT) alive &= transmittance >= 1.0e-4f;
    }
    for (int lane = 0; lane < LANES && lane < left; ++lane) {
        ((float*)out.total_weight.data)[first + lane] = weight[lane];
        ((float*)out.t_first.data)[first + lane] = front[lane];
        ((float*)out.t_last.data)[first + lane] = back[lane];
        ((int*)out.bin_counts.data)[first + lane] = occupied_bins[lane];
    }
"""
)
def _march(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    jitter: wp.array(dtype=float),
    grid: GridArrays,
    m: MarchParams,
    out: CoarseArrays,
    count: int,
    group: int,
): ...


@wp.kernel(module="fieldwork_march_host")
def march_weight(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    jitter: wp.array(dtype=float),
    grid: GridArrays,
    m: MarchParams,
    out: CoarseArrays,
    count: int,
    offset: int,
):
    _march(origins, directions, jitter, grid, m, out, count, wp.tid() + offset)
