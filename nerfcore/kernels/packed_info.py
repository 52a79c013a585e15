"""Which of the packed samples belong to which ray, in the terms of nerfacc (Li et al., "NerfAcc", 2023)."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class PackedInfo:
    """starts, counts (R,) int32: each ray's samples are start … start + count − 1; ray_indices (N,) int32: each
    sample's ray.

    Rays without samples have count 0 (and any start); unused entries of the samples have ray index −1.
    """

    starts: torch.Tensor
    counts: torch.Tensor
    ray_indices: torch.Tensor

    def subset(self, kept: torch.Tensor, capacity: int | None = None) -> tuple[torch.Tensor, PackedInfo]:
        """Indices (M,) int64 of the samples where `kept` (N,) is true, and how those are packed once they are taken.

        `capacity`: the fixed number M of entries, so that no count is read back from the device; kept samples beyond
        it are dropped, unused entries are 0 and have ray index −1.
        """
        before = torch.nn.functional.pad(torch.cumsum(kept, 0, dtype=torch.int32), (1, 0))
        if capacity is None:
            indices = kept.nonzero()[:, 0]
            ray_indices = self.ray_indices[indices]
        else:
            before = before.clamp(max=capacity)
            target = torch.where(kept & (before[:-1] < capacity), before[:-1], capacity).long()
            every = torch.arange(len(kept), device=kept.device)
            indices = torch.zeros(capacity + 1, dtype=torch.long, device=kept.device)
            indices = indices.scatter_(0, target, every)[:capacity]
            used = torch.arange(capacity, device=kept.device) < before[-1]
            ray_indices = torch.where(used, self.ray_indices[indices], -1)
        first = self.starts.clamp(min=0).long()
        starts = before[first]
        return indices, PackedInfo(starts, before[first + self.counts] - starts, ray_indices)
