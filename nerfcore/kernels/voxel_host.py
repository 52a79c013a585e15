"""The kernels of `voxel_march.py` and `voxel_fit.py` for the CPU, with vector types of the compiler: eight rays at a time
(`voxel_lanes.py`), and of a sample the eight corners of a cell, or the eight bytes of a vertex, in one register. Same
arguments, same results up to rounding. Arrays are contiguous.
"""

from __future__ import annotations

import warp as wp

from .traversal import MarchParams
from .voxel_arrays import VoxelArrays
from .voxel_field import VIEWS
from .voxel_lanes import march_code
from .voxel_march_torch import LEAST_WEIGHT

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
    """C++ of a march through `names`, in whose `body` @texels stands for the above."""
    constants = f"const int VIEWS = {VIEWS}; const float LEAST_WEIGHT = {LEAST_WEIGHT}f;"
    return march_code(names + constants, body.replace("@texels", _TEXELS))


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
