"""The kernels of `voxel_march.py` and `voxel_fit.py` for the CPU: eight rays at a time, with vector types of the compiler.

Each step of a ray waits for the one before, so that one ray alone leaves most of a core idle: here a step of all lanes is
taken together, over empty blocks or on to the cell of a sample, and samples then one lane after the other, the eight
corners of a cell, or the eight bytes of a vertex, in one register. A lane whose ray has ended takes the next ray. Same
arguments, same results up to rounding. Arrays are contiguous.
"""

from __future__ import annotations

import warp as wp

from .traversal import BEFORE_CUBE, EARLY_STOP, MAX_BINS, MarchParams
from .voxel_arrays import VoxelArrays
from .voxel_field import CELLS, COARSE, SLOT_BITS, VERTICES, VIEWS
from .voxel_march_torch import LEAST_WEIGHT

RAYS = 256  # of a launch index, eight at a time

_BEGIN = f"""
    constexpr int LANES = 8, RAYS = {RAYS}, MAX_BINS = {int(MAX_BINS)}, CELLS = {CELLS}, SIDE = {VERTICES};
    constexpr int VIEWS = {VIEWS}, COARSE = {COARSE}, SLOT_BITS = {SLOT_BITS};
    const float BEFORE_CUBE = {float(BEFORE_CUBE)}f, EARLY_STOP = {float(EARLY_STOP)}f, LEAST_WEIGHT = {LEAST_WEIGHT}f;
    const int OFFSETS[8] = {{
        0, 1, SIDE, SIDE + 1, SIDE * SIDE, SIDE * SIDE + 1, SIDE * SIDE + SIDE, SIDE * SIDE + SIDE + 1}};
"""

# The rays of a group, and how a lane takes the next of them. Comparisons give −1 or 0 in each lane.
_RAYS = """
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
_MARCH_LANES = """
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

# Of the cell of a sample of a field that has texels: the means of its bytes; nothing where it is empty.
_TEXELS = """
        const unsigned char* texels = (const unsigned char*)field.vertices.data + 8 * first;
        Eight mean{};
        for (int c = 0; c < 8; ++c)
            mean += __builtin_convertvector(*(const Bytes*)(texels + 8 * OFFSETS[c]), Eight) * shares[c];
        if (mean[3] == 0.0f) return 0.0f;
        const float root = mean[3] * (1.0f / 255.0f);
        const Quad plain = __builtin_shufflevector(mean, mean, 0, 1, 2, 3) * (1.0f / 255.0f);
"""

# How the colour changes along the ray of a lane at the place `local` of the block `slot`.
_CHANGE = """
    auto color_change = [&](int lane, Quad local, size_t slot) -> Quad {
        const Quad place = local * ((float)(COARSE - 1) / CELLS);
        const Ints low = __builtin_elementwise_min(__builtin_convertvector(place, Ints), Ints{0, 0, 0, 0} + (COARSE - 2));
        const Quad f = place - __builtin_convertvector(low, Quad);
        Quad slope = zero;
        for (int c = 0; c < 8; ++c) {
            const int x = c & 1, y = c >> 1 & 1, z = c >> 2;
            const float share = (x ? f[0] : 1.0f - f[0]) * (y ? f[1] : 1.0f - f[1]) * (z ? f[2] : 1.0f - f[2]);
            const size_t row = ((slot * COARSE + low[2] + z) * COARSE + low[1] + y) * COARSE + low[0] + x;
            const Texel* texel = (const Texel*)field.changes.data + 3 * row;
            for (int a = 0; a < 3; ++a) slope += __builtin_convertvector(texel[a], Quad) * (share * d[a][lane]);
        }
        return (slope - 127.5f * (d[0][lane] + d[1][lane] + d[2][lane])) * (field.harmonic_range / 127.5f);
    };
"""

_MARCH = (
    _CHANGE
    + """
    const float* opacity = (const float*)field.class_opacity.data;
    float depth[LANES], brightest[LANES];
    Quad color[LANES], place_of[LANES];
    size_t block_of[LANES];
    auto start = [&](int lane) {
        stop[lane] = wp::min(stop[lane], ((const float*)ends.data)[ray[lane]]);
        depth[lane] = brightest[lane] = 0.0f;
        color[lane] = zero;
    };
    auto sample = [&](int lane, Quad at, size_t slot, size_t first, Eight shares) -> float {
        @texels
        float alpha = wp::min(root * root, 1.0f);
        if (field.exponent != 1.0f) alpha = 1.0f - wp::pow(1.0f - alpha, field.exponent);
        const float left = transmittance[lane];
        if (field.classes > 0) {
            // The corners' roots, and the classes that they name.
            float* probability = (float*)probabilities.data + (size_t)ray[lane] * field.classes;
            Words colors, named;
            for (int c = 0; c < 8; ++c) {
                colors[c] = *(const unsigned int*)(texels + 8 * OFFSETS[c]);
                named[c] = *(const unsigned int*)(texels + 8 * OFFSETS[c] + 4);
            }
            const Words roots = colors >> 24, ids = named & 0xff00ffu;
            const Eight parts = shares * __builtin_convertvector(roots, Eight);
            const Eight share = __builtin_convertvector((named >> 8) & 255u, Eight) * (1.0f / 255.0f);
            const Words present = (Words)(roots != 0u);
            const unsigned int any = __builtin_reduce_or(present & ids), all = __builtin_reduce_and(~present | ids);
            const float whole = alpha / (255.0f * root);
            if (any == all) {
                const Eight sure = parts * share;
                const Quad halves = __builtin_shufflevector(sure, sure, 0, 1, 2, 3) + __builtin_shufflevector(sure, sure, 4, 5, 6, 7);
                const float first_share = (halves[0] + halves[1] + halves[2] + halves[3]) * whole;
                const float top = first_share * opacity[any & 255], second = (alpha - first_share) * opacity[any >> 16];
                probability[any & 255] += left * top;
                probability[any >> 16] += left * second;
                alpha = top + second;
            } else {
                const Eight firsts = parts * share * whole, seconds = parts * (1.0f - share) * whole;
                alpha = 0.0f;
                for (int c = 0; c < 8; ++c) {
                    const float top = firsts[c] * opacity[ids[c] & 255], second = seconds[c] * opacity[ids[c] >> 16];
                    if (roots[c] == 0) continue;
                    probability[ids[c] & 255] += left * top;
                    probability[ids[c] >> 16] += left * second;
                    alpha += top + second;
                }
            }
        }
        const float weight = left * alpha;
        color[lane] += plain * weight;
        depth[lane] += weight * t[lane];
        if (weight > brightest[lane]) {
            brightest[lane] = weight;
            place_of[lane] = at;
            block_of[lane] = slot;
        }
        return alpha;
    };
    auto finish = [&](int lane) -> bool {
        const float covered = 1.0f - transmittance[lane];
        Quad seen = color[lane];
        if (brightest[lane] > 0.0f)
            seen = clamped(seen + color_change(lane, place_of[lane], block_of[lane]) * covered, covered);
        float* result = (float*)out.data + 5 * (size_t)ray[lane];
        result[0] = seen[0];
        result[1] = seen[1];
        result[2] = seen[2];
        result[3] = covered;
        result[4] = depth[lane];
        return false;
    };
"""
)

_ADD_ERRORS = (
    _CHANGE
    + """
    int turn[LANES];
    float brightest[LANES];
    Quad color[LANES], total_of[LANES], error[LANES], change[LANES];
    auto start = [&](int lane) {
        turn[lane] = 0;
        brightest[lane] = 0.0f;
        color[lane] = change[lane] = zero;
    };
    auto sample = [&](int lane, Quad at, size_t slot, size_t first, Eight shares) -> float {
        @texels
        const float alpha = wp::min(root * root, 1.0f), left = transmittance[lane], weight = left * alpha;
        color[lane] += plain * weight;
        if (turn[lane] == 0 && weight > brightest[lane]) {
            brightest[lane] = weight;
            change[lane] = color_change(lane, at, slot);
        }
        if (turn[lane] == 1 && left * root > LEAST_WEIGHT) {
            // What lies behind the sample, were it alone to be seen.
            const float after = left * (1.0f - alpha);
            const Quad rest =
                clamped((total_of[lane] - color[lane] - change[lane] * (1.0f - after)) / wp::max(after, 1.0e-4f), 1.0f);
            const Quad effect = (clamped(plain + change[lane], 1.0f) - rest) * (left * 2.0f * root);
            const Quad told = error[lane] * effect, squares = effect * effect;
            const float slope = told[0] + told[1] + told[2], square = squares[0] + squares[1] + squares[2];
            const Quad colors = {weight * error[lane][0], weight * error[lane][1], weight * error[lane][2], weight};
            for (int c = 0; c < 8; ++c) {
                float* sum = (float*)sums.data + 6 * (first + OFFSETS[c]);
                for (int k = 0; k < 4; ++k) sum[k] += colors[k] * shares[c];
                sum[4] += slope * shares[c];
                sum[5] += square * shares[c];
            }
        }
        return alpha;
    };
    auto finish = [&](int lane) -> bool {
        if (turn[lane] == 1) return false;
        const float* asked = (const float*)wanted.data + 3 * (size_t)ray[lane];
        const float* far_color = (const float*)behind.data + 3 * (size_t)ray[lane];
        const float left = transmittance[lane], covered = 1.0f - left;
        total_of[lane] = clamped(color[lane] + change[lane] * covered, covered) +
            Quad{far_color[0], far_color[1], far_color[2], 0.0f} * left;
        error[lane] = Quad{asked[0], asked[1], asked[2], 0.0f} - total_of[lane];
        const Quad squares = error[lane] * error[lane];
        ((float*)errors.data)[ray[lane]] = (squares[0] + squares[1] + squares[2]) / 3.0f;
        color[lane] = zero;
        turn[lane] = 1;
        return true;
    };
"""
)

_NOTE_VIEWS = """
    auto start = [](int) {};
    auto note = [&](int lane, size_t row, float part) {
        const int camera = ((const int*)cameras.data)[ray[lane]], share = (int)(part * 32767.0f);
        int* best = (int*)views.data + row * VIEWS + camera % VIEWS;
        if (share > 0) *best = wp::max(*best, share * 65536 + camera);
    };
    auto sample = [&](int lane, Quad, size_t slot, size_t first, Eight shares) -> float {
        const unsigned char* corners = (const unsigned char*)roots.data + first;
        float root = 0.0f;
        for (int c = 0; c < 8; ++c) root += shares[c] * (float)corners[OFFSETS[c]];
        root *= 1.0f / 255.0f;
        const float alpha = wp::min(root * root, 1.0f), weight = transmittance[lane] * alpha;
        if (by_vertex == 0) {
            note(lane, slot, weight);
        } else {
            for (int c = 0; c < 8; ++c) note(lane, first + OFFSETS[c], weight * shares[c]);
        }
        return alpha;
    };
    auto finish = [](int) -> bool { return false; };
"""


def _code(names: str, body: str) -> str:
    """C++ of a march: `names` for what it marches through, then `body`, in which @texels stands for the above."""
    return _BEGIN + names + _RAYS + body.replace("@texels", _TEXELS) + _MARCH_LANES


def groups(rays: int) -> int:
    """Launch indices of so many rays."""
    return -(-rays // RAYS)


_FIELD = """
    const int blocks = field.blocks;
    const int* index = (const int*)field.index.data;
"""
_INDEX = """
    const int* index = (const int*)places.data;
"""


@wp.func_native(_code(_FIELD, _MARCH))
def _march(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    ends: wp.array(dtype=float),
    field: VoxelArrays,
    m: MarchParams,
    out: wp.array(dtype=float, ndim=2),
    probabilities: wp.array(dtype=float, ndim=2),
    group: int,
): ...


@wp.func_native(_code(_FIELD, _ADD_ERRORS))
def _add_errors(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    wanted: wp.array(dtype=wp.vec3),
    behind: wp.array(dtype=wp.vec3),
    field: VoxelArrays,
    m: MarchParams,
    sums: wp.array(dtype=float, ndim=2),
    errors: wp.array(dtype=float),
    group: int,
): ...


@wp.func_native(_code(_INDEX, _NOTE_VIEWS))
def _note_views(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    cameras: wp.array(dtype=int),
    places: wp.array(dtype=int),
    roots: wp.array(dtype=wp.uint8),
    blocks: int,
    m: MarchParams,
    by_vertex: int,
    views: wp.array(dtype=int, ndim=2),
    group: int,
): ...


@wp.kernel(module="fieldwork_voxel_host")
def march_voxels(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    ends: wp.array(dtype=float),
    field: VoxelArrays,
    m: MarchParams,
    out: wp.array(dtype=float, ndim=2),
    probabilities: wp.array(dtype=float, ndim=2),
    offset: int,
):
    _march(origins, directions, ends, field, m, out, probabilities, wp.tid() + offset)


@wp.kernel(module="fieldwork_voxel_host")
def add_errors(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    wanted: wp.array(dtype=wp.vec3),
    behind: wp.array(dtype=wp.vec3),
    field: VoxelArrays,
    m: MarchParams,
    sums: wp.array(dtype=float, ndim=2),
    errors: wp.array(dtype=float),
    offset: int,
):
    _add_errors(origins, directions, wanted, behind, field, m, sums, errors, wp.tid() + offset)


@wp.kernel(module="fieldwork_voxel_host")
def note_views(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    cameras: wp.array(dtype=int),
    index: wp.array(dtype=int),
    roots: wp.array(dtype=wp.uint8),
    blocks: int,
    m: MarchParams,
    by_vertex: int,
    views: wp.array(dtype=int, ndim=2),
    offset: int,
):
    _note_views(origins, directions, cameras, index, roots, blocks, m, by_vertex, views, wp.tid() + offset)
