"""Samples along rays: stratified, and drawn from where the weights of coarse ones lie.

Source: Mildenhall et al., “NeRF”, 2020, eq. 2 and section 5.2.
"""

from __future__ import annotations

import torch


def stratified(near: torch.Tensor, far: torch.Tensor, count: int, generator: torch.Generator | None) -> torch.Tensor:
    """Distances (R, count), one from each of so many equal parts of [near, far] (R,); their middles without a generator."""
    if generator is None:
        place = torch.full((len(near), count), 0.5, device=near.device)
    else:
        place = torch.rand(len(near), count, device=near.device, generator=generator)
    share = (torch.arange(count, device=near.device) + place) / count
    return near[:, None] + (far - near)[:, None] * share


def uniforms(rays: int, count: int, device: torch.device, generator: torch.Generator | None) -> torch.Tensor:
    """Numbers (rays, count) in [0, 1) in ascending order: random ones, or evenly spread without a generator."""
    if generator is None:
        return ((torch.arange(count, device=device) + 0.5) / count).expand(rays, count)
    return torch.rand(rays, count, device=device, generator=generator).sort(1).values


def sample_pdf(edges: torch.Tensor, weights: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    """Distances (R, N) whose density is piecewise constant: `weights` (R, B) of the parts between `edges` (R, B + 1).

    `u` (R, N) in [0, 1): the inverse of the distribution is taken there.
    """
    weights = weights + 1e-5  # a ray without weights gets uniform ones
    cdf = torch.cumsum(weights / weights.sum(1, keepdim=True), 1)
    cdf = torch.nn.functional.pad(cdf, (1, 0)).contiguous()
    above = torch.searchsorted(cdf, u.contiguous(), right=True).clamp(1, edges.shape[1] - 1)
    low, high = cdf.gather(1, above - 1), cdf.gather(1, above)
    first, last = edges.gather(1, above - 1), edges.gather(1, above)
    return first + (last - first) * ((u - low) / (high - low).clamp(min=1e-8)).clamp(0, 1)
