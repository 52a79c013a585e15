"""Volume rendering weights and sums over packed samples, with hand-written gradients.

α_j = 1 − exp(−σ_j δ_j), T_j = Π_{k<j} (1 − α_k), w_j = T_j α_j (Max, "Optical models for direct volume rendering",
1995). Rays are independent, each is one thread, so no sums race. The torch backend is in `composite_torch.py`.
"""

from __future__ import annotations

import torch
import warp as wp

from . import composite_torch
from .device import backend_of
from .packed_info import PackedInfo
from .runtime import array, init, launch


@wp.kernel(module="fieldwork_composite")
def weights_forward(
    density: wp.array(dtype=float),
    deltas: wp.array(dtype=float),
    starts: wp.array(dtype=int),
    counts: wp.array(dtype=int),
    weights: wp.array(dtype=float),
    offset: int,
):
    r = wp.tid() + offset
    base = starts[r]
    optical_depth = float(0.0)
    before = float(1.0)
    for k in range(base, base + counts[r]):
        optical_depth += density[k] * deltas[k]
        after = wp.exp(-optical_depth)
        weights[k] = before - after
        before = after


@wp.kernel(module="fieldwork_composite")
def weights_backward(
    density: wp.array(dtype=float),
    deltas: wp.array(dtype=float),
    starts: wp.array(dtype=int),
    counts: wp.array(dtype=int),
    weights: wp.array(dtype=float),
    grad_weights: wp.array(dtype=float),
    grad_density: wp.array(dtype=float),
    offset: int,
):
    r = wp.tid() + offset
    base = starts[r]
    total = float(0.0)
    for k in range(base, base + counts[r]):
        total += grad_weights[k] * weights[k]
    optical_depth = float(0.0)
    behind = total
    for k in range(base, base + counts[r]):
        optical_depth += density[k] * deltas[k]
        behind -= grad_weights[k] * weights[k]
        grad_density[k] = deltas[k] * (grad_weights[k] * wp.exp(-optical_depth) - behind)


@wp.kernel(module="fieldwork_composite")
def sum_forward(
    values: wp.array(dtype=float, ndim=2),
    weights: wp.array(dtype=float),
    starts: wp.array(dtype=int),
    counts: wp.array(dtype=int),
    channels: int,
    out: wp.array(dtype=float, ndim=2),
    offset: int,
):
    r = wp.tid() + offset
    base = starts[r]
    for c in range(channels):
        out[r, c] = 0.0
    if base < 0:
        return
    for k in range(base, base + counts[r]):
        w = weights[k]
        for c in range(channels):
            out[r, c] = out[r, c] + w * values[k, c]


@wp.kernel(module="fieldwork_composite")
def sum_backward(
    values: wp.array(dtype=float, ndim=2),
    weights: wp.array(dtype=float),
    ray_indices: wp.array(dtype=int),
    channels: int,
    grad_out: wp.array(dtype=float, ndim=2),
    grad_values: wp.array(dtype=float, ndim=2),
    grad_weights: wp.array(dtype=float),
    offset: int,
):
    k = wp.tid() + offset
    r = ray_indices[k]
    if r < 0:
        for c in range(channels):
            grad_values[k, c] = 0.0
        grad_weights[k] = 0.0
        return
    w = weights[k]
    g = float(0.0)
    for c in range(channels):
        grad_values[k, c] = w * grad_out[r, c]
        g += values[k, c] * grad_out[r, c]
    grad_weights[k] = g


@wp.kernel(module="fieldwork_composite")
def in_front(
    values: wp.array(dtype=float),
    starts: wp.array(dtype=int),
    counts: wp.array(dtype=int),
    out: wp.array(dtype=float),
    offset: int,
):
    r = wp.tid() + offset
    base = starts[r]
    total = float(0.0)
    for k in range(base, base + counts[r]):
        out[k] = total
        total += values[k]


@wp.kernel(module="fieldwork_composite")
def behind(
    values: wp.array(dtype=float),
    starts: wp.array(dtype=int),
    counts: wp.array(dtype=int),
    out: wp.array(dtype=float),
    offset: int,
):
    r = wp.tid() + offset
    last = starts[r] + counts[r] - 1
    total = float(0.0)
    for step in range(counts[r]):
        out[last - step] = total
        total += values[last - step]


class _Weights(torch.autograd.Function):
    @staticmethod
    def forward(ctx, density: torch.Tensor, deltas: torch.Tensor, packed_info: PackedInfo) -> torch.Tensor:
        init()
        density = density.contiguous()
        weights = torch.zeros_like(density)
        inputs = [array(density), array(deltas), array(packed_info.starts), array(packed_info.counts), array(weights)]
        launch(weights_forward, len(packed_info.starts), inputs, density.device)
        ctx.packed_info = packed_info
        ctx.save_for_backward(density, deltas, weights)
        return weights

    @staticmethod
    def backward(ctx, *grads):
        density, deltas, weights = ctx.saved_tensors
        packed_info: PackedInfo = ctx.packed_info
        grad_density = torch.zeros_like(density)
        inputs = [array(density), array(deltas), array(packed_info.starts), array(packed_info.counts)]
        inputs += [array(weights), array(grads[0].contiguous()), array(grad_density)]
        launch(weights_backward, len(packed_info.starts), inputs, density.device)
        return grad_density, None, None


class _Sum(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values: torch.Tensor, weights: torch.Tensor, packed_info: PackedInfo) -> torch.Tensor:
        init()
        ctx.dtype = values.dtype
        values, weights = values.float().contiguous(), weights.contiguous()
        channels = values.shape[1]
        out = torch.empty(len(packed_info.starts), channels, device=values.device)
        inputs = [
            array(values),
            array(weights),
            array(packed_info.starts),
            array(packed_info.counts),
            channels,
            array(out),
        ]
        launch(sum_forward, len(packed_info.starts), inputs, values.device)
        ctx.packed_info = packed_info
        ctx.save_for_backward(values, weights)
        return out

    @staticmethod
    def backward(ctx, *grads):
        values, weights = ctx.saved_tensors
        grad_values, grad_weights = torch.empty_like(values), torch.empty_like(weights)
        inputs = [array(values), array(weights), array(ctx.packed_info.ray_indices), values.shape[1]]
        inputs += [array(grads[0].contiguous()), array(grad_values), array(grad_weights)]
        launch(sum_backward, len(weights), inputs, values.device)
        return grad_values.to(ctx.dtype), grad_weights, None


class _SumsInFront(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values: torch.Tensor, packed_info: PackedInfo) -> torch.Tensor:
        ctx.packed_info = packed_info
        return _running(in_front, values, packed_info)

    @staticmethod
    def backward(ctx, *grads):
        return _running(behind, grads[0], ctx.packed_info), None


def _running(kernel: wp.Kernel, values: torch.Tensor, packed_info: PackedInfo) -> torch.Tensor:
    init()
    values = values.contiguous()
    out = torch.zeros_like(values)
    inputs = [array(values), array(packed_info.starts), array(packed_info.counts), array(out)]
    launch(kernel, len(packed_info.starts), inputs, values.device)
    return out


def render_weights(density: torch.Tensor, deltas: torch.Tensor, packed_info: PackedInfo) -> torch.Tensor:
    """Rendering weights (N,) of packed samples from their densities and lengths (N,); differentiable in `density`."""
    if not backend_of(density.device).warp:
        return composite_torch.render_weights(density, deltas, packed_info)
    return _Weights.apply(density, deltas, packed_info)  # type: ignore[no-any-return]


def sums_in_front(values: torch.Tensor, packed_info: PackedInfo) -> torch.Tensor:
    """Sum (N,) of the values (N,) float32 in front of each sample on its ray, 0 in unused entries; differentiable."""
    if not backend_of(values.device).warp:
        return composite_torch.sums_in_front(values, packed_info)
    return _SumsInFront.apply(values, packed_info)  # type: ignore[no-any-return]


def weighted_sum(values: torch.Tensor, weights: torch.Tensor, packed_info: PackedInfo) -> torch.Tensor:
    """Σ_j w_j v_j per ray: values (N, C), weights (N,) → (R, C) float32, zero for rays without samples."""
    if not backend_of(weights.device).warp:
        return composite_torch.weighted_sum(values, weights, packed_info)
    return _Sum.apply(values, weights, packed_info)  # type: ignore[no-any-return]
