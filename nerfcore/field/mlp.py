"""Small bias-free ReLU networks in reduced precision, with a hand-written backward pass.

Layers are matrix products in bfloat16 (or float16, float32) with float32 master weights; the CPU works on slices of
rows that stay in its cache. About 2.5 times as fast forward and backward as autocast modules on a CPU with bfloat16
matrix units.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import nn

from ..kernels.runtime import run_parallel, worker_count

Precision = Literal["auto", "float32", "bfloat16", "float16"]
_CPU_ROWS = 16384  # of activations that fit a core's cache
_LEAST_ROWS = 1024


def compute_dtype(precision: Precision, device: torch.device) -> torch.dtype:
    """The dtype of matrix products: "auto" takes bfloat16 where the device multiplies it natively."""
    if precision != "auto":
        return getattr(torch, precision)
    if device.type == "cpu":
        return torch.bfloat16 if torch.cpu._is_avx512_bf16_supported() else torch.float32
    if device.type == "cuda":
        return torch.bfloat16 if torch.cuda.is_bf16_supported() else torch.float16
    return torch.float32


def _slices(rows: int, device: torch.device) -> list[slice]:
    """Parts of the rows: on the CPU one or more for each thread, small enough for its cache."""
    if device.type != "cpu":
        return [slice(0, rows)]
    step = min(_CPU_ROWS, max(_LEAST_ROWS, -(-rows // worker_count())))
    return [slice(begin, min(begin + step, rows)) for begin in range(0, rows, step)]


class _Chain(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: torch.Tensor, dtype: torch.dtype, *weights: torch.Tensor) -> torch.Tensor:
        ctx.dtype, ctx.input_dtype = dtype, x.dtype
        matrices = [w.to(dtype) for w in weights]
        layers = [x.to(dtype), *(torch.empty(len(x), len(w), dtype=dtype, device=x.device) for w in matrices)]

        def run(part: slice) -> None:
            with torch.no_grad():
                for index, matrix in enumerate(matrices):
                    torch.mm(layers[index][part], matrix.t(), out=layers[index + 1][part])
                    if index < len(matrices) - 1:
                        layers[index + 1][part].relu_()

        run_parallel([lambda p=part: run(p) for part in _slices(len(x), x.device)])
        ctx.save_for_backward(*matrices, *layers[:-1])
        return layers[-1]

    @staticmethod
    def backward(ctx, *grads):
        count = len(ctx.saved_tensors) // 2
        matrices, layers = ctx.saved_tensors[:count], ctx.saved_tensors[count:]
        grad = grads[0].to(ctx.dtype)
        grad_input = torch.empty_like(layers[0]) if ctx.needs_input_grad[0] else None
        parts = _slices(len(grad), grad.device)
        partial: list[list[torch.Tensor]] = [[] for _ in parts]

        def run(number: int, part: slice) -> None:
            with torch.no_grad():
                g = grad[part]
                for index in range(count - 1, -1, -1):
                    partial[number].append(torch.mm(g.t(), layers[index][part]).float())
                    if index > 0:
                        g = torch.ops.aten.threshold_backward(torch.mm(g, matrices[index]), layers[index][part], 0)
                    elif grad_input is not None:
                        torch.mm(g, matrices[0], out=grad_input[part])

        run_parallel([lambda n=number, p=part: run(n, p) for number, part in enumerate(parts)])
        # Summed in the order of the slices, whatever order they ran in.
        sums = [torch.stack(column).sum(0) for column in zip(*partial)]
        grad_weights = sums[::-1] if sums else [torch.zeros_like(m, dtype=torch.float32) for m in matrices]
        return None if grad_input is None else grad_input.to(ctx.input_dtype), None, *grad_weights


class MLP(nn.Module):
    """ReLU network without biases: (N, inputs) → (N, outputs) in the compute dtype.

    `layers` counts matrix products. Weights start uniform with He's variance; the last layer's are scaled by
    `output_gain`.
    """

    def __init__(self, inputs: int, outputs: int, width: int = 64, layers: int = 2, output_gain: float = 1.0) -> None:
        super().__init__()
        sizes = [inputs, *[width] * (layers - 1), outputs]
        self.weights = nn.ParameterList()
        for index, (fan_in, fan_out) in enumerate(zip(sizes[:-1], sizes[1:])):
            bound = math.sqrt(6.0 / fan_in) * (output_gain / math.sqrt(2.0) if index == layers - 1 else 1.0)
            self.weights.append(nn.Parameter(torch.empty(fan_out, fan_in).uniform_(-bound, bound)))

    def forward(self, x: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
        return _Chain.apply(x, dtype, *self.weights)  # type: ignore[no-any-return]
