"""Which of the packed samples belong to which ray, in the terms of nerfacc (Li et al., "NerfAcc", 2023)."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class PackedInfo:
    """starts, counts (R,) int32: each ray's samples are start … start + count − 1; ray_indices (N,) int32: each
    sample's ray.

    Rays without samples have count 0 (and any start within the samples or at their end); unused entries of the samples
    have ray index −1. left_out (R,) bool or None: rays that were left out for want of capacity.
    """

    starts: torch.Tensor
    counts: torch.Tensor
    ray_indices: torch.Tensor
    left_out: torch.Tensor | None = None

    @property
    def dropped(self) -> torch.Tensor | None:
        """How many rays were left out ()."""
        return None if self.left_out is None else self.left_out.sum()

    def subset(self, kept: torch.Tensor, capacity: int | None = None) -> tuple[torch.Tensor, PackedInfo]:
        """Indices (M,) int64 of the samples where `kept` (N,) is true, and how those are packed once they are taken.

        `capacity`: the fixed number M of entries, so that no count is read back from the device; rays whose kept
        samples reach beyond it are dropped as a whole, for a part of a ray's samples would tell something else; unused
        entries are 0 and have ray index −1.
        """
        before = torch.nn.functional.pad(torch.cumsum(kept, 0, dtype=torch.int32), (1, 0))
        first = self.starts.clamp(min=0).long()
        starts, ends = before[first], before[first + self.counts]
        if capacity is None:
            indices = kept.nonzero()[:, 0]
            return indices, PackedInfo(starts, ends - starts, self.ray_indices[indices], self.left_out)
        fits = ends <= capacity  # rays stand one after the other: the first ones
        kept = kept & fits[self.ray_indices.long()]
        target = torch.where(kept, before[:-1], capacity).long()
        every = torch.arange(len(kept), device=kept.device)
        indices = torch.zeros(capacity + 1, dtype=torch.long, device=kept.device)
        indices = indices.scatter_(0, target, every)[:capacity]
        used = torch.arange(capacity, device=kept.device) < kept.sum()
        ray_indices = torch.where(used, self.ray_indices[indices], -1)
        left_out = ~fits & (ends > starts)
        left_out = left_out if self.left_out is None else left_out | self.left_out
        counts = torch.where(fits, ends - starts, 0)
        return indices, PackedInfo(torch.where(fits, starts, 0), counts, ray_indices, left_out)
