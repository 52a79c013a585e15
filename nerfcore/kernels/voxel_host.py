"""The kernels of `voxel_march.py` and `voxel_fit.py` for the CPU, with vector types of the compiler.

The eight bytes of a vertex are eight numbers of one register here, and the three axes of a position one of four; Warp
computes them one by one. Same arguments, same results up to rounding. Arrays are contiguous.
"""

from __future__ import annotations

import warp as wp

from .traversal import BEFORE_CUBE, EARLY_STOP, MAX_BINS, MarchParams
from .voxel_arrays import VoxelArrays
from .voxel_field import CELLS, COARSE, SLOT_BITS, VERTICES, VIEWS
from .voxel_march_torch import LEAST_WEIGHT

_BEGIN = f"""
    const int MAX_BINS = {int(MAX_BINS)}, CELLS = {CELLS}, SIDE = {VERTICES}, VIEWS = {VIEWS};
    const int COARSE = {COARSE}, SLOT_BITS = {SLOT_BITS};
    const float BEFORE_CUBE = {float(BEFORE_CUBE)}f, EARLY_STOP = {float(EARLY_STOP)}f, LEAST_WEIGHT = {LEAST_WEIGHT}f;
    const int OFFSETS[8] = {{
        0, 1, SIDE, SIDE + 1, SIDE * SIDE, SIDE * SIDE + 1, SIDE * SIDE + SIDE, SIDE * SIDE + SIDE + 1}};
"""

# Of ray `r` through `blocks` and their `index`: where its march begins and ends.
_RAY = """
    typedef float Quad __attribute__((vector_size(16)));
    typedef int Ints __attribute__((vector_size(16)));
    typedef float Eight __attribute__((vector_size(32)));
    typedef unsigned char Bytes __attribute__((vector_size(8), aligned(4)));
    typedef unsigned char Texel __attribute__((vector_size(4), aligned(4)));
    auto least = [](Quad v) { return wp::min(v[0], wp::min(v[1], v[2])); };
    auto most = [](Quad v) { return wp::max(v[0], wp::max(v[1], v[2])); };
    const float* from = (const float*)origins.data + 3 * (size_t)r;
    const float* along = (const float*)directions.data + 3 * (size_t)r;
    const Quad o = {from[0], from[1], from[2], 0.0f}, d = {along[0], along[1], along[2], 1.0f};
    Quad inverse = d;
    for (int a = 0; a < 3; ++a) inverse[a] = 1.0f / (wp::abs(d[a]) < 1.0e-9f ? 1.0e-9f : d[a]);
    const Quad one = (-1.0f - o) * inverse, other = (1.0f - o) * inverse;
    const float entry_distance = most(__builtin_elementwise_min(one, other));
    const float leave_distance = least(__builtin_elementwise_max(one, other));
    const bool contracted = m.contracted == 1;
    float begin = m.near, end = m.far;
    if (!contracted) {
        begin = wp::max(begin, entry_distance);
        end = wp::min(end, leave_distance);
    } else if (m.empty_distance > 0.0f) {
        begin = wp::max(begin, wp::min(m.empty_distance, BEFORE_CUBE * entry_distance));
    }
    begin += 0.5f * m.step;
    const float count = (float)blocks;
    const Quad zero = {0.0f, 0.0f, 0.0f, 0.0f};
    // How far the ray may move from `u`, where nothing is within `reach` of `sides` blocks along a side.
    auto leap = [&](Quad u, float radius, float reach, float sides) {
        const Quad whole = __builtin_elementwise_floor(u * sides);
        const Quad low = (whole - (reach - 1.0f)) * (1.0f / sides), high = (whole + reach) * (1.0f / sides);
        if (contracted && radius > 1.0f)
            return wp::max(least(__builtin_elementwise_min(u - low, high - u)), 0.0f) * wp::max(3.0f, 0.5f * radius);
        const float border = contracted ? 0.25f : 0.0f;
        const Quad last = inverse > 0.0f ? __builtin_elementwise_min(high, zero + (1.0f - border))
                                         : __builtin_elementwise_max(low, zero + border);
        return wp::max(least((last - u) * inverse), 0.0f) * (contracted ? 4.0f : 2.0f);
    };
    auto clamped = [&](Quad v, float top) {
        return __builtin_elementwise_min(__builtin_elementwise_max(v, zero), zero + top);
    };
"""

# In a loop over `t`: the step there, over empty blocks, or the sample's cell: its first vertex and the weights of its corners.
_STEP = """
        const Quad p = o + d * t;
        const float radius = most(__builtin_elementwise_abs(p));
        float length = m.step;
        Quad u = p * 0.5f + 0.5f;
        if (contracted) {
            float scale = 0.25f;
            if (radius > 1.0f) {
                scale = 0.25f * ((2.0f - 1.0f / radius) / radius);
                length = m.step * radius * wp::sqrt(radius);
            }
            u = p * scale + 0.5f;
        }
        u = clamped(u, 1.0f);
        const Quad x = u * count;
        Ints block = __builtin_convertvector(x, Ints);
        block = __builtin_elementwise_min(block, Ints{0, 0, 0, 0} + (blocks - 1));
        const int entry = index[((size_t)block[2] * blocks + block[1]) * blocks + block[0]];
        if (entry <= 0) {
            t += leap(u, radius, (float)-entry, count) + 0.5f * length;
            continue;
        }
        const Quad local = (x - __builtin_convertvector(block, Quad)) * (float)CELLS;
        const Ints corner = __builtin_elementwise_min(__builtin_convertvector(local, Ints), Ints{0, 0, 0, 0} + (CELLS - 1));
        const int octant = (local[0] >= CELLS / 2) | (local[1] >= CELLS / 2) << 1 | (local[2] >= CELLS / 2) << 2;
        if ((entry >> (SLOT_BITS + octant) & 1) == 0) {
            t += leap(u, radius, 1.0f, 2.0f * count) + 0.5f * length;
            continue;
        }
        const size_t slot = (entry & ((1 << SLOT_BITS) - 1)) - 1;
        const size_t first = slot * (SIDE * SIDE * SIDE) + (corner[2] * SIDE + corner[1]) * SIDE + corner[0];
        const Quad f = local - __builtin_convertvector(corner, Quad), g = 1.0f - f;
        const float shares[8] = {g[0] * g[1] * g[2], f[0] * g[1] * g[2], g[0] * f[1] * g[2], f[0] * f[1] * g[2],
                                 g[0] * g[1] * f[2], f[0] * g[1] * f[2], g[0] * f[1] * f[2], f[0] * f[1] * f[2]};
"""

# Of a cell of a field that has texels, in the same loop: the means of its bytes; nothing where it is empty.
_TEXELS = """
        const unsigned char* vertex = (const unsigned char*)field.vertices.data + 8 * first;
        int roots = 0;
        for (int c = 0; c < 8; ++c) roots |= vertex[8 * OFFSETS[c] + 3];
        if (roots == 0) {
            t += length;
            continue;
        }
        Eight mean = {0.0f};
        for (int c = 0; c < 8; ++c)
            mean += __builtin_convertvector(*(const Bytes*)(vertex + 8 * OFFSETS[c]), Eight) * shares[c];
        const float root = mean[3] * (1.0f / 255.0f);
        const Quad plain = __builtin_shufflevector(mean, mean, 0, 1, 2, 3) * (1.0f / 255.0f);
"""

# How the colour changes along `d` at the place `local` of the block `slot`.
_CHANGE = """
    auto color_change = [&](Quad local, size_t slot) {
        const Quad place = local * ((float)(COARSE - 1) / CELLS);
        const Ints low = __builtin_elementwise_min(__builtin_convertvector(place, Ints), Ints{0, 0, 0, 0} + (COARSE - 2));
        const Quad f = place - __builtin_convertvector(low, Quad);
        Quad slope = zero;
        for (int c = 0; c < 8; ++c) {
            const int x = c & 1, y = c >> 1 & 1, z = c >> 2;
            const float share = (x ? f[0] : 1.0f - f[0]) * (y ? f[1] : 1.0f - f[1]) * (z ? f[2] : 1.0f - f[2]);
            const size_t row = ((slot * COARSE + low[2] + z) * COARSE + low[1] + y) * COARSE + low[0] + x;
            const Texel* texel = (const Texel*)field.changes.data + 3 * row;
            for (int a = 0; a < 3; ++a) slope += __builtin_convertvector(texel[a], Quad) * (share * d[a]);
        }
        return (slope - 127.5f * (d[0] + d[1] + d[2])) * (field.harmonic_range / 127.5f);
    };
"""

_MARCH = (
    _CHANGE
    + """
    float* probability = (float*)probabilities.data + (size_t)r * field.classes;
    const float* opacity = (const float*)field.class_opacity.data;
    const float stop = wp::min(end, ((const float*)ends.data)[r]);
    float t = begin, transmittance = 1.0f, depth = 0.0f, brightest = 0.0f;
    Quad color = zero, place = zero;
    size_t block_of_place = 0;
    for (int bin = 0; bin < MAX_BINS && t < stop && transmittance >= EARLY_STOP; ++bin) {
        @step
        @texels
        float alpha = wp::min(root * root, 1.0f);
        if (field.exponent != 1.0f) alpha = 1.0f - wp::pow(1.0f - alpha, field.exponent);
        if (field.classes > 0 && root > 0.0f) {
            // Of the opacity's root, what each corner has, and the classes that it names.
            float parts[8], sure = 0.0f;
            int named = 0, differ = 0;
            for (int c = 0; c < 8; ++c) {
                const unsigned char* at = vertex + 8 * OFFSETS[c];
                parts[c] = shares[c] * (float)at[3];
                sure += parts[c] * (float)at[5];
                if (at[3] > 0) named = at[4] | at[6] << 8;
            }
            for (int c = 0; c < 8; ++c) {
                const unsigned char* at = vertex + 8 * OFFSETS[c];
                differ |= at[3] > 0 ? (at[4] | at[6] << 8) ^ named : 0;
            }
            const float whole = alpha / (255.0f * root);
            if (differ == 0) {
                const float share = sure * whole * (1.0f / 255.0f);
                const float top = share * opacity[named & 255], second = (alpha - share) * opacity[named >> 8];
                probability[named & 255] += transmittance * top;
                probability[named >> 8] += transmittance * second;
                alpha = top + second;
            } else {
                alpha = 0.0f;
                for (int c = 0; c < 8; ++c) {
                    const unsigned char* at = vertex + 8 * OFFSETS[c];
                    const float part = parts[c] * whole, share = (float)at[5] * (1.0f / 255.0f);
                    if (part <= 0.0f) continue;
                    const float top = part * share * opacity[at[4]], second = part * (1.0f - share) * opacity[at[6]];
                    probability[at[4]] += transmittance * top;
                    probability[at[6]] += transmittance * second;
                    alpha += top + second;
                }
            }
        }
        const float weight = transmittance * alpha;
        color += plain * weight;
        depth += weight * t;
        if (weight > brightest) {
            brightest = weight;
            place = local;
            block_of_place = slot;
        }
        transmittance *= 1.0f - alpha;
        t += length;
    }
    if (brightest > 0.0f) {
        const float covered = 1.0f - transmittance;
        color = clamped(color + color_change(place, block_of_place) * covered, covered);
    }
    float* result = (float*)out.data + 5 * (size_t)r;
    result[0] = color[0];
    result[1] = color[1];
    result[2] = color[2];
    result[3] = 1.0f - transmittance;
    result[4] = depth;
"""
)

_ADD_ERRORS = (
    _CHANGE
    + """
    const float* asked = (const float*)wanted.data + 3 * (size_t)r;
    const float* far_color = (const float*)behind.data + 3 * (size_t)r;
    Quad total = zero, error = zero, change = zero;
    for (int turn = 0; turn < 2; ++turn) {
        float t = begin, transmittance = 1.0f, brightest = 0.0f;
        Quad color = zero;
        for (int bin = 0; bin < MAX_BINS && t < end && transmittance >= EARLY_STOP; ++bin) {
            @step
            @texels
            const float alpha = wp::min(root * root, 1.0f), weight = transmittance * alpha;
            color += plain * weight;
            if (turn == 0 && weight > brightest) {
                brightest = weight;
                change = color_change(local, slot);
            }
            if (turn == 1 && transmittance * root > LEAST_WEIGHT) {
                // What lies behind the sample, were it alone to be seen.
                const float left = transmittance * (1.0f - alpha);
                const Quad rest = clamped((total - color - change * (1.0f - left)) / wp::max(left, 1.0e-4f), 1.0f);
                const Quad effect = (clamped(plain + change, 1.0f) - rest) * (transmittance * 2.0f * root);
                const Quad told = error * effect, squares = effect * effect;
                const float slope = told[0] + told[1] + told[2], square = squares[0] + squares[1] + squares[2];
                const Quad colors = {weight * error[0], weight * error[1], weight * error[2], weight};
                for (int c = 0; c < 8; ++c) {
                    float* sum = (float*)sums.data + 6 * (first + OFFSETS[c]);
                    for (int k = 0; k < 4; ++k) sum[k] += colors[k] * shares[c];
                    sum[4] += slope * shares[c];
                    sum[5] += square * shares[c];
                }
            }
            transmittance *= 1.0f - alpha;
            t += length;
        }
        if (turn == 0) {
            const float covered = 1.0f - transmittance;
            total = clamped(color + change * covered, covered) + Quad{far_color[0], far_color[1], far_color[2], 0.0f} * transmittance;
            error = Quad{asked[0], asked[1], asked[2], 0.0f} - total;
            const Quad squares = error * error;
            ((float*)errors.data)[r] = (squares[0] + squares[1] + squares[2]) / 3.0f;
        }
    }
"""
)

_NOTE_VIEWS = """
    const int camera = ((const int*)cameras.data)[r];
    float t = begin, transmittance = 1.0f;
    for (int bin = 0; bin < MAX_BINS && t < end && transmittance >= EARLY_STOP; ++bin) {
        @step
        const unsigned char* vertex = (const unsigned char*)roots.data + first;
        float root = 0.0f;
        for (int c = 0; c < 8; ++c) root += shares[c] * (float)vertex[OFFSETS[c]];
        root *= 1.0f / 255.0f;
        const float alpha = wp::min(root * root, 1.0f), weight = transmittance * alpha;
        auto note = [&](size_t row, float part) {
            const int share = (int)(part * 32767.0f);
            int* best = (int*)views.data + row * VIEWS + camera % VIEWS;
            if (share > 0) *best = wp::max(*best, share * 65536 + camera);
        };
        if (by_vertex == 0) {
            note(slot, weight);
        } else {
            for (int c = 0; c < 8; ++c) note(first + OFFSETS[c], weight * shares[c]);
        }
        transmittance *= 1.0f - alpha;
        t += length;
    }
"""


def _code(names: str, body: str) -> str:
    """C++ of a march: `names` for what it marches through, then `body`, in which @step and @texels stand for the above."""
    return _BEGIN + names + _RAY + body.replace("@step", _STEP).replace("@texels", _TEXELS)


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
    r: int,
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
    r: int,
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
    r: int,
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
