"""Whether the environment may be behind the sky alone at first: only in captures where it takes what is near.

The masks (`sky_masks.py`) have a price: what they call near must end on a surface from the first step on, and what few photos
see past an edge then becomes a scrap at that edge. The ground of most captures becomes a surface without them. So training
begins without, and how much of what is near the environment then has decides; where that is much, training starts over, with
masks from its first step on.
Measured: docs/experiments.md, “Masks of the sky only where the environment takes the ground”, “Training that begins anew with masks”.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from ..data.pixels import Batch
from .sky_masks import SkyMasks

STEPS = 100  # of training, after which it is decided,
PART = 1 / 3  # or after this part of the stage, where that is sooner
TAKEN = 0.15  # of the pixels that show something near: from there on the masks are needed
RATE = 0.05  # at which the share follows that of a step; not tuned


class SkyStage:
    """The part of a training, from its begin to `until` in [0, 1] of the schedule, in which `masks` may be needed.

    `needed`: whether they are, None until that is decided; without them till then. `share`: of the pixels near, what the
    environment had in the steps watched; a scalar, 1 in the beginning.
    """

    def __init__(self, masks: SkyMasks, until: float) -> None:
        self.masks, self.until = masks, until
        self.needed: bool | None = None
        self.share = torch.ones((), device=masks.values.device)

    def masked(self, progress: float) -> bool:
        """Whether the environment is behind the sky alone in a step."""
        return bool(self.needed) and progress < self.until

    def limited(self, batch: Batch, progress: float) -> Batch:
        """The batch of a step; where it is masked, with the pixels that may show the sky."""
        if not self.masked(progress):
            return batch
        return replace(batch, sky=self.masks.at(batch.image, batch.pixel))

    @torch.no_grad()
    def observe(self, batch: Batch, weight: torch.Tensor) -> None:
        """Take in the environment's weight (R,) in the rays of a step, until it is decided."""
        if self.needed is None:
            near = ~self.masks.at(batch.image, batch.pixel)
            share = (weight * near).sum() / near.sum().clamp(min=1)
            counts = near.any() & torch.isfinite(share)
            self.share += torch.where(counts, RATE * (share - self.share), 0.0)

    def decide(self, steps: int, progress: float) -> bool:
        """Decide, where `steps` of training or `progress` are enough for it; reads from the device once.

        Returns:
            whether masks have turned out to be needed just now, so that training must start over.
        """
        if self.needed is not None or (steps < STEPS and progress < PART * self.until):
            return False
        self.needed = bool(self.share > TAKEN)
        return self.needed
