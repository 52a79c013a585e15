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
from .runtime import array, init, launch


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


@wp.struct
class ReadArrays:
    """What is read of points (N, 3): out (N, outputs) of the density head, features of both branches (N, F) where asked for."""

    points: wp.array(dtype=wp.vec3)
    out: wp.array(dtype=float)
    explicit_features: wp.array(dtype=float)
    implicit_features: wp.array(dtype=float)
    keep_explicit: int
    keep_implicit: int


@wp.func_native(
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
    float even[ROWS * MOST], odd[ROWS * MOST], joined[ROWS * MOST];
    float grid[ROWS * MOST], weight[ROWS];
    const int left = (int)read.points.shape[0] - block * ROWS, rows = left < ROWS ? left : ROWS;
    const size_t first = (size_t)block * ROWS;
    const float* point = (const float*)read.points.data + 3 * first;
    const int* widths = (const int*)field.sizes.data;
    const float* matrix = (const float*)field.weights.data;
    const int features = 4 * count;
    auto run = [&](float* from, float* to, int layers) -> float* {
        for (int layer = 0; layer < layers; ++layer) {
            const int stride = padded(widths[0]), columns = padded(widths[1]);
            multiply(from, stride, widths[0], matrix, columns, to, layer + 1 < layers);
            matrix += stride * columns;
            ++widths;
            float* next = from; from = to; to = next;
        }
        ++widths;
        return from;
    };
    // Rows below the last point are computed as well and never read: they only have to be numbers.
    if (rows < ROWS) {
        __builtin_memset(even, 0, sizeof(even));
        __builtin_memset(joined, 0, sizeof(joined));
    }
    for (int r = 0; r < rows; ++r) {
        if (count > 0) encode_point(point + 3 * r, (Feature*)(grid + r * features));
        weight[r] = 1.0f;
        if (field.evidence_side > 0) {
            const float e = trilinear((const float*)field.evidence.data, field.evidence_side, point + 3 * r);
            weight[r] = 1.0f - (1.0f - field.floor) * wp::exp(-field.rate * e);
        }
    }
    const float* implicit = nullptr;
    int inside = features, other = 0;
    if (field.implicit_layers > 0) {
        other = widths[field.implicit_layers];
        const int stride = padded(widths[0]);
        for (int r = 0; r < rows; ++r) {
            float* row = even + r * stride;
            write_frequencies(point + 3 * r, field.octaves, [&](int column, Axes value) {
                __builtin_memcpy(row + column, &value, column + 4 <= stride ? 16 : 12);
            });
        }
        implicit = run(even, odd, field.implicit_layers);
        inside = field.side_by_side ? features + other : other;
    }
    const int stride = padded(inside), other_stride = padded(other);
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
    if (read.keep_explicit && count > 0)
        __builtin_memcpy((float*)read.explicit_features.data + first * features, grid, (size_t)rows * features * sizeof(float));
    if (read.keep_implicit && other > 0)
        for (int r = 0; r < rows; ++r)
            __builtin_memcpy((float*)read.implicit_features.data + (first + r) * other, implicit + r * other_stride, other * sizeof(float));
    const int outputs = widths[field.density_layers], out_stride = padded(outputs);
    // The implicit network's features are not needed any more: their place is free.
    const float* found = run(joined, implicit == odd ? odd : even, field.density_layers);
    for (int r = 0; r < rows; ++r)
        __builtin_memcpy((float*)read.out.data + (first + r) * outputs, found + r * out_stride, outputs * sizeof(float));
"""
)
def _read(field: FieldArrays, read: ReadArrays, block: int): ...


@wp.kernel(module="fieldwork_field_host")
def read_kernel(field: FieldArrays, read: ReadArrays, offset: int):
    _read(field, read, wp.tid() + offset)


@dataclass(frozen=True)
class HostField:
    """A field packed for `read`; stale as soon as it is trained further.

    Args:
        levels, gains, table: the grid's, as `encode.forward` takes them; table None without a grid.
        evidence: (side³,) of the blend weight w₀ + (1 − w₀)(1 − exp(−rate · E)) with w₀ = floor; None: the grid alone.
        implicit, density: layers (out, in) of both networks.
        side_by_side: the branches are weighed and joined, else summed.
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
        width = len(implicit[-1]) if implicit else 0
        return cls(
            arrays, arrays.count * FEATURES, width, len(density[-1]), (rows, layout, factors, seen, weights, sizes)
        )

    def read(
        self, points: torch.Tensor, keep_explicit: bool, keep_implicit: bool
    ) -> tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None]:
        """Of points (N, 3) in [0, 1]³: what the density head says (N, outputs), and features of the explicit and the
        implicit branch (N, F) where there are such and they are asked for."""
        count = len(points)
        out = torch.empty(count, self.outputs)
        explicit = torch.empty(count, self.explicit_width) if keep_explicit and self.explicit_width else None
        implicit = torch.empty(count, self.implicit_width) if keep_implicit and self.implicit_width else None
        read = ReadArrays()
        read.points, read.out = array(points.contiguous(), wp.vec3), array(out.view(-1))
        read.explicit_features = array(out.view(-1) if explicit is None else explicit.view(-1))
        read.implicit_features = array(out.view(-1) if implicit is None else implicit.view(-1))
        read.keep_explicit, read.keep_implicit = int(explicit is not None), int(implicit is not None)
        launch(read_kernel, -(-count // ROWS), [self.arrays, read], points.device)
        return out, explicit, implicit
