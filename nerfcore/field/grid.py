"""The explicit branch: features on the vertices of a multi-resolution grid."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import nn

from ..kernels import encode
from ..kernels.encode import BLOCK, FEATURES
from ..kernels.encode_points import backward_points
from ..kernels.runtime import small_tensor

Levels = list[tuple[int, int, int]]
Part = tuple[torch.Tensor, torch.Tensor]


def level_layout(levels: int, coarsest: int, finest: int, table_log2: int) -> Levels:
    """(resolution, first row, rows) of each level; resolutions grow geometrically.

    A level with more than 2^table_log2 vertices is hashed into that many rows. First rows are multiples of the
    optimiser's block, so that no two levels share a block.
    """
    layout, row = [], 0
    for resolution in np.round(np.geomspace(coarsest, finest, levels)).astype(int):
        rows = min(int(resolution) ** 3, 1 << table_log2)
        layout.append((int(resolution), row, rows))
        row += -(-rows // BLOCK) * BLOCK
    return layout


class _Encode(torch.autograd.Function):
    """Gradients go straight into the grid's own buffers: a dense gradient of the table never exists twice."""

    @staticmethod
    def forward(
        ctx,
        points: torch.Tensor,
        precomputed: torch.Tensor | None,
        anchor: torch.Tensor,
        grid: VertexGrid,
        gains: list[float],
    ):
        ctx.grid, ctx.gains, ctx.collected = grid, gains, grid.collected()
        ctx.save_for_backward(points)
        return grid.encode(points, gains) if precomputed is None else precomputed

    @staticmethod
    def backward(ctx, *grads):
        (points,) = ctx.saved_tensors
        grid: VertexGrid = ctx.grid
        part = points.detach(), grads[0].float().contiguous()
        if ctx.collected is None:
            grid.scatter([part], ctx.gains)
        else:
            ctx.collected.append(part)
        grad_points = None
        if ctx.needs_input_grad[0]:
            gains = [gain * weight for gain, weight in zip(ctx.gains, grid.point_gains)]
            grad_points = backward_points(grid.table, grid.levels, gains, *part)
        return grad_points, None, None, None, None


class VertexGrid(nn.Module):
    """Vertex features of all levels in one table, with their optimiser state.

    The state (Adam moments) belongs to the grid because only touched rows are ever updated.
    """

    def __init__(self, levels: Levels, initial: float = 1e-2) -> None:
        super().__init__()
        self.levels = levels
        self.point_gains = [1.0] * len(levels)  # weights of the levels in the gradient of the points
        self._kept_gains: tuple[list[float], torch.Tensor] | None = None
        self._thread = threading.local()
        rows = levels[-1][1] + -(-levels[-1][2] // BLOCK) * BLOCK
        self.register_buffer("table", torch.empty(rows, FEATURES).uniform_(-initial, initial))
        self.register_buffer("mean", torch.zeros(rows, FEATURES))
        self.register_buffer("square", torch.zeros(rows, FEATURES))
        self.register_buffer("gradient", torch.zeros(rows, FEATURES), persistent=False)
        self.register_buffer("touched", torch.zeros(rows // BLOCK, dtype=torch.uint8), persistent=False)
        # Rows whose gradient was not finite when they were to be updated, since `lost` was last cleared.
        self.register_buffer("lost", torch.zeros(1, dtype=torch.int32), persistent=False)
        self.register_buffer("anchor", torch.zeros(1), persistent=False)
        self.table: torch.Tensor
        self.mean: torch.Tensor
        self.square: torch.Tensor
        self.gradient: torch.Tensor
        self.touched: torch.Tensor
        self.lost: torch.Tensor
        self.anchor: torch.Tensor

    @property
    def width(self) -> int:
        """Features of an encoded point."""
        return len(self.levels) * FEATURES

    def parameter_count(self) -> int:
        return sum(rows for _, _, rows in self.levels) * FEATURES

    def forward(
        self, points: torch.Tensor, gains: list[float], precomputed: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Encode points (N, 3) in [0, 1]³ → (N, width) float32; `gains` (one per level) fade levels in.

        `precomputed`: the result, when a pass without gradients computed it already; only its gradient is added.
        """
        if not torch.is_grad_enabled():
            return self.encode(points, gains)
        # The anchor only tells autograd that the result depends on something trainable.
        return _Encode.apply(points, precomputed, self.anchor.requires_grad_(), self, gains)  # type: ignore[no-any-return]

    def encode(self, points: torch.Tensor, gains: list[float]) -> torch.Tensor:
        """Encode points (N, 3) without their gradient."""
        return encode.forward(self.table, self.levels, gains, points, self._factors(gains))

    def keep_gains(self, gains: list[float]) -> None:
        """Keep the gains of the steps to come in one place of the device, where recorded steps read them too."""
        if self._kept_gains is None:
            self._kept_gains = list(gains), small_tensor(gains, torch.float32, self.table.device)
        elif self._kept_gains[0] != gains:
            self._kept_gains[1].copy_(small_tensor(gains, torch.float32, self.table.device))
            self._kept_gains = list(gains), self._kept_gains[1]

    def _factors(self, gains: list[float]) -> torch.Tensor | None:
        return self._kept_gains[1] if self._kept_gains is not None and self._kept_gains[0] == gains else None

    def collected(self) -> list[Part] | None:
        """Where this thread's gradients go instead of the grid, see `collecting`."""
        return getattr(self._thread, "collected", None)

    @contextmanager
    def collecting(self) -> Iterator[list[Part]]:
        """Gradients of what this thread encodes here are listed instead of added, for one `scatter` later on: threads
        that differentiate parts of a batch side by side must not write the same rows."""
        parts: list[Part] = []
        self._thread.collected = parts
        try:
            yield parts
        finally:
            self._thread.collected = None

    def scatter(self, parts: list[Part], gains: list[float]) -> None:
        """Add the gradients of encoded points, (points (N, 3), gradient (N, width)) each, to the grid's."""
        encode.scatter(self.gradient, self.touched, self.levels, gains, parts, self._factors(gains))

    def clear(self) -> None:
        """Forget the gradient gathered since the last step."""
        self.gradient.zero_()
        self.touched.zero_()

    def step(self, rate: float, betas: tuple[float, float] = (0.9, 0.99)) -> None:
        """Adam on the rows touched since the last step; clears the gradient. Rows whose gradient is not finite stay as
        they are and are counted in `lost`."""
        encode.adam(self.table, self.gradient, self.mean, self.square, self.touched, self.lost, rate, betas)
