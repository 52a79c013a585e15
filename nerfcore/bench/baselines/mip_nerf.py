"""Mip-NeRF: cones instead of rays, integrated positional encoding, one network for both levels.

Source: Barron et al., “Mip-NeRF: A Multiscale Representation for Anti-Aliasing Neural Radiance Fields”, 2021. Sizes and
weights are those of its published code.
"""

from __future__ import annotations

import torch
from torch.nn.functional import max_pool1d, softplus

from ...data.pixels import Batch
from ...field.encoding import frequency_encoding
from .hierarchical import sample_pdf, stratified, uniforms
from .method import Baseline, Rays, Rendered, Setup, log_linear, ray_limits, ray_weights
from .network import RadianceNetwork

SAMPLES, OCTAVES, VIEW_OCTAVES = 128, 16, 4
COARSE_WEIGHT = 0.1
RESAMPLE_PADDING, COLOR_PADDING, DENSITY_SHIFT = 0.01, 0.001, -1.0
FIRST_RATE, LAST_RATE = 5e-4, 5e-6
DELAY, DELAY_FACTOR = 0.0025, 0.01  # rates start low for this share of the training


def cone_gaussians(rays: Rays, edges: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Means and diagonal variances (R, S, 3) of the parts of cones between distances (R, S + 1): eq. 7, 8 and 16."""
    t0, t1 = edges[:, :-1], edges[:, 1:]
    middle, half = (t0 + t1) / 2, (t1 - t0) / 2
    m2, h2 = middle**2, half**2
    sum2 = 3 * m2 + h2
    t_mean = middle + 2 * middle * h2 / sum2
    t_var = h2 / 3 - (4 / 15) * (h2**2 * (12 * m2 - h2) / sum2**2)
    r_var = rays.radii[:, None] ** 2 * (m2 / 4 + (5 / 12) * h2 - (4 / 15) * h2**2 / sum2)
    d = rays.directions[:, None]
    mean = rays.origins[:, None] + d * t_mean[..., None]
    variance = t_var[..., None] * d**2 + r_var[..., None] * (1 - d**2)
    return mean, variance


def integrated_encoding(mean: torch.Tensor, variance: torch.Tensor, octaves: int = OCTAVES) -> torch.Tensor:
    """Expected sin and cos of 2^k x of Gaussians with means and diagonal variances (N, 3): (N, 6 · octaves), eq. 14."""
    scale = 2.0 ** torch.arange(octaves, device=mean.device)
    angle = (mean[:, None] * scale[:, None]).flatten(1)
    fade = torch.exp(-0.5 * (variance[:, None] * scale[:, None] ** 2).flatten(1))
    return torch.cat([fade * torch.sin(angle), fade * torch.cos(angle)], 1)


def widened(weights: torch.Tensor) -> torch.Tensor:
    """Weights (R, S) that the fine level is drawn by: the mean of the larger of neighbours, and a little everywhere."""
    padded = torch.cat([weights[:, :1], weights, weights[:, -1:]], 1)
    larger = max_pool1d(padded[:, None], 2, 1)[:, 0]
    return (larger[:, 1:] + larger[:, :-1]) / 2 + RESAMPLE_PADDING


class MipNeRF(Baseline):
    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self.net = RadianceNetwork(6 * OCTAVES, 3 + 6 * VIEW_OCTAVES).to(setup.device)
        self.optimizer = torch.optim.Adam(self.parameters(), FIRST_RATE)

    def level(self, rays: Rays, edges: torch.Tensor) -> tuple[Rendered, torch.Tensor]:
        """What the parts of cones between distances (R, S + 1) show, and their weights (R, S)."""
        mean, variance = cone_gaussians(rays, edges)
        # [−1, 1] holds one period of the first octave, as in the original's scenes.
        scale = torch.pi / self.setup.bound
        positions = integrated_encoding(mean.reshape(-1, 3) * scale, variance.reshape(-1, 3) * scale**2)
        count = edges.shape[1] - 1
        views = frequency_encoding((rays.directions + 1) / 2, VIEW_OCTAVES)
        with self.network(), self.half_precision():
            density, color, _ = self.net(positions, views.repeat_interleave(count, 0))
        deltas = edges[:, 1:] - edges[:, :-1]
        weights = ray_weights(softplus(density + DENSITY_SHIFT).view_as(deltas), deltas)
        color = torch.sigmoid(color) * (1 + 2 * COLOR_PADDING) - COLOR_PADDING
        color = (weights[..., None] * color.view(len(rays), count, 3)).sum(1)
        middle = (edges[:, 1:] + edges[:, :-1]) / 2
        return Rendered(color, weights.sum(1), (weights * middle).sum(1)), weights

    def both(self, rays: Rays, generator: torch.Generator | None) -> tuple[Rendered, Rendered]:
        near, far = ray_limits(rays, self.setup.contracted)
        edges = stratified(near, far, SAMPLES + 1, generator)
        coarse, weights = self.level(rays, edges)
        u = uniforms(len(rays), SAMPLES + 1, edges.device, generator)
        fine, _ = self.level(rays, sample_pdf(edges, widened(weights.detach()), u))
        return coarse, fine

    def train_step(self, batch: Batch, rays: Rays, progress: float, generator: torch.Generator) -> float:
        slow = DELAY_FACTOR + (1 - DELAY_FACTOR) * min(progress / DELAY, 1.0)
        for group in self.optimizer.param_groups:
            group["lr"] = slow * log_linear(progress, FIRST_RATE, LAST_RATE)
        target = self.target(batch)
        coarse, fine = (((self.behind(r.color, r.opacity) - target) ** 2).mean() for r in self.both(rays, generator))
        self.optimizer.zero_grad(set_to_none=True)
        (COARSE_WEIGHT * coarse + fine).backward()
        self.optimizer.step()
        self.steps += 1
        return fine.item()

    @torch.no_grad()
    def render(self, rays: Rays, semantics: bool = True) -> Rendered:
        return self.both(rays, None)[1]
