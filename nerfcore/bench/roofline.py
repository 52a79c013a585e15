"""What a machine can do at most, and what rendering and training need at least: together the shortest times there can be.

Of the machine three rates are measured: matrix products as wide as the field's networks, reads of 16 bytes at random
places of a table as large as the field's, and copying. A sample needs its multiplications and its reads; activations,
rays, occupancy and optimiser state of the networks are taken to cost nothing. (Williams et al., "Roofline: an insightful
visual performance model for multicore architectures", 2009.)
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch

from ..field.hybrid import HybridField
from ..field.mlp import MLP
from ..field.slices import MOST_ROWS
from ..kernels.device import synchronize
from ..kernels.encode import BLOCK, FEATURES
from ..kernels.random_reads import READS, sum_random_rows
from ..kernels.runtime import in_pool, run_parallel, worker_count

SECONDS = 0.5  # of each measurement
CORNERS = 8  # of a cell, each read for every level


@dataclass(frozen=True)
class Rates:
    """Floating-point operations, reads of 16 bytes, and bytes copied (read and written), each a second."""

    flops: float
    reads: float
    bytes: float


@dataclass(frozen=True)
class Work:
    """What a computation needs at least, in the units of `Rates`."""

    flops: float
    reads: float
    bytes: float = 0.0

    def seconds(self, rates: Rates) -> float:
        """The shortest time in which a machine with these rates can do it, one kind of work after the other."""
        return self.flops / rates.flops + self.reads / rates.reads + self.bytes / rates.bytes


def measure_rates(field: HybridField, device: torch.device) -> Rates:
    """The machine's rates at the width, precision and table of a field, on the threads in use."""
    return Rates(_matrix_rate(field, device), _read_rate(field, device), _copy_rate(device))


def _rate(run: Callable[[], float], device: torch.device) -> float:
    """Work a second of `run`, which does some and returns how much; the best of what fits into the time."""
    run()
    best, end = 0.0, time.perf_counter() + SECONDS
    while time.perf_counter() < end:
        synchronize(device)
        begin = time.perf_counter()
        done = run()
        synchronize(device)
        best = max(best, done / (time.perf_counter() - begin))
    return best


def _matrix_rate(field: HybridField, device: torch.device) -> float:
    width, workers = field.config.width, 1 if in_pool() else worker_count()
    parts = [
        [torch.randn(rows, columns, device=device).to(field.dtype) for rows, columns in shapes]
        for shapes in [((MOST_ROWS, width), (width, width), (MOST_ROWS, width))] * workers
    ]

    @torch.no_grad()
    def multiply(a: torch.Tensor, b: torch.Tensor, out: torch.Tensor) -> None:
        for _ in range(50):
            torch.mm(a, b, out=out)

    def run() -> float:
        run_parallel([partial(multiply, *part) for part in parts], device)
        return workers * 50 * 2 * MOST_ROWS * width * width

    return _rate(run, device)


def _read_rate(field: HybridField, device: torch.device) -> float:
    table = torch.zeros(1 << 20 if field.grid is None else len(field.grid.table), FEATURES, device=device)

    def run() -> float:
        sum_random_rows(table, 1 << 15)
        return (1 << 15) * READS

    return _rate(run, device)


def _copy_rate(device: torch.device) -> float:
    workers = 1 if in_pool() else worker_count()
    parts = [torch.zeros(2, 1 << 24, dtype=torch.uint8, device=device) for _ in range(workers)]

    def run() -> float:
        run_parallel([partial(part[0].copy_, part[1]) for part in parts], device)
        return 2.0 * workers * (1 << 24)

    return _rate(run, device)


def _multiplications(*networks: MLP | None) -> int:
    return sum(weight.numel() for network in networks if network is not None for weight in network.parameters())


def _reads(field: HybridField) -> int:
    return 0 if field.grid is None else CORNERS * len(field.grid.levels)


def rendering_work(field: HybridField, evaluated: int, visible: int) -> Work:
    """Of pictures: the density of all samples that are evaluated, colour and classes of the visible ones."""
    geometry = _multiplications(field.implicit, field.density_head)
    shading = _multiplications(field.color_head, field.semantic_head)
    return Work(2.0 * (evaluated * geometry + visible * shading), evaluated * _reads(field))


def training_work(field: HybridField, evaluated: int, visible: int, touched: int) -> Work:
    """Of a step: the density of all samples, thrice that (forward and backward) of the visible ones and their colours and
    classes, their gradients added to the grid (a read and a write each), and Adam on `touched` blocks of its rows."""
    first = rendering_work(field, evaluated, 0)
    second = rendering_work(field, visible, visible)
    row = 16 * 4 * 2  # value, gradient and two moments, read and written
    return Work(first.flops + 3 * second.flops, first.reads + 2 * second.reads, float(touched * BLOCK * row))
