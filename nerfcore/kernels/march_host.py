"""The march of `march.py` for the CPU: sixteen rays at a time, with vector types of the compiler.

Each bin of a ray waits for the one before, so that one ray alone leaves most of a core idle. Same results up to
rounding.
"""

from __future__ import annotations

import warp as wp

from .pdf_sampling import MarchedRays
from .traversal import GridArrays, MarchParams

LANES = 16
RAYS = 512  # whose samples one launch index draws, sixteen at a time


@wp.struct
class CoarseArrays:
    """Where the results of the coarse march are written, see `march.coarse_march`."""

    total_weight: wp.array(dtype=float)
    t_first: wp.array(dtype=float)
    t_last: wp.array(dtype=float)
    bin_counts: wp.array(dtype=int)


@wp.struct
class SampleArrays:
    """Where samples are written, see `march.Samples`; starts (R,): where those of a ray begin."""

    starts: wp.array(dtype=int)
    points: wp.array(dtype=wp.vec3)
    t: wp.array(dtype=float)
    deltas: wp.array(dtype=float)
    ray_indices: wp.array(dtype=int)


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
    const int n = m.n, blocks = m.n / 4;
    const float side = m.contracted ? 4.0f : 2.0f, border = m.contracted ? 0.25f : 0.0f, bins = side / m.step;
    auto index_of = [](F x, F y, F z, int n) -> I {
        auto cell = [n](F u) -> I {
            const I i = __builtin_convertvector(u * (float)n, I);
            return __builtin_elementwise_min(__builtin_elementwise_max(i, I{}), I{} + (n - 1));
        };
        return (cell(z) * n + cell(y)) * n + cell(x);
    };
    // Grid coordinates of rays at t, and the length of a bin there.
    auto place = [&](const F* o, const F* d, F t, F* u) -> F {
        F far{}, length = F{} + m.step;
        for (int a = 0; a < 3; ++a) {
            u[a] = o[a] + d[a] * t;
            far = most(far, absolute(u[a]));
        }
        if (m.contracted == 0) {
            for (int a = 0; a < 3; ++a) u[a] = u[a] * 0.5f + 0.5f;
            return length;
        }
        const I outside = far > 1.0f;
        const F r = outside ? far : F{} + 1.0f;
        const F scale = outside ? (2.0f - 1.0f / r) / r : F{} + 1.0f;
        for (int a = 0; a < 3; ++a) u[a] = u[a] * scale * 0.25f + 0.5f;
        return outside ? m.step * r * __builtin_elementwise_sqrt(r) : length;
    };
    auto read_cells = [&](const F* u, I asked, I& skip, F& density, F& importance) {
        const I block = index_of(u[0], u[1], u[2], blocks), cell = index_of(u[0], u[1], u[2], n);
        skip = I{};
        density = importance = F{};
        for (int lane = 0; lane < LANES; ++lane) {
            if (!asked[lane]) continue;
            skip[lane] = ((const unsigned char*)grid.skip_distance.data)[block[lane]];
            if (skip[lane]) continue;  // the grid's cells are in no cache, their blocks are
            const float* read = (const float*)grid.cells.data + 2 * (size_t)cell[lane];
            density[lane] = read[0];
            importance[lane] = read[1];
        }
    };
    auto weight_of = [&](F density, F importance, F transmittance, F through) -> F {
        if (m.mode == DEFAULT) return transmittance * (1.0f - through) * (1.0f + m.beta * importance) + m.epsilon;
        if (m.mode == UNIFORM) return F{} + 1.0f;
        return density * importance + 1.0e-6f;
    };
    // How far to move from an empty cell.
    auto skipped_length = [&](const F* u, const F* d, const F* inverse, I skip, F length) -> F {
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
        const F skipped = most(F{} + 1.0f, below(leave * bins + 0.5f)) * m.step;
        return m.contracted ? (middle ? skipped : length) : skipped;
    };
    auto inverse_of = [&](F d) -> F { return 1.0f / (absolute(d) < 1.0e-9f ? F{} + 1.0e-9f : d); };
"""


@wp.func_native(
    _LANES
    + """
    const int first = group * LANES, left = count - first;
    F o[3] = {}, d[3], inverse[3], shift{}, limit{};
    for (int a = 0; a < 3; ++a) d[a] = F{} + 1.0f;
    for (int lane = 0; lane < LANES && lane < left; ++lane) {
        for (int a = 0; a < 3; ++a) {
            o[a][lane] = ((const float*)origins.data)[3 * (size_t)(first + lane) + a];
            d[a][lane] = ((const float*)directions.data)[3 * (size_t)(first + lane) + a];
        }
        shift[lane] = ((const float*)jitter.data)[first + lane];
        limit[lane] = ((const float*)ends.data)[first + lane];
    }
    F lo = F{} + m.near, hi = least(limit, F{} + m.far), entry = F{} - 1.0e9f;
    for (int a = 0; a < 3; ++a) {
        inverse[a] = inverse_of(d[a]);
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
    for (int bin = 0; bin < 4096 && __builtin_reduce_or(alive); ++bin) {
        F u[3], density, importance;
        I skip;
        const F length = place(o, d, t, u);
        read_cells(u, alive, skip, density, importance);
        const I occupied = density > 0.0f;
        F advance = length;
        if (__builtin_reduce_or(occupied)) {
            const F through = exponential(-density * length);
            weight += occupied ? weight_of(density, importance, transmittance, through) : F{};
            front = (occupied & (front < 0.0f)) ? t : front;
            back = occupied ? t : back;
            occupied_bins -= occupied;
            if (m.mode == DEFAULT) transmittance = occupied ? transmittance * through : transmittance;
        }
        if (__builtin_reduce_or(alive & ~occupied))
            advance = occupied ? advance : skipped_length(u, d, inverse, skip, length);
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
    ends: wp.array(dtype=float),
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
    ends: wp.array(dtype=float),
    jitter: wp.array(dtype=float),
    grid: GridArrays,
    m: MarchParams,
    out: CoarseArrays,
    count: int,
    offset: int,
):
    _march(origins, directions, ends, jitter, grid, m, out, count, wp.tid() + offset)


# The steps of `pdf_sampling.advanced`, of all lanes at once: each reads a bin, or ends the interval of a sample, or goes on
# to the next bin. A lane whose ray has all its samples takes the next ray that gets some.
@wp.func_native(
    _LANES
    + """
    const int* counts = (const int*)rays.counts.data;
    const int* starts = (const int*)out.starts.data;
    const float* limits = (const float*)ends.data;
    const float* moved = (const float*)shift.data;
    const int total = (int)rays.counts.shape[0];
    const int end = (group + 1) * 512 < total ? (group + 1) * 512 : total;
    const F not_found = F{} - 1.0e30f;
    F o[3] = {}, d[3], inverse[3], high{}, share{}, t{}, t_last{}, transmittance{}, behind{}, width{}, weight{}, through{}, used{};
    F gathered{}, target{}, edge{}, found = not_found;
    I alive{};
    int ray[LANES], sample[LANES], next_ray = group * 512;
    for (int a = 0; a < 3; ++a) d[a] = inverse[a] = F{} + 1.0f;
    auto aim = [&](int lane) {
        target[lane] = ((float)sample[lane] + moved[starts[ray[lane]] + sample[lane]]) * share[lane];
        edge[lane] = (float)(sample[lane] + 1) * share[lane];
        found[lane] = -1.0e30f;
    };
    auto take_ray = [&](int lane) {
        while (next_ray < end && counts[next_ray] == 0) ++next_ray;
        alive[lane] = next_ray < end ? -1 : 0;
        if (next_ray >= end) return;
        const int r = next_ray++;
        float hi = m.far < limits[r] ? m.far : limits[r];
        for (int a = 0; a < 3; ++a) {
            const float from = ((const float*)rays.origins.data)[3 * (size_t)r + a];
            const float along = ((const float*)rays.directions.data)[3 * (size_t)r + a];
            const float one_over = 1.0f / ((along < 0.0f ? -along : along) < 1.0e-9f ? 1.0e-9f : along);
            o[a][lane] = from;
            d[a][lane] = along;
            inverse[a][lane] = one_over;
            if (m.contracted == 0) {
                const float t0 = (-1.0f - from) * one_over, t1 = (1.0f - from) * one_over;
                hi = hi < (t0 > t1 ? t0 : t1) ? hi : (t0 > t1 ? t0 : t1);
            }
        }
        high[lane] = hi;
        share[lane] = ((const float*)rays.total_weight.data)[r] / (float)counts[r];
        t[lane] = t_last[lane] = ((const float*)rays.t_first.data)[r];
        transmittance[lane] = 1.0f;
        behind[lane] = width[lane] = used[lane] = gathered[lane] = 0.0f;
        ray[lane] = r;
        sample[lane] = 0;
        aim(lane);
    };
    for (int lane = 0; lane < LANES; ++lane) take_ray(lane);
    while (__builtin_reduce_or(alive)) {
        const I wanted = alive & (width == 0.0f) & (t < high);
        if (__builtin_reduce_or(wanted)) {
            F u[3], density, importance;
            I skip;
            const F length = place(o, d, t, u);
            read_cells(u, wanted, skip, density, importance);
            const I occupied = density > 0.0f, empty = wanted & ~occupied;
            const F transmitted = exponential(-density * length);
            width = occupied ? length : width;
            through = occupied ? transmitted : through;
            weight = occupied ? weight_of(density, importance, transmittance, transmitted) : weight;
            t_last = occupied ? t : t_last;
            if (__builtin_reduce_or(empty)) t = empty ? t + skipped_length(u, d, inverse, skip, length) : t;
        }
        const I present = alive & (width > 0.0f);
        const F above = behind + weight;
        const F safe = present ? weight : F{} + 1.0f;
        found = (present & (found == not_found) & (target <= above)) ? t + ((target - behind) / safe - 0.5f) * width : found;
        const I complete = present & (edge <= above), passed = present & ~complete;
        const F fraction = (edge - behind) / safe;
        F length = complete ? gathered + (fraction - used) * width : gathered;
        gathered = complete ? F{} : (passed ? gathered + (1.0f - used) * width : gathered);
        used = complete ? fraction : (passed ? F{} : used);
        behind = passed ? above : behind;
        t = passed ? t + width : t;
        width = passed ? F{} : width;
        if (m.mode == DEFAULT) {
            transmittance = passed ? transmittance * through : transmittance;
            t = (passed & (transmittance < 1.0e-4f)) ? high : t;
        }
        // Rounding left an interval just short of the total: nothing is behind it.
        const I ended = alive & ~complete & (width == 0.0f) & (t >= high);
        const I ready = complete | ended;
        if (!__builtin_reduce_or(ready)) continue;
        length = ended ? gathered : length;
        gathered = ended ? F{} : gathered;
        found = (ended & (found == not_found)) ? t_last : found;
        F u[3];
        place(o, d, found, u);
        for (int a = 0; a < 3; ++a) u[a] = least(most(u[a], F{}), F{} + 1.0f);
        for (int lane = 0; lane < LANES; ++lane) {
            if (!ready[lane]) continue;
            const int i = starts[ray[lane]] + sample[lane];
            for (int a = 0; a < 3; ++a) ((float*)out.points.data)[3 * (size_t)i + a] = u[a][lane];
            ((float*)out.t.data)[i] = found[lane];
            ((float*)out.deltas.data)[i] = length[lane];
            ((int*)out.ray_indices.data)[i] = ray[lane];
            if (++sample[lane] < counts[ray[lane]]) aim(lane);
            else take_ray(lane);
        }
    }
"""
)
def _sample(
    rays: MarchedRays,
    ends: wp.array(dtype=float),
    shift: wp.array(dtype=float),
    grid: GridArrays,
    m: MarchParams,
    out: SampleArrays,
    group: int,
): ...


@wp.kernel(module="fieldwork_march_host")
def march_sample(
    rays: MarchedRays,
    ends: wp.array(dtype=float),
    shift: wp.array(dtype=float),
    grid: GridArrays,
    m: MarchParams,
    out: SampleArrays,
    offset: int,
):
    _sample(rays, ends, shift, grid, m, out, wp.tid() + offset)
