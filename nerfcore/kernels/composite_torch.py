"""Torch backend of `composite.py`; gradients are autograd's.

Running sums go along the rows of a table with a row a ray: over all samples at once they would need float64, which MPS
does not have.
"""

from __future__ import annotations

import torch

from .packing import Packing


def rows_of_rays(values: torch.Tensor, packing: Packing) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Values (N,) of packed samples as a table (R, M) with zeros behind a ray's last sample; which places are used
    (R, M) bool; and for each used place, row by row, its sample."""
    most = int(packing.count.max()) if len(packing.count) else 0
    column = torch.arange(most, device=values.device)
    used = column < packing.count[:, None]
    index = torch.where(used, packing.start[:, None].long() + column, 0)
    return torch.where(used, values[index] if len(values) else 0.0, 0.0), used, index[used]


def render_weights(density: torch.Tensor, delta: torch.Tensor, packing: Packing) -> torch.Tensor:
    """As `composite.render_weights`."""
    if len(density) == 0:
        return density * delta
    depth, used, place = rows_of_rays(density * delta, packing)
    after = torch.cumsum(depth, 1)
    before = torch.nn.functional.pad(after, (1, 0))[:, :-1]
    weights = (torch.exp(-before) - torch.exp(-after))[used]
    return torch.zeros_like(density).index_put((place,), weights)


def weighted_sum(values: torch.Tensor, weights: torch.Tensor, packing: Packing) -> torch.Tensor:
    """As `composite.weighted_sum`."""
    used = packing.ray >= 0
    contribution = torch.where(used[:, None], values.float() * weights[:, None], 0.0)
    out = torch.zeros(len(packing.start), values.shape[1], device=values.device)
    return out.index_add(0, packing.ray.long().clamp(min=0), contribution)
