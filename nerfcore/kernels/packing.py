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

    def subset(self, kept: torch.Tensor, room: int | None = None) -> tuple[torch.Tensor, Packing]:
        """Places (M,) int64 of the samples where `kept` (N,) is true, and their packing after those were taken.

        `room`: the fixed number M of places, so that no count is read back from the device; kept samples beyond it are
        dropped, unused places are 0 and have ray −1.
        """
        before = torch.nn.functional.pad(torch.cumsum(kept, 0, dtype=torch.int32), (1, 0))
        if room is None:
            places = kept.nonzero()[:, 0]
            ray = self.ray[places]
        else:
            before = before.clamp(max=room)
            target = torch.where(kept & (before[:-1] < room), before[:-1], room).long()
            every = torch.arange(len(kept), device=kept.device)
            places = torch.zeros(room + 1, dtype=torch.long, device=kept.device).scatter_(0, target, every)[:room]
            ray = torch.where(torch.arange(room, device=kept.device) < before[-1], self.ray[places], -1)
        first = self.start.clamp(min=0).long()
        start = before[first]
        return places, Packing(start, before[first + self.count] - start, ray)
