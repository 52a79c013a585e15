"""From points to what the density head says of them, on the CPU and without gradients: features of the grid, implicit
branch, their weight and the density head, a block of points at a time, in one launch.

`field/hybrid.py` has the same in separate operations, which training differentiates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import warp as wp

from .encode_host import ENCODE, feature
from .encode_torch import FEATURES
from .inputs_host import AXES, FREQUENCIES, TRILINEAR
from .network_host import BLOCKS, ROWS, packed, sizes_of
from .packed_info import PackedInfo
from .runtime import array, init, launch

EARLY_STOP = 1e-4  # transmittance below which a ray ends, as in `traversal.py`
RAYS = 1024  # that one launch index follows, 48 at a time


@wp.struct
class FieldArrays:
    """A field as the kernel takes it. Layers of the implicit network, then of the density head, packed as
    `network_host.packed` does, with their widths (inputs of the first, outputs of each); no layers of the former
    without an implicit branch. evidence_side is 0 where the branches are not weighed, and count 0 without a grid."""

    table: wp.array(dtype=feature)
    levels: wp.array(dtype=wp.vec3i)
    gains: wp.array(dtype=float)
    count: int
    evidence: wp.array(dtype=float)
    evidence_side: int
    floor: float
    rate: float
    side_by_side: int
    octaves: int
    weights: wp.array(dtype=float)
    sizes: wp.array(dtype=int)
    implicit_layers: int
    density_layers: int
    shift: float
    thinning: int


@wp.struct
class RayArrays:
    """Packed samples on rays (`PackedInfo`) and what is found of them: density (N,), −1 where it was not read, and rendering
    weight (N,). Features of samples with a weight up to `cull` are left out, a ray ends at a transmittance of `least`."""

    starts: wp.array(dtype=int)
    counts: wp.array(dtype=int)
    deltas: wp.array(dtype=float)
    density: wp.array(dtype=float)
    weights: wp.array(dtype=float)
    cull: float
    least: float


@wp.struct
class ReadArrays:
    """What is read of points (N, 3): out (N, outputs) of the density head, features of both branches (N, F) where asked for."""

    points: wp.array(dtype=wp.vec3)
    out: wp.array(dtype=float)
    explicit_features: wp.array(dtype=float)
    implicit_features: wp.array(dtype=float)
    keep_explicit: int
    keep_implicit: int


# `evaluate`: of up to ROWS points, what the density head says (found, of out_stride numbers a row), the grid's features
# (grid, side by side) and the implicit branch's (implicit, of other_stride numbers a row). Rows below the last point are
# computed as well and never read: they only have to be numbers.
_EVALUATE = (
    """
    const auto& levels = field.levels;
    const auto& gains = field.gains;
    const auto& table = field.table;
    const int count = field.count;
"""
    + ENCODE
    + AXES
    + FREQUENCIES
    + TRILINEAR
    + BLOCKS
    + """
    float even[ROWS * MOST], odd[ROWS * MOST], joined[ROWS * MOST], grid[ROWS * MOST], weight[ROWS];
    const int features = 4 * count;
    const int* sizes = (const int*)field.sizes.data;
    const int other = field.implicit_layers > 0 ? sizes[field.implicit_layers] : 0, other_stride = padded(other);
    const int* density_sizes = field.implicit_layers > 0 ? sizes + field.implicit_layers + 1 : sizes;
    const int outputs = density_sizes[field.density_layers], out_stride = padded(outputs);
    const float *implicit = nullptr, *found = nullptr;
    __builtin_memset(even, 0, sizeof(even));
    __builtin_memset(joined, 0, sizeof(joined));
    auto evaluate = [&](const float* const* points, int rows) {
        const float* matrix = (const float*)field.weights.data;
        auto run = [&](const int* widths, float* from, float* to, int layers) -> const float* {
            for (int layer = 0; layer < layers; ++layer) {
                const int stride = padded(widths[layer]), columns = padded(widths[layer + 1]);
                multiply(from, stride, widths[layer], matrix, columns, to, layer + 1 < layers);
                matrix += stride * columns;
                float* next = from; from = to; to = next;
            }
            return from;
        };
        for (int r = 0; r < rows; ++r) {
            if (count > 0) encode_point(points[r], (Feature*)(grid + r * features));
            weight[r] = 1.0f;
            if (field.evidence_side > 0) {
                const float e = trilinear((const float*)field.evidence.data, field.evidence_side, points[r]);
                weight[r] = 1.0f - (1.0f - field.floor) * wp::exp(-field.rate * e);
            }
        }
        int inside = features;
        if (field.implicit_layers > 0) {
            const int stride = padded(sizes[0]);
            for (int r = 0; r < rows; ++r) {
                float* row = even + r * stride;
                write_frequencies(points[r], field.octaves, [&](int column, Axes value) {
                    __builtin_memcpy(row + column, &value, column + 4 <= stride ? 16 : 12);
                });
            }
            implicit = run(sizes, even, odd, field.implicit_layers);
            inside = field.side_by_side ? features + other : other;
        }
        const int stride = padded(inside);
        for (int r = 0; r < rows; ++r) {
            float* row = joined + r * stride;
            const float *f = grid + r * features, *g = implicit + r * other_stride, w = weight[r];
            if (field.implicit_layers == 0) {
                __builtin_memcpy(row, f, features * sizeof(float));
            } else if (count == 0) {
                __builtin_memcpy(row, g, other * sizeof(float));
            } else if (field.side_by_side) {
                for (int k = 0; k < features; ++k) row[k] = w * f[k];
                for (int k = 0; k < other; ++k) row[features + k] = (1.0f - w) * g[k];
            } else {
                for (int k = 0; k < features; ++k) row[k] = g[k] + w * (f[k] - g[k]);
            }
        }
        // Of the two buffers of the implicit network one holds its features, the other is free.
        found = run(density_sizes, joined, implicit == odd ? even : odd, field.density_layers);
    };
    auto keep_features = [&](int r, size_t sample) {
        if (read.keep_explicit)
            __builtin_memcpy((float*)read.explicit_features.data + sample * features, grid + r * features, features * sizeof(float));
        if (read.keep_implicit)
            __builtin_memcpy((float*)read.implicit_features.data + sample * other, implicit + r * other_stride, other * sizeof(float));
        __builtin_memcpy((float*)read.out.data + sample * outputs, found + r * out_stride, outputs * sizeof(float));
    };
    const float* place = (const float*)read.points.data;
"""
)


@wp.func_native(
    _EVALUATE
    + """
    const int left = (int)read.points.shape[0] - block * ROWS, rows = left < ROWS ? left : ROWS;
    const size_t first = (size_t)block * ROWS;
    const float* points[ROWS];
    for (int r = 0; r < rows; ++r) points[r] = place + 3 * (first + r);
    evaluate(points, rows);
    for (int r = 0; r < rows; ++r) keep_features(r, first + r);
"""
)
def _read(field: FieldArrays, read: ReadArrays, block: int): ...


# Each row follows a ray from sample to sample; one that is opaque or at its end makes room for the next.
@wp.func_native(
    _EVALUATE
    + """
    const int* starts = (const int*)rays.starts.data;
    const int* counts = (const int*)rays.counts.data;
    const float* deltas = (const float*)rays.deltas.data;
    float *density = (float*)rays.density.data, *weights = (float*)rays.weights.data;
    const int total = (int)rays.counts.shape[0], begin = group * 1024, end = begin + 1024 < total ? begin + 1024 : total;
    const float* points[ROWS];
    int sample[ROWS], last[ROWS], rows = 0, next_ray = begin;
    float depth[ROWS], before[ROWS];
    for (;;) {
        for (; rows < ROWS && next_ray < end; ++next_ray) {
            if (counts[next_ray] == 0) continue;
            sample[rows] = starts[next_ray];
            last[rows] = starts[next_ray] + counts[next_ray] - 1;
            depth[rows] = 0.0f;
            before[rows++] = 1.0f;
        }
        if (rows == 0) break;
        for (int r = 0; r < rows; ++r) points[r] = place + 3 * (size_t)sample[r];
        evaluate(points, rows);
        int going = 0;
        for (int r = 0; r < rows; ++r) {
            const int s = sample[r];
            const float a = found[r * out_stride] + field.shift;
            float value = wp::exp(a < -15.0f ? -15.0f : (a > 11.0f ? 11.0f : a));
            if (field.thinning) {
                float away = 0.0f;
                for (int k = 0; k < 3; ++k) {
                    const float off = points[r][k] - 0.5f;
                    away = off > away ? off : (-off > away ? -off : away);
                }
                const float rest = 2.0f - 4.0f * away, share = rest < 0.0f ? 0.0f : (rest > 1.0f ? 1.0f : rest);
                value *= share * share;
            }
            const float through = depth[r] + value * deltas[s], after = wp::exp(-through), w = before[r] - after;
            density[s] = value;
            weights[s] = w;
            if (w > rays.cull) keep_features(r, s);
            if (after < rays.least) {
                for (int k = s + 1; k <= last[r]; ++k) {
                    density[k] = -1.0f;
                    weights[k] = 0.0f;
                }
            } else if (s < last[r]) {
                sample[going] = s + 1;
                last[going] = last[r];
                depth[going] = through;
                before[going++] = after;
            }
        }
        rows = going;
    }
"""
)
def _render(field: FieldArrays, rays: RayArrays, read: ReadArrays, group: int): ...


@wp.kernel(module="fieldwork_field_host")
def read_kernel(field: FieldArrays, read: ReadArrays, offset: int):
    _read(field, read, wp.tid() + offset)


@wp.kernel(module="fieldwork_field_host")
def render_kernel(field: FieldArrays, rays: RayArrays, read: ReadArrays, offset: int):
    _render(field, rays, read, wp.tid() + offset)


@dataclass(frozen=True)
class _Found:
    """Arrays as the kernel and as its caller see them."""

    arrays: ReadArrays
    out: torch.Tensor
    explicit: torch.Tensor | None
    implicit: torch.Tensor | None


@dataclass(frozen=True)
class HostField:
    """A field packed for `read`; stale as soon as it is trained further.

    Args:
        levels, gains, table: the grid's, as `encode.forward` takes them; table None without a grid.
        evidence: (side³,) of the blend weight w₀ + (1 − w₀)(1 − exp(−rate · E)) with w₀ = floor; None: the grid alone.
        implicit, density: layers (out, in) of both networks.
        side_by_side: the branches are weighed and joined, else summed.
        shift, thinning: what makes a density of what the head says, see `field/hybrid.py`.
    """

    arrays: FieldArrays
    explicit_width: int
    implicit_width: int
    outputs: int
    kept: tuple[torch.Tensor, ...]  # what the arrays view

    @classmethod
    def of(
        cls,
        table: torch.Tensor | None,
        levels: Sequence[tuple[int, int, int]],
        gains: Sequence[float],
        evidence: torch.Tensor | None,
        floor: float,
        rate: float,
        implicit: Sequence[torch.Tensor],
        octaves: int,
        side_by_side: bool,
        density: Sequence[torch.Tensor],
        shift: float,
        thinning: bool,
    ) -> HostField:
        init()
        none = torch.zeros(1, FEATURES)
        rows = none if table is None else table
        layout = torch.tensor(levels if table is not None else [(2, 0, 8)], dtype=torch.int32)
        factors = torch.tensor(gains, dtype=torch.float32)
        seen = none[0] if evidence is None else evidence
        weights = packed([*implicit, *density], True)
        sizes = torch.tensor([*(sizes_of(implicit) if implicit else []), *sizes_of(density)], dtype=torch.int32)
        arrays = FieldArrays()
        arrays.table, arrays.levels, arrays.gains = array(rows, feature), array(layout, wp.vec3i), array(factors)
        arrays.count = 0 if table is None else len(levels)
        arrays.evidence = array(seen)
        arrays.evidence_side = 0 if evidence is None else round(len(evidence) ** (1 / 3))
        arrays.floor, arrays.rate = floor, rate
        arrays.side_by_side, arrays.octaves = int(side_by_side), octaves
        arrays.weights, arrays.sizes = array(weights), array(sizes)
        arrays.implicit_layers, arrays.density_layers = len(implicit), len(density)
        arrays.shift, arrays.thinning = shift, int(thinning)
        width = len(implicit[-1]) if implicit else 0
        return cls(
            arrays, arrays.count * FEATURES, width, len(density[-1]), (rows, layout, factors, seen, weights, sizes)
        )

    def read(
        self, points: torch.Tensor, keep_explicit: bool, keep_implicit: bool
    ) -> tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None]:
        """Of points (N, 3) in [0, 1]³: what the density head says (N, outputs), and features of the explicit and the
        implicit branch (N, F) where there are such and they are asked for."""
        found = self._room(points, keep_explicit, keep_implicit)
        launch(read_kernel, -(-len(points) // ROWS), [self.arrays, found.arrays], points.device)
        return found.out, found.explicit, found.implicit

    def render(
        self,
        points: torch.Tensor,
        deltas: torch.Tensor,
        packed_info: PackedInfo,
        cull: float,
        keep: bool,
        least: float = EARLY_STOP,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor | None, torch.Tensor | None]:
        """Of packed samples at points (N, 3) of lengths deltas (N,): density (N,), −1 where the ray's transmittance is
        below `least` before, and rendering weight (N,); and where that is above `cull` what the density head says (N, outputs) and, to `keep`,
        features of the explicit and the implicit branch (N, F)."""
        found = self._room(points, keep, keep)
        density, weights = torch.empty(len(points)), torch.empty(len(points))
        rays = RayArrays()
        rays.starts, rays.counts = array(packed_info.starts), array(packed_info.counts)
        rays.deltas, rays.density, rays.weights = array(deltas), array(density), array(weights)
        rays.cull, rays.least = cull, least
        groups = -(-len(packed_info.counts) // RAYS)
        launch(render_kernel, groups, [self.arrays, rays, found.arrays], points.device)
        return density, weights, found.out, found.explicit, found.implicit

    def _room(self, points: torch.Tensor, keep_explicit: bool, keep_implicit: bool) -> _Found:
        """Arrays for what is found of points (N, 3)."""
        count = len(points)
        out = torch.empty(count, self.outputs)
        explicit = torch.empty(count, self.explicit_width) if keep_explicit and self.explicit_width else None
        implicit = torch.empty(count, self.implicit_width) if keep_implicit and self.implicit_width else None
        arrays = ReadArrays()
        arrays.points, arrays.out = array(points.contiguous(), wp.vec3), array(out.view(-1))
        arrays.explicit_features = array(out.view(-1) if explicit is None else explicit.view(-1))
        arrays.implicit_features = array(out.view(-1) if implicit is None else implicit.view(-1))
        arrays.keep_explicit, arrays.keep_implicit = int(explicit is not None), int(implicit is not None)
        return _Found(arrays, out, explicit, implicit)
