"""C++ of a march through baked fields on CPUs, eight rays at a time, with vector types of the compiler.

Each step of a ray waits for the one before, so that one ray alone leaves most of a core idle: here a step of all lanes is
taken together, over empty blocks or on to the cell of a sample, and samples then one lane after the other. A lane whose ray
has ended takes the next ray.
"""

from __future__ import annotations

from .traversal import BEFORE_CUBE, EARLY_STOP, MAX_BINS
from .voxel_field import CELLS, COARSE, SLOT_BITS, VERTICES

RAYS = 256  # of a launch index, eight at a time

BEGIN = f"""
    constexpr int LANES = 8, RAYS = {RAYS}, MAX_BINS = {int(MAX_BINS)}, CELLS = {CELLS}, SIDE = {VERTICES};
    constexpr int COARSE = {COARSE}, SLOT_BITS = {SLOT_BITS};
    const float BEFORE_CUBE = {float(BEFORE_CUBE)}f, EARLY_STOP = {float(EARLY_STOP)}f;
    const int OFFSETS[8] = {{
        0, 1, SIDE, SIDE + 1, SIDE * SIDE, SIDE * SIDE + 1, SIDE * SIDE + SIDE, SIDE * SIDE + SIDE + 1}};
"""

# The rays of a group, and how a lane takes the next of them. Comparisons give −1 or 0 in each lane.
RAY_LANES = """
    typedef float F __attribute__((vector_size(32), aligned(4)));
    typedef int I __attribute__((vector_size(32), aligned(4)));
    typedef float Quad __attribute__((vector_size(16)));
    typedef int Ints __attribute__((vector_size(16)));
    typedef float Eight __attribute__((vector_size(32)));
    typedef unsigned int Words __attribute__((vector_size(32)));
    typedef unsigned char Bytes __attribute__((vector_size(8), aligned(4)));
    typedef unsigned char Texel __attribute__((vector_size(4), aligned(4)));
    auto least = [](F a, F b) -> F { return __builtin_elementwise_min(a, b); };
    auto most = [](F a, F b) -> F { return __builtin_elementwise_max(a, b); };
    auto below = [](F a) -> F { return __builtin_elementwise_floor(a); };
    const bool contracted = m.contracted == 1;
    const float count = (float)blocks;
    const Quad zero = {0.0f, 0.0f, 0.0f, 0.0f};
    auto clamped = [&](Quad v, float top) -> Quad {
        return __builtin_elementwise_min(__builtin_elementwise_max(v, zero), zero + top);
    };
    F o[3] = {}, d[3], inverse[3], t{}, stop{}, transmittance{};
    for (int a = 0; a < 3; ++a) d[a] = inverse[a] = F{} + 1.0f;
    I alive{}, bins{};
    float begins[LANES];
    int ray[LANES], next_ray = group * RAYS;
    const int total = (int)origins.shape[0], last_ray = next_ray + RAYS < total ? next_ray + RAYS : total;
    // Let a lane march along its ray from the beginning.
    auto restart = [&](int lane) {
        t[lane] = begins[lane];
        transmittance[lane] = 1.0f;
        bins[lane] = 0;
    };
    auto take_ray = [&](int lane) {
        alive[lane] = next_ray < last_ray ? -1 : 0;
        if (next_ray >= last_ray) return;
        const int r = next_ray++;
        float entry = -1.0e30f, leave = 1.0e30f;
        for (int a = 0; a < 3; ++a) {
            const float from = ((const float*)origins.data)[3 * (size_t)r + a];
            const float along = ((const float*)directions.data)[3 * (size_t)r + a];
            const float one_over = 1.0f / (wp::abs(along) < 1.0e-9f ? 1.0e-9f : along);
            const float one = (-1.0f - from) * one_over, other = (1.0f - from) * one_over;
            entry = wp::max(entry, wp::min(one, other));
            leave = wp::min(leave, wp::max(one, other));
            o[a][lane] = from;
            d[a][lane] = along;
            inverse[a][lane] = one_over;
        }
        float begin = m.near;
        if (!contracted) begin = wp::max(begin, entry);
        else if (m.empty_distance > 0.0f) begin = wp::max(begin, wp::min(m.empty_distance, BEFORE_CUBE * entry));
        begins[lane] = begin + 0.5f * m.step;
        stop[lane] = contracted ? m.far : wp::min(m.far, leave);
        ray[lane] = r;
        restart(lane);
    };
"""

# The march of all lanes. Kernels say before it what begins with a ray (`start`), what a sample of a lane adds and how opaque it
# is (`sample`), and what becomes of a ray that has ended (`finish`, which says whether it is marched once more).
MARCH_LANES = """
    auto take_next = [&](int lane) {
        take_ray(lane);
        if (alive[lane]) start(lane);
    };
    for (int lane = 0; lane < LANES; ++lane) take_next(lane);
    while (__builtin_reduce_or(alive)) {
        const I ended = alive & ~((t < stop) & (transmittance >= EARLY_STOP) & (bins < MAX_BINS));
        if (__builtin_reduce_or(ended)) {
            for (int lane = 0; lane < LANES; ++lane) {
                if (!ended[lane]) continue;
                if (finish(lane)) restart(lane);
                else take_next(lane);
            }
            continue;
        }
        F u[3], local[3], far{}, length = F{} + m.step, scale = F{} + 0.5f;
        for (int a = 0; a < 3; ++a) {
            u[a] = o[a] + d[a] * t;
            far = most(far, __builtin_elementwise_abs(u[a]));
        }
        I outside{};
        if (contracted) {
            outside = far > 1.0f;
            const F radius = most(far, F{} + 1.0f);
            scale = 0.25f * ((2.0f - 1.0f / radius) / radius);
            length = m.step * radius * __builtin_elementwise_sqrt(radius);
        }
        I block[3], corner[3];
        for (int a = 0; a < 3; ++a) {
            u[a] = least(most(u[a] * scale + 0.5f, F{}), F{} + 1.0f);
            const F x = u[a] * count;
            block[a] = __builtin_elementwise_min(__builtin_convertvector(x, I), I{} + (blocks - 1));
            local[a] = (x - __builtin_convertvector(block[a], F)) * (float)CELLS;
        }
        const I place = (block[2] * blocks + block[1]) * blocks + block[0];
        I entry;
        for (int lane = 0; lane < LANES; ++lane) entry[lane] = index[place[lane]];
        const float half = CELLS / 2;
        const I octant = ((local[0] >= half) & 1) | ((local[1] >= half) & 2) | ((local[2] >= half) & 4);
        const I occupied = entry > 0;
        const I full = alive & occupied & (((entry >> (octant + SLOT_BITS)) & 1) != 0), empty = alive & ~full;
        bins += 1;
        if (__builtin_reduce_or(empty)) {
            // How far a ray may move where nothing is within `reach` of `sides` blocks along a side.
            const F reach = occupied ? F{} : __builtin_convertvector(-1 - entry, F);
            const F sides = occupied ? F{} + 2.0f * count : F{} + count, width = 1.0f / sides;
            const float border = contracted ? 0.25f : 0.0f;
            F away = F{} + 1.0e9f, free = F{} + 1.0e9f;
            for (int a = 0; a < 3; ++a) {
                const F whole = below(u[a] * sides);
                const F low = (whole - reach) * width, high = (whole + reach + 1.0f) * width;
                const F last = inverse[a] > 0.0f ? least(high, F{} + (1.0f - border)) : most(low, F{} + border);
                away = least(away, (last - u[a]) * inverse[a]);
                free = least(free, least(u[a] - low, high - u[a]));
            }
            F leap = most(away, F{}) * (contracted ? 4.0f : 2.0f);
            leap = outside ? most(free, F{}) * most(F{} + 3.0f, 0.5f * far) : leap;
            t = empty ? t + leap + 0.5f * length : t;
        }
        if (!__builtin_reduce_or(full)) continue;
        I vertex;
        for (int a = 0; a < 3; ++a) {
            corner[a] = __builtin_elementwise_min(__builtin_convertvector(local[a], I), I{} + (CELLS - 1));
        }
        const I slot = (entry & ((1 << SLOT_BITS) - 1)) - 1;
        vertex = (corner[2] * SIDE + corner[1]) * SIDE + corner[0];
        for (int lane = 0; lane < LANES; ++lane) {
            if (!full[lane]) continue;
            const Quad at = {local[0][lane], local[1][lane], local[2][lane], 0.0f};
            const float x = at[0] - (float)corner[0][lane], y = at[1] - (float)corner[1][lane], z = at[2] - (float)corner[2][lane];
            const Quad plane = {(1.0f - x) * (1.0f - y), x * (1.0f - y), (1.0f - x) * y, x * y};
            const Quad lower = plane * (1.0f - z), upper = plane * z;
            const Eight shares = __builtin_shufflevector(lower, upper, 0, 1, 2, 3, 4, 5, 6, 7);
            const size_t first = (size_t)slot[lane] * (SIDE * SIDE * SIDE) + vertex[lane];
            transmittance[lane] *= 1.0f - sample(lane, at, (size_t)slot[lane], first, shares);
        }
        t = full ? t + length : t;
    }
"""


def march_code(names: str, body: str) -> str:
    """C++ of a march: `names` for what it marches through, then `body`, which says what kernels do with rays and samples."""
    return BEGIN + names + RAY_LANES + body + MARCH_LANES


def groups(rays: int) -> int:
    """Launch indices of so many rays."""
    return -(-rays // RAYS)
