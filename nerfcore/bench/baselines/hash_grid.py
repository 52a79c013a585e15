"""The hash grid of Instant-NGP: 16 levels with two features an entry.

Source: Müller et al., “Instant Neural Graphics Primitives with a Multiresolution Hash Encoding”, 2022, section 3 and
table 1. Cells, hash, threads and the optimiser are those of our own grid (`kernels/encode.py`), whose entries have four
features.
"""

from __future__ import annotations

import math
from functools import partial

import torch
import warp as wp
from torch import nn

from ...kernels import encode, encode_torch
from ...kernels.device import backend_of
from ...kernels.encode import BLOCK, across, cell_of
from ...kernels.runtime import array, init, launch, load, run_parallel, small_tensor

LEVELS, COARSEST, FINEST, TABLE_LOG2, PAIR = 16, 16, 2048, 19, 2
ROWS = BLOCK * encode.FEATURES // PAIR  # rows of the table that share one flag of the optimiser
INITIAL = 1e-4

pair = wp.types.vector(length=PAIR, dtype=wp.float32)


@wp.kernel(module="fieldwork_hash_grid")
def pairs_forward(
    table: wp.array(dtype=pair),
    points: wp.array(dtype=wp.vec3),
    levels: wp.array(dtype=wp.vec3i),
    out: wp.array(dtype=pair, ndim=2),
    offset: int,
):
    i = wp.tid() + offset
    p = points[i]
    for level in range(levels.shape[0]):
        layout = levels[level]
        low, high, f = cell_of(p, layout[0], layout[1], layout[2])
        v0 = across(across(table[low[0]], table[high[0]], f[0]), across(table[low[1]], table[high[1]], f[0]), f[1])
        v1 = across(across(table[low[2]], table[high[2]], f[0]), across(table[low[3]], table[high[3]], f[0]), f[1])
        out[i, level] = across(v0, v1, f[2])


@wp.kernel(module="fieldwork_hash_grid")
def pairs_backward(
    points: wp.array(dtype=wp.vec3),
    grad_out: wp.array(dtype=pair, ndim=2),
    levels: wp.array(dtype=wp.vec3i),
    grad_table: wp.array(dtype=pair),
    touched: wp.array(dtype=wp.uint8),
    offset: int,
):
    index = wp.tid() + offset
    level = index / points.shape[0]
    i = index - level * points.shape[0]
    layout = levels[level]
    low, high, f = cell_of(points[i], layout[0], layout[1], layout[2])
    g = grad_out[i, level]
    for k in range(4):
        y = float(k % 2)
        z = float(k / 2)
        w = (y * f[1] + (1.0 - y) * (1.0 - f[1])) * (z * f[2] + (1.0 - z) * (1.0 - f[2]))
        wp.atomic_add(grad_table, low[k], g * (w * (1.0 - f[0])))
        wp.atomic_add(grad_table, high[k], g * (w * f[0]))
        touched[low[k] / ROWS] = wp.uint8(1)
        touched[high[k] / ROWS] = wp.uint8(1)


def hash_levels(
    levels: int = LEVELS, coarsest: int = COARSEST, finest: int = FINEST, table_log2: int = TABLE_LOG2
) -> list[tuple[int, int, int]]:
    """(vertices along a side, first row, rows) of each level: N_l = ⌊N_min b^l⌋ cells, at most 2^table_log2 rows."""
    growth = math.exp(math.log(finest / coarsest) / max(levels - 1, 1))
    layout, row = [], 0
    for level in range(levels):
        vertices = math.floor(coarsest * growth**level + 1e-6) + 1
        rows = min(vertices**3, 1 << table_log2)
        layout.append((vertices, row, rows))
        row += -(-rows // ROWS) * ROWS  # no two levels share a flag
    return layout


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, points: torch.Tensor, anchor: torch.Tensor, grid: HashGrid):
        ctx.grid = grid
        ctx.save_for_backward(points)
        return grid.encode(points)

    @staticmethod
    def backward(ctx, *grads):
        ctx.grid.scatter(ctx.saved_tensors[0], grads[0].float().contiguous())
        return None, None, None


class HashGrid(nn.Module):
    """Points (N, 3) in [0, 1]³ → (N, levels · 2) float32; the optimiser's state is part of it."""

    def __init__(self, levels: list[tuple[int, int, int]], device: torch.device) -> None:
        super().__init__()
        self.levels = levels
        rows = levels[-1][1] + -(-levels[-1][2] // ROWS) * ROWS
        self.table = torch.empty(rows, PAIR, device=device).uniform_(-INITIAL, INITIAL)
        self.gradient, self.mean, self.square = (torch.zeros_like(self.table) for _ in range(3))
        self.touched = torch.zeros(rows // ROWS, dtype=torch.uint8, device=device)
        self.lost = torch.zeros(1, dtype=torch.int32, device=device)
        self.layout = small_tensor(tuple(levels), torch.int32, device)
        self.anchor = nn.Parameter(torch.zeros(1, device=device))

    @property
    def width(self) -> int:
        return len(self.levels) * PAIR

    def parameter_count(self) -> int:
        return sum(rows for _, _, rows in self.levels) * PAIR

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        if not torch.is_grad_enabled():
            return self.encode(points)
        return _Encode.apply(points, self.anchor, self)  # type: ignore[no-any-return]

    def encode(self, points: torch.Tensor) -> torch.Tensor:
        device = points.device
        if not backend_of(device).warp:
            return encode_torch.forward(self.table, self.levels, [1.0] * len(self.levels), points)
        init()
        out = torch.empty(len(points), len(self.levels), PAIR, device=device)
        inputs = [array(self.table, pair), array(points.contiguous(), wp.vec3), array(self.layout, wp.vec3i)]
        launch(pairs_forward, len(points), [*inputs, array(out, pair)], device)
        return out.flatten(1)

    def scatter(self, points: torch.Tensor, grad: torch.Tensor) -> None:
        """Add the gradient of encoded points to the table's."""
        device = points.device
        if not backend_of(device).warp:
            with torch.enable_grad():
                table = self.table.detach().requires_grad_()
                out = encode_torch.forward(table, self.levels, [1.0] * len(self.levels), points)
            self.gradient += torch.autograd.grad(out, table, grad)[0]
            self.touched.fill_(1)
            return
        init()
        count = len(points)
        where, values = array(points.contiguous(), wp.vec3), array(grad.view(count, len(self.levels), PAIR), pair)
        shared = [where, values, array(self.layout, wp.vec3i), array(self.gradient, pair), array(self.touched)]
        if not backend_of(device).host_threads:
            launch(pairs_backward, len(self.levels) * count, shared, device)
            return
        load(pairs_backward, device)

        def one_level(level: int) -> None:  # levels share no rows: their sums have a fixed order
            wp.launch(pairs_backward, dim=count, inputs=[*shared, level * count], device="cpu")

        run_parallel([partial(one_level, level) for level in range(len(self.levels))], device)

    def step(self, rate: float, betas: tuple[float, float], epsilon: float) -> None:
        """Adam on the rows touched since the last step; two rows are one of the optimiser's."""
        parts = [part.view(-1, encode.FEATURES) for part in (self.table, self.gradient, self.mean, self.square)]
        encode.adam(*parts, self.touched, self.lost, rate, betas, epsilon)
