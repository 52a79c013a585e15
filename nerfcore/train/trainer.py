"""The optimisation loop: one `step` at a time, everything it needs in one object that can be saved and restored."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial

import torch

from ..config import RunConfig
from ..data.pixels import VOID, Batch, PixelStore
from ..errors import TrainingError
from ..kernels.device import backend_of
from ..kernels.runtime import run_parallel, worker_count
from ..render.model import Model, Rendered
from ..sampling.cache import CoarseCache
from ..sampling.known_space import KnownSpace
from ..sampling.outlines import Outlines
from .composite_loss import composite_loss
from .depth import DepthRays, depth_loss
from .gradients import GradientGuard, only_finite
from .losses import label_weights, sparsity_loss
from .pose_refinement import PoseRefinement, level_weights
from .replay import CudaRecording, Replay, asked_mode
from .results import Learned, Measured, ShardResult
from .schedule import bias_correction, padded_capacity, rate_factor, sample_budget
from .sky_stage import SkyStage
from .voxel_init import PixelFeatures, initialise

BETAS = (0.9, 0.99)
HEADROOM = 1.25  # capacity for samples, as a multiple of a step's budget of them; not tuned
NOT_FINITE_READINGS = 8  # in a row, of gradients that are not finite, until training is given up
STEADY = 0.1  # change of the number of rays that is not worth another recording of steps; not tuned
SHARD_SAMPLES = 12288  # measured: docs/experiments.md, “How many shards does a CPU step need?”


class Trainer:
    """Trains a `Model` on a `PixelStore`.

    Progress through the schedule is a number in [0, 1] handed to `step`, so that a time limit and a number of steps
    drive it alike. All random numbers come from one generator, which is part of the checkpoint. `background`: the grey
    value behind the field, None for random colours. `check` is called in steps that take long and may raise to stop.
    """

    def __init__(
        self,
        model: Model,
        store: PixelStore,
        config: RunConfig,
        background: float | None,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        self.model, self.store, self.config = model, store, config
        self.background = background
        model.labelled = store.labelled_share()
        self.device = store.device
        self.backend = backend_of(self.device)
        self.optimizer = torch.optim.Adam(
            model.parameters(), config.train.network_rate, betas=BETAS, eps=1e-15, fused=self.backend.fused_optimizer
        )
        # docs/experiments.md, “Colours that begin without directions”
        model.field.forget_directions()
        self.guard = GradientGuard(model.field.dtype, self.device)
        self.generator = torch.Generator(self.device).manual_seed(config.train.seed)
        self.steps = 0
        self.largest_batch: int | None = None  # samples of the last steps, where time is too short for the setting's
        self.rays = max(16, min(config.train.max_rays, config.train.batch_start // config.sampling.samples))
        self.cache = CoarseCache(store)
        self.poses = PoseRefinement(store.rays, config.train) if config.train.refine_poses else None
        self.depths: DepthRays | None = None
        self.sky: SkyStage | None = None  # when the environment may be behind the sky alone
        self.space: KnownSpace | None = None  # what the photos show, if that was asked
        self.check = check
        semantic = config.loss.semantic_weight > 0 and config.sampling.outline_rays > 0
        self.outlines = Outlines(store, config.sampling.outline_rays) if semantic else None
        self.pixel_features: PixelFeatures | None = None
        self.measured = Measured()
        # Of the steps since the host last asked the device: samples evaluated and rays dropped (2,), and rays drawn.
        self.counted = torch.zeros(2, device=self.device)
        self.drawn = 0
        self._not_finite = 0  # readings in a row that told of gradients that are not finite
        recorded = self.backend.name == "warp-cuda"
        recorder = partial(CudaRecording, device=self.device, generator=self.generator) if recorded else None
        self.replay: Replay[Learned] = Replay(recorder, asked_mode())

    def _refresh_cache(self) -> None:
        s = self.config.sampling
        if self.store.usable is not None:
            return  # it draws from the usable pixels alone, wherever they are
        if s.coarse_cache and self.steps >= s.warmup and (self.steps - s.warmup) % s.cache_every == 0:
            self.cache.rebuild(self.model)

    def draw(self) -> Batch:
        """Rays of this step: from image tiles that met the field, and some from everywhere."""
        s = self.config.sampling
        count = round(self.rays * self.outlines.share) if self.outlines is not None else 0
        pixel_indices = self.cache.draw(self.rays - count, s.empty_rays, self.generator)
        if self.outlines is not None and count > 0:
            pixel_indices = torch.cat([pixel_indices, self.outlines.draw(count, self.generator)])
        if self.model.has_fixed_capacity():
            # Where the capacity does not last, the last rays are dropped: they must not be of one kind.
            order = torch.randperm(len(pixel_indices), device=self.device, generator=self.generator)
            pixel_indices = pixel_indices[order]
        if self.outlines is not None and count > 0:
            return replace(self.store.batch(pixel_indices), weight=self.outlines.weight(pixel_indices))
        return self.store.batch(pixel_indices)

    def step(self, progress: float) -> None:
        """One optimisation step at `progress` in [0, 1] of the schedule."""
        config, model = self.config, self.model
        model.field.set_progress(progress, config.train.fade, self.steps)
        if self.replay.active and model.field.grid is not None:
            model.field.grid.keep_gains(model.field.gains)
        model.warming_up = self.steps < config.sampling.warmup
        if config.field.voxel_init != "none" and self.steps == config.field.voxel_init_step:
            self._initialise(progress)
        if self.steps % config.sampling.update_every == 0:
            importance = model.importance if model.wants_importance() and self.steps >= config.sampling.warmup else None
            model.occupancy.update(self.steps, model.field.density, importance, self.generator)
            self._ask_device(progress)
        self._refresh_cache()
        start = config.train.pose_start
        moving = self.poses if progress >= start else None
        if moving is not None and model.field.grid is not None:
            model.field.grid.point_gains = level_weights(config.field.levels, progress)
        key = self._key(progress) if moving is None else None
        learned = self.replay.run(key, partial(self._learn_and_observe, progress, moving))
        self._take(learned)
        batch, shards = learned.batch, learned.shards
        if moving is not None:
            moving.step([part.rays for part in shards if part.rays], (progress - start) / (1 - start))
        self.steps += 1
        factor = rate_factor(progress, config.train.decay)
        for group in self.optimizer.param_groups:
            group["lr"] = config.train.network_rate * factor
        self.guard.step(self.optimizer)
        self.guard.update()
        if model.field.grid is not None:
            model.field.grid.step(config.train.grid_rate * factor * bias_correction(self.steps, *BETAS), BETAS)
        rendered = learned.rendered
        if model.environment is not None and batch.label.numel():
            # Rays of known length, which are rendered as well, come after those of the batch.
            behind = [r.environment.weight for r in rendered if r.environment is not None]
            weight = torch.cat(behind)[: len(batch.label)]
            if self.sky is not None:
                self.sky.observe(batch, weight.detach())
            if batch.sky is not None:
                weight = weight * batch.sky
            model.environment.observe(weight, batch.label != VOID, model.labelled)
        if model.field.blend is not None and self.steps % config.sampling.update_every == 0:
            model.field.blend.update(
                torch.cat([r.samples.points for r in rendered]),
                torch.cat([r.weights.detach() for r in rendered]),
                torch.cat([r.density.detach() for r in rendered]),
            )
        self._adapt(len(batch.rgb), rendered, progress)

    def _initialise(self, progress: float) -> None:
        """Let the grid take up what the photos show, see `voxel_init`."""
        measured, self.measured = self.measured, Measured()

        def learn() -> None:
            self._refresh_cache()
            self._take(self._learn(progress))

        self.pixel_features = initialise(self.model, self.store, learn, self.check)
        self.measured = measured

    def _key(self, progress: float) -> Hashable:
        """All that the host tells `_learn_and_observe`, which is recorded; None where that reads back from the device or from the host's memory."""
        model, c, store = self.model, self.config, self.store
        if not self.replay.active or not model.has_fixed_capacity() or store.home != self.device:
            return None
        blend, hit = model.field.blend, self.cache.hit
        return (
            (self.rays, self._capacity(progress, 1), *model.fixed_shares()),
            (model.warming_up, None if blend is None else blend.warming_up),
            (self.steps < c.loss.rgb_warmup, progress >= c.loss.entropy_start, progress >= c.loss.distortion_start),
            self.sky is not None and self.sky.masked(progress),
            (None if hit is None else (hit.data_ptr(), len(hit)), model.occupancy.march_settings()),
            0 if self.depths is None else len(self.depths),
        )

    def _learn_and_observe(self, progress: float, moving: PoseRefinement | None = None) -> Learned:
        """`_learn`; and the occupancy grid and the counters take in what was rendered."""
        learned = self._learn(progress, moving)
        self.model.observe(learned.rendered)
        if self.model.has_fixed_capacity():
            # How many entries were used only the device knows; `_ask_device` reads it.
            dropped = [r.samples.packed_info.dropped for r in learned.rendered]
            self.counted[0] += sum((r.evaluated_density >= 0).sum() for r in learned.rendered)
            self.counted[1] += sum(d for d in dropped if d is not None)
        return learned

    def _learn(self, progress: float, moving: PoseRefinement | None = None) -> Learned:
        """Gradients of the composite loss of rays drawn here, summed in the order of the shards; only the grid's, and the
        random numbers, are changed."""
        batch = self.draw() if moving is None else moving.move(self.draw())
        if self.sky is not None:
            batch = self.sky.limited(batch, progress)
        tasks = self._shard_tasks(batch, progress)
        if self.config.loss.regularization * self.config.loss.sparsity_weight > 0:
            tasks.append(self._sparsity_task())
        if self.depths is not None and len(self.depths):
            tasks.append(self._depth_task(self.depths))
        shards = run_parallel(tasks, self.device)
        gradients: list[torch.Tensor | None] = []
        for parts in zip(*(part.gradients for part in shards)):
            present = [g for g in parts if g is not None]
            gradients.append(self.guard.unscaled(torch.stack(present).sum(0)) if present else None)
        grid = self.model.field.grid
        if grid is not None:
            encoded = [(points, self.guard.unscaled(g)) for part in shards for points, g in part.encoded]
            grid.scatter(encoded, self.model.field.gains)
        loss, error = (torch.stack(list(values)).sum() for values in zip(*((p.loss, p.squared_error) for p in shards)))
        finite = self.guard.inspected([g for g in gradients if g is not None]) & torch.isfinite(loss)
        return Learned(batch, shards, gradients, finite, loss, error)

    def _take(self, learned: Learned) -> None:
        """Leave gradients in the parameters, where the optimiser finds them."""
        for parameter, gradient in zip(self.model.parameters(), learned.gradients):
            parameter.grad = gradient
        self.guard.finite = learned.finite
        self.measured.loss += torch.where(learned.finite, learned.loss, 0.0)
        self.measured.mse += torch.where(learned.finite, learned.squared_error, 0.0)
        self.measured.finite += learned.finite.int()

    def _shard_tasks(self, batch: Batch, progress: float) -> list[Callable[[], ShardResult]]:
        """Tasks that learn from the rays of a batch.

        The CPU works on shards of the rays side by side, few enough that threads do not wait for each other's interpreter
        lock; a shard's loss is its part of the whole batch's loss.
        """
        config, per_ray, rays = self.config, self.config.sampling.samples, len(batch.rgb)
        jitter = torch.rand(rays, device=self.device, generator=self.generator)
        shift = torch.rand(rays * per_ray, device=self.device, generator=self.generator)
        if self.background is None:
            background = torch.rand(batch.rgb.shape, device=self.device, generator=self.generator)
        else:
            background = torch.full_like(batch.rgb, self.background)
        background = batch.before(background)
        counted = label_weights(batch)
        labelled = counted.sum().clamp(min=1e-6)
        shard_count = 1
        if self.backend.host_threads:
            shard_count = max(2, min(worker_count(), self._budget(progress) // SHARD_SAMPLES))
        size = -(-rays // shard_count)
        capacity = self._capacity(progress, shard_count)
        squared = self.steps < config.loss.rgb_warmup

        def shard(begin: int) -> ShardResult:
            part = batch.part(slice(begin, begin + size))
            noise = jitter[begin : begin + size], shift[begin * per_ray : (begin + size) * per_ray]

            def loss() -> tuple[torch.Tensor, torch.Tensor, Rendered]:
                rendered = self._render(part, *noise, capacity)
                share = len(part.rgb) / rays, counted[begin : begin + size].sum() / labelled
                behind = background[begin : begin + size]
                terms = composite_loss(part, rendered, behind, progress, config.loss, self.model, share, squared)
                return *terms, rendered

            moved = (part.origins, part.directions) if part.origins.requires_grad else ()
            return self._differentiate(loss, moved)

        return [partial(shard, begin) for begin in range(0, rays, size)]

    def _sparsity_task(self) -> Callable[[], ShardResult]:
        """The task that keeps the density low at points drawn here."""
        c = self.config.loss
        points = torch.rand(1024, 3, device=self.device, generator=self.generator)

        def loss() -> tuple[torch.Tensor, torch.Tensor, None]:
            price = c.regularization * c.sparsity_weight * sparsity_loss(self.model.field.density(points), c)
            return price, torch.zeros_like(price), None

        return partial(self._differentiate, loss)

    def _depth_task(self, depths: DepthRays) -> Callable[[], ShardResult]:
        """The task that learns from some of the rays of known length, drawn here."""
        rays, per_ray = self.store.rays, self.config.sampling.samples
        cameras = rays.rotation, rays.center
        if self.poses is not None:
            moved = self.poses.poses(rays)
            cameras = moved[:, :3, :3], moved[:, :3, 3]
        origins, directions, distance, weight = depths.draw(*cameras, self.generator)
        jitter = torch.rand(len(origins), device=self.device, generator=self.generator)
        shift = torch.rand(len(origins) * per_ray, device=self.device, generator=self.generator)

        def loss() -> tuple[torch.Tensor, torch.Tensor, Rendered]:
            rendered = self.model.render(origins, directions, per_ray, jitter, shift, semantics=False)
            term = self.config.loss.depth_weight * depth_loss(rendered.depth, distance, weight)
            return term, torch.zeros_like(term), rendered

        return partial(self._differentiate, loss)

    def _differentiate(
        self,
        loss: Callable[[], tuple[torch.Tensor, torch.Tensor, Rendered | None]],
        rays: Sequence[torch.Tensor] = (),
    ) -> ShardResult:
        """Value and gradients of one part of the loss, without touching what other threads read; also those of
        `rays`, zero where the part met nothing."""
        grid = self.model.field.grid
        with grid.collecting() if grid is not None else nullcontext([]) as encoded:
            total, squared_error, rendered = loss()
            parameters = list(self.model.parameters())
            # The anchor stands for the grid, whose gradients are collected on the way to it.
            wanted = [*parameters, *rays] if grid is None else [*parameters, *rays, grid.anchor]
            # A part that met nothing has no gradient.
            gradients: Sequence[torch.Tensor | None] = [None] * len(wanted)
            if total.requires_grad:
                gradients = torch.autograd.grad(self.guard.scaled(total), wanted, allow_unused=True)
        own, moved = gradients[: len(parameters)], gradients[len(parameters) : len(parameters) + len(rays)]
        ray_gradients = [
            torch.zeros_like(ray) if g is None else only_finite(self.guard.unscaled(g)) for ray, g in zip(rays, moved)
        ]
        return ShardResult(own, encoded, total.detach(), squared_error.detach(), rendered, ray_gradients)

    def _render(self, batch: Batch, jitter: torch.Tensor, shift: torch.Tensor, capacity: int | None = None) -> Rendered:
        appearance, semantics = self.model.field.appearance, self.config.loss.semantic_weight > 0
        codes = appearance[batch.image] if appearance is not None else None
        per_ray = self.config.sampling.samples
        return self.model.render(
            batch.origins, batch.directions, per_ray, jitter, shift, codes, semantics, capacity=capacity
        )

    def _budget(self, progress: float) -> int:
        """Field samples of a step."""
        return sample_budget(self.config.train, progress, self.largest_batch)

    def _capacity(self, progress: float, shards: int) -> int:
        """Rays of a shard that may get samples where the capacity is fixed: what the budget is enough for, and some."""
        per_ray = self.config.sampling.samples
        samples = padded_capacity(HEADROOM * self._budget(progress), HEADROOM * self._budget(1.0))
        return max(16, math.ceil(samples / (per_ray * shards)))

    def _adapt(self, rays: int, rendered: list[Rendered], progress: float) -> None:
        """Keep the number of field samples a step near its budget, which grows with progress."""
        m = self.measured
        m.steps += 1
        m.rays += rays
        if self.model.has_fixed_capacity():
            self.drawn += rays
            return
        evaluated = sum(r.evaluated for r in rendered)
        m.samples += evaluated
        if self.steps % 8 == 0:
            self._set_rays(rays, evaluated / max(rays, 1), progress)

    def _set_rays(self, rays: int, per_ray: float, progress: float) -> None:
        """Let the next steps have as many rays as the budget is enough for, at most twice and at least half `rays`."""
        train = self.config.train
        wanted = self._budget(progress) / max(per_ray, 1 / max(rays, 1))
        self.rays = int(min(max(wanted, rays * 0.5, 16), rays * 2, train.max_rays))

    def _ask_device(self, progress: float) -> None:
        """Read back what the device counted, all at once: each reading makes the host wait.

        Raises:
            TrainingError: gradients have not been finite for long.
        """
        grid, m = self.model.field.grid, self.measured
        lost = self.counted.new_zeros(1) if grid is None else grid.lost.float()
        numbers = [self.counted, self.guard.skipped.view(1), lost, self.model.visible_share.view(1)]
        evaluated, dropped, skipped, lost_rows, visible_share = torch.cat(numbers).tolist()
        self.model.host_visible_share = visible_share
        m.samples += int(evaluated)
        m.dropped += int(dropped)
        if not self.guard.scaling:  # there some steps tell that the scale is too large
            m.skipped += int(skipped)
            m.lost_rows += int(lost_rows)
        if self.drawn > 0:
            before = self.rays
            self._set_rays(before, evaluated / self.drawn, progress)
            if self.replay.active and abs(self.rays - before) < STEADY * before:
                self.rays = before
        self.counted.zero_()
        self.guard.skipped.zero_()
        self.drawn = 0
        if grid is not None:
            grid.lost.zero_()
        self._not_finite = self._not_finite + 1 if skipped + lost_rows > 0 else 0
        if self._not_finite >= NOT_FINITE_READINGS:
            raise TrainingError(
                "Training diverged: gradients have not been finite for "
                f"{NOT_FINITE_READINGS * self.config.sampling.update_every} steps.",
                "Lower train.network_rate and train.grid_rate, or set field.precision to float32.",
            )

    def take_measured(self) -> Measured:
        """Averages since the last call."""
        taken, self.measured = self.measured, Measured()
        return taken
