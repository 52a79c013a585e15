"""Torch backend of `composite.py`; gradients are autograd's.

Running sums go along the rows of a table with a row a ray: over all samples at once they would need float64, which MPS
does not have.
"""

from __future__ import annotations

import torch

from .packed_info import PackedInfo


def rows_of_rays(values: torch.Tensor, packed_info: PackedInfo) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Values (N,) of packed samples as a table (R, M) with zeros behind a ray's last sample; which entries are used
    (R, M) bool; and for each used entry, row by row, its sample."""
    most = int(packed_info.counts.max()) if len(packed_info.counts) else 0
    column = torch.arange(most, device=values.device)
    used = column < packed_info.counts[:, None]
    index = torch.where(used, packed_info.starts[:, None].long() + column, 0)
    return torch.where(used, values[index] if len(values) else 0.0, 0.0), used, index[used]


def render_weights(density: torch.Tensor, deltas: torch.Tensor, packed_info: PackedInfo) -> torch.Tensor:
    """As `composite.render_weights`."""
    if len(density) == 0:
        return density * deltas
    optical_depth, used, index = rows_of_rays(density * deltas, packed_info)
    after = torch.cumsum(optical_depth, 1)
    before = torch.nn.functional.pad(after, (1, 0))[:, :-1]
    weights = (torch.exp(-before) - torch.exp(-after))[used]
    return torch.zeros_like(density).index_put((index,), weights)


def weighted_sum(values: torch.Tensor, weights: torch.Tensor, packed_info: PackedInfo) -> torch.Tensor:
    """As `composite.weighted_sum`."""
    used = packed_info.ray_indices >= 0
    contribution = torch.where(used[:, None], values.float() * weights[:, None], 0.0)
    out = torch.zeros(len(packed_info.starts), values.shape[1], device=values.device)
    return out.index_add(0, packed_info.ray_indices.long().clamp(min=0), contribution)


def sums_in_front(values: torch.Tensor, packed_info: PackedInfo) -> torch.Tensor:
    """As `composite.sums_in_front`."""
    table, used, indices = rows_of_rays(values, packed_info)
    return torch.zeros_like(values).index_put((indices,), (torch.cumsum(table, 1) - table)[used])
