"""Reading a field part by part, so that what passes from one operation to the next stays in a core's cache."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch

from ..kernels.runtime import run_parallel

MOST_ROWS, LEAST_ROWS = 8192, 1024  # of a slice on the CPU; the most still fits a core's cache


def row_slices(rows: int, device: torch.device) -> list[slice]:
    """Parts of the rows. The CPU's have few different sizes, powers of two, and the last one may reach beyond the rows:
    the matrix library compiles a kernel for every new shape, which takes longer than using it."""
    if device.type != "cpu":
        return [slice(0, rows)]
    parts, begin, size = [], 0, MOST_ROWS
    while begin < rows:
        while size > LEAST_ROWS and size > rows - begin:
            size //= 2
        parts.append(slice(begin, begin + size))
        begin += size
    return parts


def padded(x: torch.Tensor, rows: int, dtype: torch.dtype) -> torch.Tensor:
    """`x` with zero rows after its own; what lies column by column (encoded positions) stays so, `rows` from column to
    column: the matrix library compiles a kernel for every new distance as well."""
    by_columns = x.dim() == 2 and x.stride(0) == 1 and x.shape[1] > 1
    if len(x) == rows and (not by_columns or x.stride(1) == rows or x.device.type != "cpu"):
        return x.to(dtype)
    if by_columns:
        out = torch.empty(x.shape[1], rows, dtype=dtype, device=x.device).t()
    else:
        out = torch.empty(rows, *x.shape[1:], dtype=dtype, device=x.device)
    out[: len(x)] = x
    out[len(x) :] = 0
    return out


@torch.no_grad()
def read_in_slices(
    function: Callable[..., tuple[torch.Tensor | None, ...]], *inputs: torch.Tensor
) -> tuple[torch.Tensor | None, ...]:
    """What `function` makes of the rows of `inputs` (N, …), each of its results again with N rows (or None), on the CPU
    slice by slice and side by side; `function` treats every row alone and may be given rows of zeros. Without
    gradients."""
    count = len(inputs[0])
    parts = row_slices(count, inputs[0].device)
    if len(parts) < 2:
        return tuple(None if x is None else x[:count] for x in function(*(_slice(x, parts) for x in inputs)))
    first = function(*(x[parts[0]] for x in inputs))
    results = tuple(None if x is None else x.new_empty(count, *x.shape[1:]) for x in first)

    def keep(part: slice, found: tuple[torch.Tensor | None, ...]) -> None:
        for result, x in zip(results, found):
            if result is not None and x is not None:
                result[part] = x[: count - part.start]

    @torch.no_grad()
    def read(part: slice) -> None:
        keep(part, function(*(_slice(x, [part]) for x in inputs)))

    keep(parts[0], first)
    run_parallel([partial(read, part) for part in parts[1:]], inputs[0].device)
    return results


def _slice(x: torch.Tensor, parts: list[slice]) -> torch.Tensor:
    if not parts:
        return x
    (part,) = parts
    return padded(x[part], part.stop - part.start, x.dtype)
