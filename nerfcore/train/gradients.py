"""Gradients that can be trusted: losses scaled for float16, and steps without finite gradients left out.

The decisions are made on the device; the host reads at its leisure how often they were needed.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ..kernels.device import backend_of

# Not tuned: the next three.
FIRST_SCALE, LARGEST_SCALE = 2.0**14, 2.0**24
GROWTH_STEPS = 500  # finite steps after which the scale doubles; it halves after one that is not finite


class GradientGuard:
    """Dynamic loss scaling (Micikevicius et al., "Mixed precision training", 2018, section 3.2) for matrix products in
    float16, whose gradients would vanish otherwise; other types need no scale. Either way steps whose gradients are
    not finite are left out.

    scale (): what losses are multiplied by, 1 without scaling; good_steps (): finite steps since it last changed;
    skipped (): steps left out since it was last cleared.
    """

    def __init__(self, dtype: torch.dtype, device: torch.device) -> None:
        self.scaling = dtype == torch.float16
        self.scale = torch.full((), FIRST_SCALE if self.scaling else 1.0, device=device)
        self.good_steps = torch.zeros((), device=device)
        self.skipped = torch.zeros((), device=device)
        self.finite = torch.ones((), dtype=torch.bool, device=device)
        self._fused = backend_of(device).fused_optimizer

    def scaled(self, loss: torch.Tensor) -> torch.Tensor:
        """The loss to differentiate."""
        return loss * self.scale if self.scaling else loss

    def unscaled(self, gradient: torch.Tensor) -> torch.Tensor:
        """The gradient of the loss itself."""
        return gradient / self.scale if self.scaling else gradient

    @torch.no_grad()
    def inspected(self, gradients: Sequence[torch.Tensor]) -> torch.Tensor:
        """Whether all of a step's gradients are finite (): what belongs into `finite` before `step`."""
        return torch.isfinite(torch.nn.utils.get_total_norm(gradients)) if gradients else self.finite

    @torch.no_grad()
    def step(self, optimizer: torch.optim.Optimizer) -> None:
        """`optimizer.step()`, left out where the gradients last inspected are not finite."""
        if self._fused:
            # torch's fused optimisers skip by themselves what says so on the device.
            optimizer.found_inf = (~self.finite).float()  # type: ignore[attr-defined]
            optimizer.step()
        elif bool(self.finite):
            optimizer.step()

    @torch.no_grad()
    def update(self) -> None:
        """Count the step, and change the scale where it was too large or could be larger."""
        self.skipped += ~self.finite
        if not self.scaling:
            return
        # In place: recorded steps read the scale where it was.
        self.good_steps.copy_(torch.where(self.finite, self.good_steps + 1, 0.0))
        grow = self.good_steps >= GROWTH_STEPS
        factor = torch.where(self.finite, torch.where(grow, 2.0, 1.0), 0.5)
        self.scale.copy_((self.scale * factor).clamp(1.0, LARGEST_SCALE))
        self.good_steps.copy_(torch.where(grow, 0.0, self.good_steps))


def only_finite(gradient: torch.Tensor) -> torch.Tensor:
    """The gradient with 0 where it is not finite."""
    return torch.nan_to_num(gradient, 0.0, 0.0, 0.0)
