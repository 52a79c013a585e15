"""Reading random rows of a table: the machine's rate of it bounds what the grid's features cost."""

from __future__ import annotations

import torch
import warp as wp

from .encode import FEATURES, feature
from .runtime import array, init, launch

READS = 64  # of each row of the result


@wp.kernel(module="fieldwork_random_reads")
def random_reads(table: wp.array(dtype=feature), out: wp.array(dtype=feature), offset: int):
    i = wp.tid() + offset
    state = wp.uint32(i) * wp.uint32(747796405)
    total = feature()
    for _ in range(READS):
        state = state * wp.uint32(1664525) + wp.uint32(1013904223)
        total += table[int((state >> wp.uint32(3)) % wp.uint32(table.shape[0]))]
    out[i] = total


def sum_random_rows(table: torch.Tensor, count: int) -> torch.Tensor:
    """Sums (count, FEATURES) of `READS` random rows of a table (rows, FEATURES) float32 each."""
    init()
    out = torch.empty(count, FEATURES, device=table.device)
    launch(random_reads, count, [array(table, feature), array(out, feature)], table.device)
    return out
