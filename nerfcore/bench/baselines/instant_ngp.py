"""Instant-NGP: a hash grid, two small networks, samples at fixed steps in occupied cells.

Source: Müller et al., “Instant Neural Graphics Primitives with a Multiresolution Hash Encoding”, 2022, sections 4, 5.4
and appendices C and E. Differences: space beyond the cube is contracted instead of cascaded; the number of samples a step
is the protocol's.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import nn

from ...config import SamplingConfig
from ...data.pixels import Batch
from ...field.encoding import spherical_harmonics
from ...field.mlp import MLP, compute_dtype
from ...kernels.composite import render_weights, weighted_sum
from ...kernels.march import Samples, sample
from ...train.schedule import bias_correction
from .hash_grid import HashGrid, hash_levels
from .method import Baseline, Rays, Rendered, Setup
from .ngp_occupancy import UPDATE_EVERY, NGPOccupancy

GEOMETRY, WIDTH = 16, 64
CELLS = 128
STEP = 2 * 3**0.5 / 1024  # the cube here is two units wide
MOST_SAMPLES = 1024
RATE, BETAS, EPSILON = 1e-2, (0.9, 0.99), 1e-15
NETWORK_DECAY = 1e-6
DECAY, MILESTONES = 0.33, (20 / 35, 30 / 35)  # at 20 000 and 30 000 of 35 000 steps
SAMPLES_PER_RAY = 16  # times the protocol's rays: visible samples of a step
FIRST_SAMPLES_PER_RAY = 256  # expected before anything is learnt
LEAST_TRANSMITTANCE = 1e-4
PIECE = 32  # samples of a ray read at once before it is asked whether it goes on


class InstantNGP(Baseline):
    """`rays` of the setup, times 16: visible samples of a step; a step has as many rays as give them."""

    chunk = 8192

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self.grid = HashGrid(hash_levels(), setup.device)
        self.geometry = MLP(self.grid.width, GEOMETRY, WIDTH, layers=2)
        self.color = MLP(GEOMETRY + 16, 3, WIDTH, layers=3)
        self.dtype = compute_dtype("auto", setup.device)
        settings = SamplingConfig(
            resolution=CELLS,
            pdf="uniform",
            importance="none",
            bins_per_cell=(4.0 if setup.contracted else 2.0) / (CELLS * STEP),
        )
        self.samples = setup.rays * SAMPLES_PER_RAY
        self.rays = max(self.samples // FIRST_SAMPLES_PER_RAY, 16)
        self.occupancy = NGPOccupancy(settings, setup.contracted, self.samples)
        self.to(setup.device)
        self.optimizer = torch.optim.Adam(self.network_parameters(), RATE, BETAS, EPSILON, weight_decay=NETWORK_DECAY)

    def network_parameters(self) -> list[nn.Parameter]:
        return [p for name, p in self.named_parameters() if not name.startswith("grid.")]

    def parameter_count(self) -> int:
        return self.grid.parameter_count() + sum(p.numel() for p in self.network_parameters())

    def raw(self, points: torch.Tensor) -> torch.Tensor:
        """The density network's output (N, 16) at points (N, 3) in [0, 1]³."""
        return self.geometry(self.grid(points), self.dtype).float()

    @torch.no_grad()
    def density(self, points: torch.Tensor) -> torch.Tensor:
        return torch.exp(self.raw(points)[:, 0].clamp(max=15))

    def march(self, rays: Rays, jitter: torch.Tensor | None) -> Samples:
        """One sample in every occupied step of the rays."""
        grid = self.occupancy
        settings = replace(grid.march_settings(), per_bin=1.0)
        origins, directions = rays.origins.contiguous(), rays.directions.contiguous()
        return sample(origins, directions, grid.cells, grid.skip_distance, settings, MOST_SAMPLES, jitter)

    @torch.no_grad()
    def visible(self, samples: Samples) -> Samples:
        """The samples up to where a ray's transmittance falls below `LEAST_TRANSMITTANCE`; what lies behind is not read."""
        info, least = samples.packed_info, -math.log(LEAST_TRANSMITTANCE)
        kept = torch.zeros(len(samples), dtype=torch.bool, device=samples.t.device)
        rays = torch.arange(len(info.counts), device=kept.device)
        depth = torch.zeros(len(rays), device=kept.device)
        along = torch.arange(PIECE, device=kept.device)
        while True:
            rays = rays[(info.counts[rays] > along[0]) & (depth[rays] < least)]
            if len(rays) == 0:
                break
            exists = along < info.counts[rays, None]
            indices = (info.starts[rays, None] + along)[exists]
            optical = torch.zeros(exists.shape, device=kept.device)
            with self.network():
                optical[exists] = self.density(samples.points[indices]) * samples.deltas[indices]
            behind = depth[rays, None] + optical.cumsum(1)
            kept[indices] = (behind - optical)[exists] < least
            depth[rays] = behind[:, -1]
            along = along + PIECE
        indices, packed = info.subset(kept)
        return replace(
            samples,
            points=samples.points[indices],
            t=samples.t[indices],
            deltas=samples.deltas[indices],
            packed_info=packed,
        )

    def composite(self, rays: Rays, samples: Samples, semantics: bool) -> tuple[Rendered, torch.Tensor | None]:
        """What the rays show; composited logits (R, K) or None."""
        info = samples.packed_info
        with self.network():
            raw = self.raw(samples.points)
            density = torch.exp(raw[:, 0].clamp(max=15))
            views = spherical_harmonics(rays.directions)[info.ray_indices.long()]
            color = torch.sigmoid(self.color(torch.cat([raw, views], 1), self.dtype).float())
            logits = self.logits(samples.points, raw) if semantics else None
        weights = render_weights(density, samples.deltas, info)
        ones = torch.ones_like(samples.t)
        summed = weighted_sum(torch.cat([color, ones[:, None], samples.t[:, None]], 1), weights, info)
        labelled = None if logits is None else weighted_sum(logits, weights, info)
        return Rendered(summed[:, :3], summed[:, 3], summed[:, 4]), labelled

    def logits(self, points: torch.Tensor, raw: torch.Tensor) -> torch.Tensor | None:
        """Logits (N, K) of samples; None: this method has no classes."""
        return None

    def label_loss(self, logits: torch.Tensor | None, batch: Batch) -> torch.Tensor | float:
        return 0.0

    def train_step(self, batch: Batch, rays: Rays, progress: float, generator: torch.Generator) -> float:
        if self.steps % UPDATE_EVERY == 0:
            self.occupancy.refresh(self.steps, self.density, generator)
        jitter = torch.rand(len(rays), device=self.setup.device, generator=generator)
        samples = self.visible(self.march(rays, jitter))
        self.steps += 1
        if len(samples) == 0:
            return float(((self.setup.background - self.target(batch)) ** 2).mean())
        self.adapt(len(rays), len(samples))
        rendered, logits = self.composite(rays, samples, True)
        mse = ((self.behind(rendered.color, rendered.opacity) - self.target(batch)) ** 2).mean()
        self.optimizer.zero_grad(set_to_none=True)
        (mse + self.label_loss(logits, batch)).backward()
        factor = DECAY ** sum(progress >= milestone for milestone in MILESTONES)
        for group in self.optimizer.param_groups:
            group["lr"] = RATE * factor
        self.optimizer.step()
        self.grid.step(RATE * factor * bias_correction(self.steps, *BETAS), BETAS, EPSILON)
        return mse.item()

    def adapt(self, rays: int, samples: int) -> None:
        """Let the next step have as many rays as give the same number of samples."""
        wanted = round(self.samples * rays / max(samples, 1))
        self.rays = int(min(max(wanted, rays // 2, 16), rays * 2, 32768))

    @torch.no_grad()
    def render(self, rays: Rays, semantics: bool = True) -> Rendered:
        rendered, logits = self.composite(rays, self.visible(self.march(rays, None)), semantics)
        if logits is None:
            return rendered
        probabilities = logits.softmax(1) * rendered.opacity[:, None]
        return Rendered(rendered.color, rendered.opacity, rendered.depth, probabilities)
