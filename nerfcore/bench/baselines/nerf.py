"""NeRF: two networks of 8 × 256, 64 stratified samples and 128 more where those have their weight.

Source: Mildenhall et al., “NeRF: Representing Scenes as Neural Radiance Fields for View Synthesis”, 2020. Sizes, initial
values and the schedule are those of its published code; rays and length are the protocol's.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ...data.pixels import Batch
from ...field.encoding import frequency_encoding
from .hierarchical import sample_pdf, stratified, uniforms
from .method import Baseline, Rays, Rendered, Setup, log_linear, ray_limits, ray_weights
from .network import RadianceNetwork

COARSE, FINE = 64, 128
OCTAVES, VIEW_OCTAVES = 10, 4
FIRST_RATE, LAST_RATE = 5e-4, 5e-5
INFINITE = 1e10  # length of the last sample


@dataclass(frozen=True)
class Composited:
    """Of R rays with S samples: what they show (as `Rendered`), weights (R, S), summed logits (R, K) or None."""

    color: torch.Tensor
    opacity: torch.Tensor
    depth: torch.Tensor
    weights: torch.Tensor
    logits: torch.Tensor | None


class NeRF(Baseline):
    """A coarse and a fine network. `extra_views`: more inputs of the branch that sees the view direction."""

    def __init__(self, setup: Setup, classes: int = 0, extra_views: int = 0) -> None:
        super().__init__(setup)
        sizes = 3 + 6 * OCTAVES, 3 + 6 * VIEW_OCTAVES + extra_views, classes
        self.coarse, self.fine = RadianceNetwork(*sizes), RadianceNetwork(*sizes)
        self.to(setup.device)
        self.optimizer = torch.optim.Adam(self.parameters(), FIRST_RATE)

    def views(self, rays: Rays) -> torch.Tensor:
        """Encoded view directions (R, …)."""
        return frequency_encoding((rays.directions + 1) / 2, VIEW_OCTAVES)

    def composite(self, network: RadianceNetwork, rays: Rays, t: torch.Tensor, semantics: bool) -> Composited:
        """Read a network at distances (R, S), ascending."""
        count = t.shape[1]
        points = rays.origins[:, None] + rays.directions[:, None] * t[..., None]
        positions = frequency_encoding((points.reshape(-1, 3) / self.setup.bound + 1) / 2, OCTAVES)
        with self.network(), self.half_precision():
            views = self.views(rays).repeat_interleave(count, 0)
            density, color, logits = network(positions, views, semantics)
        deltas = torch.cat([t[:, 1:] - t[:, :-1], torch.full_like(t[:, :1], INFINITE)], 1)
        weights = ray_weights(torch.relu(density).view_as(t), deltas)
        color = (weights[..., None] * torch.sigmoid(color).view(len(rays), count, 3)).sum(1)
        if logits is not None:
            logits = (weights[..., None] * logits.view(len(rays), count, -1)).sum(1)
        return Composited(color, weights.sum(1), (weights * t).sum(1), weights, logits)

    def both(
        self, rays: Rays, generator: torch.Generator | None, semantics: bool = True
    ) -> tuple[Composited, Composited]:
        """What the coarse and the fine network make of rays."""
        near, far = ray_limits(rays, self.setup.contracted)
        t = stratified(near, far, COARSE, generator)
        coarse = self.composite(self.coarse, rays, t, semantics)
        middles = (t[:, 1:] + t[:, :-1]) / 2
        u = uniforms(len(rays), FINE, t.device, generator)
        more = sample_pdf(middles, coarse.weights[:, 1:-1].detach(), u)
        return coarse, self.composite(self.fine, rays, torch.cat([t, more], 1).sort(1).values, semantics)

    def loss_of(self, composited: Composited, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
        """Loss of one network, and its mean squared error."""
        mse = ((self.behind(composited.color, composited.opacity) - self.target(batch)) ** 2).mean()
        return mse, mse

    def train_step(self, batch: Batch, rays: Rays, progress: float, generator: torch.Generator) -> float:
        for group in self.optimizer.param_groups:
            group["lr"] = log_linear(progress, FIRST_RATE, LAST_RATE)
        coarse, fine = (self.loss_of(c, batch) for c in self.both(rays, generator))
        self.optimizer.zero_grad(set_to_none=True)
        (coarse[0] + fine[0]).backward()
        self.optimizer.step()
        self.steps += 1
        return fine[1].item()

    @torch.no_grad()
    def render(self, rays: Rays, semantics: bool = True) -> Rendered:
        _, fine = self.both(rays, None, semantics)
        probabilities = None if fine.logits is None else fine.logits.softmax(1) * fine.opacity[:, None]
        return Rendered(fine.color, fine.opacity, fine.depth, probabilities)
