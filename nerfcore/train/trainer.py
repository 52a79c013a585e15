"""The optimisation loop: one `step` at a time, everything it needs in one object that can be saved and restored."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..config import RunConfig
from ..data.pixels import VOID, Batch, PixelStore
from ..sampling.cache import CoarseCache
from .losses import (
    color_loss,
    distortion_loss,
    entropy_loss,
    opacity_entropy,
    psnr,
    semantic_loss,
    sparsity_loss,
)
from .model import Model, Rendered
from .schedule import bias_correction, rate_factor

BETAS = (0.9, 0.99)


@dataclass
class Measured:
    """What the last steps measured; `mse` and `loss` are averages since the last reading."""

    loss: float = 0.0
    mse: float = 0.0
    steps: int = 0
    rays: int = 0
    samples: int = 0
    shown: int = 0

    @property
    def psnr(self) -> float:
        return psnr(self.mse / max(self.steps, 1))


class Trainer:
    """Trains a `Model` on a `PixelStore`.

    Progress through the schedule is a number in [0, 1] handed to `step`, so that a time limit and a number of steps
    drive it alike. All random numbers come from one generator, which is part of the checkpoint.
    """

    def __init__(self, model: Model, store: PixelStore, config: RunConfig, random_background: bool) -> None:
        self.model, self.store, self.config = model, store, config
        self.random_background = random_background
        self.device = store.device
        self.optimizer = torch.optim.Adam(
            model.parameters(), config.train.network_rate, betas=BETAS, eps=1e-15, fused=self.device.type != "mps"
        )
        self.generator = torch.Generator(self.device).manual_seed(config.train.seed)
        self.steps = 0
        self.rays = max(16, min(config.train.max_rays, config.train.batch_start // config.sampling.samples))
        self.cache = CoarseCache(store)
        self.measured = Measured()

    def draw(self) -> Batch:
        """Rays of this step: from image tiles that met the field, and some from everywhere."""
        s = self.config.sampling
        if s.coarse_cache and self.steps >= s.warmup and (self.steps - s.warmup) % s.cache_every == 0:
            self.cache.rebuild(self.model)
        return self.store.batch(self.cache.places(self.rays, s.empty_rays, self.generator))

    def step(self, progress: float) -> None:
        """One optimisation step at `progress` in [0, 1] of the schedule."""
        config, model = self.config, self.model
        model.field.set_progress(progress, config.train.fade, self.steps)
        model.warming_up = self.steps < config.sampling.warmup
        if self.steps % config.sampling.update_every == 0:
            interest = model.interest if model.wants_interest() and self.steps >= config.sampling.warmup else None
            model.occupancy.update(self.steps, model.field.density, interest, self.generator)
        batch = self.draw()
        rays, per_ray = len(batch.rgb), config.sampling.samples
        jitter = torch.rand(rays, device=self.device, generator=self.generator)
        shift = torch.rand(rays * per_ray, device=self.device, generator=self.generator)
        codes = model.field.appearance[batch.image] if model.field.appearance is not None else None
        semantics = config.loss.semantic_weight > 0
        rendered = model.render(batch.origins, batch.directions, per_ray, jitter, shift, codes, semantics)
        loss = self.loss(batch, rendered, progress)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.steps += 1
        factor = rate_factor(progress, config.train.decay)
        for group in self.optimizer.param_groups:
            group["lr"] = config.train.network_rate * factor
        self.optimizer.step()
        if model.field.grid is not None:
            model.field.grid.step(config.train.grid_rate * factor * bias_correction(self.steps, *BETAS), BETAS)
        if model.field.blend is not None and self.steps % config.sampling.update_every == 0:
            s = rendered.samples
            model.field.blend.update(s.points, rendered.weights.detach(), rendered.density.detach())
        self._adapt(rays, rendered, progress)

    def loss(self, batch: Batch, rendered: Rendered, progress: float) -> torch.Tensor:
        """The composite loss of a batch."""
        c = self.config.loss
        background = torch.zeros_like(batch.rgb)
        if self.random_background:
            background = torch.rand(batch.rgb.shape, device=self.device, generator=self.generator)
        alpha = batch.alpha[:, None]
        target = batch.rgb * alpha + background * (1 - alpha)
        predicted = rendered.color + background * (1 - rendered.opacity[:, None])
        total = c.rgb_weight * color_loss(predicted, target, c)
        if rendered.probabilities is not None:
            valid = batch.label != VOID
            total = total + c.semantic_weight * semantic_loss(rendered.probabilities, batch.label, valid)
            if c.entropy_ratio > 0 and c.regularization > 0 and progress >= c.entropy_start:
                weight = c.regularization * c.entropy_ratio * c.semantic_weight
                total = total + weight * entropy_loss(rendered.probabilities, valid)
        if c.regularization > 0:
            total = total + c.regularization * self._regularizers(rendered)
        self.measured.loss += float(total.detach())
        self.measured.mse += float(((predicted.detach() - target) ** 2).mean())
        return total

    def _regularizers(self, rendered: Rendered) -> torch.Tensor:
        c, s = self.config.loss, rendered.samples
        total = rendered.opacity.sum() * 0
        if c.sparsity_weight > 0:
            points = torch.rand(1024, 3, device=self.device, generator=self.generator)
            total = total + c.sparsity_weight * sparsity_loss(self.model.field.density(points), c)
        if c.distortion_weight > 0:
            place = s.depth / (1 + s.depth) if self.model.contracted else s.depth
            extent = s.delta / (1 + s.depth) ** 2 if self.model.contracted else s.delta
            total = total + c.distortion_weight * distortion_loss(rendered.weights, place, extent, s.packing)
        if c.opacity_weight > 0:
            total = total + c.opacity_weight * opacity_entropy(rendered.opacity)
        return total

    def _adapt(self, rays: int, rendered: Rendered, progress: float) -> None:
        """Keep the number of field samples a step near its budget, which grows with progress: early on many small
        steps learn faster, later large batches average out the noise."""
        m, train = self.measured, self.config.train
        budget = round(train.batch_start * (train.batch_samples / train.batch_start) ** progress)
        m.steps += 1
        m.rays += rays
        m.samples += rendered.evaluated
        m.shown += len(rendered.samples)
        if self.steps % 8 == 0:
            wanted = rays * budget / max(rendered.evaluated, 1)
            self.rays = int(min(max(wanted, rays * 0.5, 16), rays * 2, train.max_rays))

    def take_measured(self) -> Measured:
        """Averages since the last call."""
        taken, self.measured = self.measured, Measured()
        return taken
