"""What a training step gives, and what is measured of steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from ..data.pixels import Batch
from ..field.grid import Part
from ..render.model import Rendered
from .losses import psnr


@dataclass(frozen=True)
class ShardResult:
    """What comes of one shard of a batch: gradients of the model's parameters, in their order, and of encoded points;
    its parts of the loss and of the squared error (scalars); what was rendered, if anything; gradients of the rays'
    origins and directions where cameras move."""

    gradients: Sequence[torch.Tensor | None]
    encoded: list[Part]
    loss: torch.Tensor
    squared_error: torch.Tensor
    rendered: Rendered | None
    rays: Sequence[torch.Tensor] = ()


@dataclass(frozen=True)
class Learned:
    """What a step learned from a batch: its shards; gradients of the model's parameters, in their order, and whether they
    and the loss are finite (); its loss and squared error (). The grid's gradients are in the grid."""

    batch: Batch
    shards: list[ShardResult]
    gradients: list[torch.Tensor | None]
    finite: torch.Tensor
    loss: torch.Tensor
    squared_error: torch.Tensor

    @property
    def rendered(self) -> list[Rendered]:
        """What was rendered, of the shards that met something."""
        return [shard.rendered for shard in self.shards if shard.rendered is not None]


@dataclass
class Measured:
    """Sums over the steps since the last reading; `loss` and `mse`, of the steps that were finite, and how many those were
    stay on the device until they are read.

    With a fixed capacity, `dropped`: rays that were left out for want of it, as far as the device was asked; `skipped`:
    steps without finite gradients, and `lost_rows`: rows of the grid that were left out for the same reason.
    """

    loss: float | torch.Tensor = 0.0
    mse: float | torch.Tensor = 0.0
    finite: int | torch.Tensor = 0
    steps: int = 0
    rays: int = 0
    samples: int = 0
    dropped: int = 0
    skipped: int = 0
    lost_rows: int = 0

    @property
    def mean_loss(self) -> float:
        return float(self.loss) / max(int(self.finite), 1)

    @property
    def psnr(self) -> float:
        return psnr(float(self.mse) / max(int(self.finite), 1))
