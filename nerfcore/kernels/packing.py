"""Which of the packed samples belong to which ray."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Packing:
    """start, count (R,) int32: each ray's samples are start … start+count−1; ray (N,) int32: each sample's ray.

    Rays without samples have count 0 (and any start); unused places in the samples have ray −1.
    """

    start: torch.Tensor
    count: torch.Tensor
    ray: torch.Tensor

    def subset(self, kept: torch.Tensor) -> Packing:
        """Packing of the samples where `kept` (N,) is true, after `values[kept]` was taken."""
        before = torch.nn.functional.pad(torch.cumsum(kept, 0, dtype=torch.int32), (1, 0))
        first = self.start.clamp(min=0).long()
        start = before[first]
        return Packing(start, before[first + self.count] - start, self.ray[kept])
