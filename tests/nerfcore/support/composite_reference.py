"""What the functions of `composite.py` must give, one ray at a time."""

from __future__ import annotations

import torch
from fieldwork.nerfcore.kernels.packed_info import PackedInfo


def render_weights(density: torch.Tensor, deltas: torch.Tensor, packed_info: PackedInfo) -> torch.Tensor:
    """As `composite.render_weights`, differentiable by autograd."""
    parts = []
    for start, count in zip(packed_info.starts.tolist(), packed_info.counts.tolist()):
        if count == 0:
            continue
        tau = density[start : start + count] * deltas[start : start + count]
        after = torch.cumsum(tau, 0)
        parts.append(torch.exp(-(after - tau)) - torch.exp(-after))
    return torch.cat(parts) if parts else density * 0


def weighted_sum(values: torch.Tensor, weights: torch.Tensor, packed_info: PackedInfo) -> torch.Tensor:
    """As `composite.weighted_sum`."""
    rows = []
    for start, count in zip(packed_info.starts.tolist(), packed_info.counts.tolist()):
        rows.append((values[start : start + count] * weights[start : start + count, None]).sum(0))
    return torch.stack(rows)


def sums_in_front(values: torch.Tensor, packed_info: PackedInfo) -> torch.Tensor:
    """As `composite.sums_in_front`, differentiable by autograd."""
    out = torch.zeros_like(values)
    for start, count in zip(packed_info.starts.tolist(), packed_info.counts.tolist()):
        part = values[start : start + count]
        out = out.index_put((torch.arange(start, start + count, device=out.device),), torch.cumsum(part, 0) - part)
    return out
