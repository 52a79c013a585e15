"""What is behind the field: sky and whatever is too far away to have a place, as colours of directions.

Without it a field that photos ask to be opaque everywhere puts the sky somewhere, at any depth: before cameras, around
things, in shells that look like surfaces. It is read from the field itself at the border of the grid, where contracted
space is infinitely far away, so that it needs no network of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn

from ..geometry.contraction import horizon
from .encoding import spherical_harmonics
from .hybrid import HybridField

# Not tuned: the next two.
RATE = 0.05  # at which the labelled share follows a step's
NAMED = 0.5  # of the labelled share of all pixels, that the environment must have to be of a class and not void


@dataclass(frozen=True)
class EnvironmentRays:
    """Of R rays: color (R, 3) in [0, 1]; probabilities (R, K) of classes, or None; weight (R,), how much of it the field
    leaves: 1 − opacity, 0 for rays that were left out."""

    color: torch.Tensor
    probabilities: torch.Tensor | None
    weight: torch.Tensor


class Environment(nn.Module):
    """The environment of a `HybridField`; knows whether photos name it."""

    def __init__(self) -> None:
        super().__init__()
        # Labelled share of the environment's pixels, relative to that of all pixels.
        self.register_buffer("labelled", torch.zeros(()))
        self.labelled: torch.Tensor

    def rays(
        self,
        field: HybridField,
        directions: torch.Tensor,
        weight: torch.Tensor,
        codes: torch.Tensor | None = None,
        semantics: bool = True,
    ) -> EnvironmentRays:
        """The environment in `directions` (R, 3), unit vectors of the normalised frame, with `weight` (R,); `codes`
        (R, A): appearance code of each ray. While gradients are kept, it has classes even where it is void."""
        far = field.geometry(horizon(directions))
        color = field.color(far, spherical_harmonics(directions).to(field.dtype), codes)
        probabilities = None
        if semantics and field.semantic_head is not None:
            probabilities = field.class_probabilities(far)
            if not torch.is_grad_enabled():
                probabilities = probabilities * (self.labelled > NAMED)
        return EnvironmentRays(color, probabilities, weight)

    def visible_rays(
        self, field: HybridField, directions: torch.Tensor, opacity: torch.Tensor, cull: float, semantics: bool
    ) -> EnvironmentRays:
        """The same for pictures: black and void where the field (opacity (R,)) leaves no more than `cull` of it."""
        weight = 1 - opacity
        seen = (weight > cull).nonzero()[:, 0]
        part = self.rays(field, directions[seen], weight[seen], semantics=semantics)
        color = directions.new_zeros(len(directions), 3).index_copy(0, seen, part.color)
        if part.probabilities is None:
            return EnvironmentRays(color, None, weight)
        void = color.new_zeros(len(directions), part.probabilities.shape[1])
        return EnvironmentRays(color, void.index_copy(0, seen, part.probabilities), weight)

    @torch.no_grad()
    def observe(self, weight: torch.Tensor, labelled: torch.Tensor, share: float) -> None:
        """Take in which rays of a step (R,) bool are labelled, the environment's weight (R,) in them, and the labelled
        share of all pixels."""
        total = weight.sum()
        found = (weight * labelled).sum() / total.clamp(min=1e-6) / max(share, 1e-6)
        self.labelled += torch.where(total > 0.01 * len(weight), RATE * (found - self.labelled), 0.0)
