"""Everything that is learned about one scene, and how rays are rendered with it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import torch
from torch import nn

from ..config import RunConfig
from ..field.encoding import spherical_harmonics
from ..field.environment import Environment, EnvironmentRays
from ..field.hybrid import Geometry, HybridField
from ..field.slices import read_in_slices
from ..geometry.contraction import grid_position
from ..kernels.composite import render_weights, weighted_sum
from ..kernels.device import backend_of
from ..kernels.march import Samples, sample
from ..kernels.packed_info import PackedInfo
from ..sampling.occupancy import OccupancyGrid, class_importance
from ..sampling.render_grid import (
    FineDensity,
    RenderGrid,
    largest_factor,
    met_cells,
    present_grid,
    read_fine,
    refined_grid,
    worth_reading,
)
from .kept_grid import KeptGrid

# Factor (N,) of the density of samples, from what the field knows of them.
Thin = Callable[[Geometry, Samples], torch.Tensor]
ONE_PASS_SHARE = 0.67  # of visible samples: 3k + 1 against 3 forward costs, equal at k = 2/3 (see `render`)
# Not tuned: the next three.
FEW = 0.05  # of the cells that a picture needs: so many are not worth another grid
CAPACITY_FACTOR = 1.6  # entries for visible samples, as a multiple of how many there were lately
LEAST_CAPACITY = 1 / 16  # of all samples, or nothing would be visible ever again after a while in which nothing was


@dataclass(frozen=True)
class Rendered:
    """Of R rays: color (R, 3) without background, opacity (R,), depth (R,) expected distance (normalised units, not
    divided by opacity), probabilities (R, K) or None; environment: what is behind the field, None where the model has
    none; of the visible samples: weights (N,), density (N,), packed as
    in `samples`; of all M samples the field was evaluated at: `evaluated_points` (M, 3) in grid coordinates and
    `evaluated_density`, −1 where an entry is unused; visible (): number of samples worth shading, also of the rays that
    were left out for want of capacity.
    """

    color: torch.Tensor
    opacity: torch.Tensor
    depth: torch.Tensor
    probabilities: torch.Tensor | None
    environment: EnvironmentRays | None
    weights: torch.Tensor
    density: torch.Tensor
    samples: Samples
    evaluated_points: torch.Tensor
    evaluated_density: torch.Tensor
    visible: torch.Tensor

    @property
    def evaluated(self) -> int:
        """Number of entries at which the field was evaluated; with a fixed capacity some of them are unused."""
        return len(self.evaluated_density)


def _where_used(samples: Samples, values: torch.Tensor, otherwise: float) -> torch.Tensor:
    """Values (N,) of samples, and another one where an entry is unused."""
    return torch.where(samples.packed_info.ray_indices < 0, otherwise, values)


class Model(nn.Module):
    """The hybrid field with its occupancy grid.

    Args:
        config: all settings of the run.
        classes: number of classes; 0 without semantics.
        images: number of training images.
        contracted: the grid covers all of space.
        seen, unknown: (resolution³,) bool or None, see OccupancyGrid.
        priorities: (K,) class priorities for the sampling PDF.
    """

    def __init__(
        self,
        config: RunConfig,
        classes: int,
        images: int,
        contracted: bool,
        seen: torch.Tensor | None = None,
        priorities: torch.Tensor | None = None,
        unknown: torch.Tensor | None = None,
    ) -> None:
        super().__init__()
        self.config = config
        self.environment = Environment() if config.scene.background == "environment" else None
        thinning = self.environment is not None and contracted
        self.field = HybridField(config.field, classes, images, thinning)
        self.occupancy = OccupancyGrid(config.sampling, contracted, seen, unknown)
        self.register_buffer("priorities", torch.ones(max(classes, 1)) if priorities is None else priorities)
        self.priorities: torch.Tensor
        self.warming_up = False
        self.labelled = 1.0  # share of the training pixels that have a label
        self.register_buffer("visible_share", torch.ones(()))
        self.visible_share: torch.Tensor
        self._fine: FineDensity | None = None
        self._refined: RenderGrid | None = None
        self.kept_grid: KeptGrid | None = None  # where the finer grid of a finished field is kept
        # What is differentiated has a fixed capacity, so that the host need not wait for the number of samples; None:
        # where the backend wants it.
        self.fixed_capacity: bool | None = None
        self.host_visible_share = 1.0  # `visible_share` as the host last read it

    def has_fixed_capacity(self) -> bool:
        """Whether `render` reads nothing back from the device where it keeps gradients."""
        return backend_of(self.priorities.device).fixed_capacity if self.fixed_capacity is None else self.fixed_capacity

    def fixed_shares(self) -> tuple[bool, float]:
        """Whether gradients take two passes, and which share of the samples has room for the visible ones: in sixteenths,
        so that it stays the same for many steps."""
        share = CAPACITY_FACTOR * self.host_visible_share
        padded = math.ceil(share / LEAST_CAPACITY) * LEAST_CAPACITY
        return self.host_visible_share < ONE_PASS_SHARE, min(1.0, max(LEAST_CAPACITY, padded))

    def refresh(self) -> None:
        """Read back how many of the samples are visible."""
        self.host_visible_share = float(self.visible_share)

    @property
    def device(self) -> torch.device:
        return self.priorities.device

    @property
    def contracted(self) -> bool:
        return self.occupancy.contracted

    def importance(self, points: torch.Tensor) -> torch.Tensor:
        """Importance (N,) of points (N, 3) for the sampling PDF."""
        kind = "literal" if self.config.sampling.pdf == "literal" else self.config.sampling.importance
        probabilities = self.field.class_probabilities(self.field.geometry(points))
        return class_importance(probabilities, kind, self.priorities)

    def wants_importance(self) -> bool:
        """Whether reading classes would change where samples go."""
        s = self.config.sampling
        if self.field.semantic_head is None or s.pdf == "uniform":
            return False
        if s.pdf == "literal":
            return True
        flat = bool((self.priorities == self.priorities[0]).all())
        return s.beta > 0 and (s.importance == "boundary" or (s.importance == "priority" and not flat))

    def refine(
        self,
        pixels: float = math.inf,
        check: Callable[[], None] | None = None,
        rays: Iterable[tuple[torch.Tensor, torch.Tensor]] | None = None,
        everywhere: bool = False,
    ) -> None:
        """Render from now on with a finer grid where it has been kept or pays for so many pixels. Training leaves it
        behind: for fields that are finished.

        `rays`: some of those of the pictures to come, as origins and directions (R, 3); only what they meet is read.
        None: all cells where training rays had weight. `everywhere`: also the others, for those who ask which cells
        hide others; never kept.
        """
        occupancy = self.occupancy
        factor = largest_factor(occupancy.config.resolution, self.config.render.refine)
        if factor == 1:
            return
        if everywhere:
            cells = (occupancy.cells[:, 0] > 0).nonzero()[:, 0]
            self._use(read_fine(occupancy, self.field.density, factor, cells, check))
            return
        if self._fine is None and self.kept_grid is not None:
            kept = self.kept_grid.load(factor, self.device)
            if kept is not None:
                self._use(kept)
        wanted = occupancy.cells[:, 0] > 0
        shown = None if self.field.blend is None else self.field.blend.shown(occupancy.config.resolution)
        for part in (shown, None if rays is None else met_cells(occupancy, rays)):
            wanted = wanted if part is None else wanted & part
        needed = int(wanted.sum())
        if self._fine is not None:
            wanted[self._fine.coarse.long()] = False
        cells = wanted.nonzero()[:, 0]
        enough = self._fine is not None and len(cells) <= FEW * needed
        if enough or not worth_reading(len(cells), factor, pixels):
            return
        fine = read_fine(occupancy, self.field.density, factor, cells, check)
        fine = fine if self._fine is None else self._fine.with_more(fine)
        if self.kept_grid is not None:
            self.kept_grid.save(factor, fine)
        self._use(fine)

    def _use(self, fine: FineDensity) -> None:
        """Render with what was read in finer cells."""
        self._fine, self._refined = fine, refined_grid(self.occupancy, fine, self.config.render.per_bin)

    @property
    def label_pull(self) -> float:
        """Factor of the gradient that labels have in the geometry: the labelled share of the pixels, so that each label
        counts as if all pixels had one; else the few there are would bend the geometry to their photos."""
        return 0.0 if self.config.loss.detach_weights else self.labelled

    def render_grid(self) -> RenderGrid:
        """What the rays of a picture traverse."""
        return self._refined or present_grid(self.occupancy, self.config.render.per_bin)

    def render(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        samples_per_ray: int,
        jitter: torch.Tensor | None = None,
        shift: torch.Tensor | None = None,
        codes: torch.Tensor | None = None,
        semantics: bool = True,
        grid: RenderGrid | None = None,
        capacity: int | None = None,
        thin: Thin | None = None,
        ends: torch.Tensor | None = None,
    ) -> Rendered:
        """Render rays (R, 3) of the normalised frame; differentiable in the field.

        `grid`: what the rays traverse, by default the occupancy grid, as in training; `jitter`, `shift`: see
        kernels.march.sample; `codes` (R, A): appearance code of each ray; `capacity`: the most rays that get samples
        where the capacity is fixed, all when None; `thin`: what of the density is shown, where not all; `ends` (R,): distances
        at which rays end.
        """
        grid = grid or present_grid(self.occupancy, 0.0)
        learning = torch.is_grad_enabled()
        fixed = learning and self.has_fixed_capacity()
        if not fixed:
            self.refresh()
        # Where many samples turn out invisible, a first pass without gradients finds the others, and only those are
        # differentiated; where nearly all are visible, one pass is cheaper (3k + 1 against 3 forward costs at share k).
        two_passes = learning and self.fixed_shares()[0]
        capacity = min(len(origins), capacity or len(origins))
        samples, points = self._sample(
            origins, directions, grid, samples_per_ray, jitter, shift, capacity if fixed else None, ends
        )
        if not learning and thin is None and isinstance(self.field, HybridField) and self.field.on_host(points.device):
            cull = self.config.render.cull
            geometry, weights = self.field.weighted_on_host(points, samples.deltas, samples.packed_info, cull)
        else:
            with torch.set_grad_enabled(learning and not two_passes):
                geometry, weights = self._weighted(points, samples, thin=thin)
        evaluated_density = geometry.density.detach()
        indices, visible, visible_count = self._select_visible(samples, weights, fixed)
        if two_passes:
            explicit = geometry.explicit.index_select(0, indices) if geometry.explicit is not None else None
            geometry, weights = self._weighted(points.index_select(0, indices), visible, explicit, thin)
            density, chosen = geometry.density, None
        else:
            density, weights = geometry.density.index_select(0, indices), weights.index_select(0, indices)
            chosen = indices
        if fixed:  # unused entries count for nothing
            density = _where_used(visible, density, 0.0)
            weights = weights if two_passes else _where_used(visible, weights, 0.0)
            evaluated_density = _where_used(samples, evaluated_density, -1.0)
        color, classes = self._shade(geometry, chosen, visible.packed_info, directions, codes, semantics)
        values = torch.cat([color, torch.ones_like(weights)[:, None], visible.t[:, None]], 1)
        summed = weighted_sum(values, weights, visible.packed_info)
        probabilities = None if classes is None else self._probabilities(classes, weights, visible.packed_info)
        environment = self._environment(directions, summed[:, 3], visible.packed_info, codes, semantics)
        shaded = (summed[:, :3], summed[:, 3], summed[:, 4], probabilities, environment)
        return Rendered(*shaded, weights, density, visible, samples.points, evaluated_density, visible_count)

    def _sample(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        grid: RenderGrid,
        samples_per_ray: int,
        jitter: torch.Tensor | None,
        shift: torch.Tensor | None,
        capacity: int | None,
        ends: torch.Tensor | None,
    ) -> tuple[Samples, torch.Tensor]:
        """Samples of the rays, and their points (N, 3) in grid coordinates as functions of the rays."""
        samples = sample(
            origins,
            directions,
            grid.cells,
            grid.skip_distance,
            grid.settings,
            samples_per_ray,
            jitter,
            shift,
            capacity,
            ends,
        )
        if not origins.requires_grad:
            return samples, samples.points
        ray_indices = samples.packed_info.ray_indices.long()  # pose refinement: samples move with their ray
        positions = origins[ray_indices] + directions[ray_indices] * samples.t[:, None]
        return samples, grid_position(positions, self.contracted).clamp(0, 1)

    def _weighted(
        self,
        points: torch.Tensor,
        samples: Samples,
        explicit: torch.Tensor | None = None,
        thin: Thin | None = None,
    ) -> tuple[Geometry, torch.Tensor]:
        """Geometry at the points (N, 3) of samples and their rendering weights (N,); `explicit`: features of the grid
        there, where they are known already."""
        geometry = self.field.geometry(points, explicit)
        if thin is not None:
            geometry = replace(geometry, density=geometry.density * thin(geometry, samples))
        return geometry, render_weights(geometry.density, samples.deltas, samples.packed_info)

    @torch.no_grad()
    def _select_visible(
        self, samples: Samples, weights: torch.Tensor, fixed: bool
    ) -> tuple[torch.Tensor, Samples, torch.Tensor]:
        """Indices (M,) of the samples whose rendering weight (N,) is worth shading, those samples, and how many would
        be there if the capacity were unlimited ()."""
        capacity, kept = None, weights > self.config.render.cull
        if fixed:
            capacity = math.ceil(len(samples) * self.fixed_shares()[1])
        indices, packed_info = samples.packed_info.subset(kept, capacity)
        t, deltas = samples.t.index_select(0, indices), samples.deltas.index_select(0, indices)
        visible = Samples(
            samples.points.index_select(0, indices), t, deltas, packed_info, samples.t_first, samples.t_last
        )
        return indices, visible, kept.sum()

    def _shade(
        self,
        geometry: Geometry,
        chosen: torch.Tensor | None,
        packed_info: PackedInfo,
        directions: torch.Tensor,
        codes: torch.Tensor | None,
        semantics: bool,
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Colour (N, 3) and what is accumulated of classes (N, K), or None without semantics, of the samples that
        `packed_info` packs: the rows `chosen` of `geometry`, or all of them."""
        # Per ray first: a ray's samples share direction and code.
        harmonics = spherical_harmonics(directions).to(self.field.dtype)
        ray_indices = packed_info.ray_indices.long()
        if not torch.is_grad_enabled() and isinstance(self.field, HybridField) and self.field.on_host(self.device):
            assert chosen is not None  # two passes are made for gradients only
            classes = self.config.render.accumulate if semantics else None
            return self.field.shaded_on_host(geometry, chosen, harmonics, ray_indices, codes, classes)

        def shade(rays: torch.Tensor, rows: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor | None]:
            part = geometry if rows is None else geometry[rows]
            # Half the time of indexing with brackets, forward and backward; unused entries get the first ray.
            rays = rays.clamp(min=0)
            shown = harmonics.index_select(0, rays), None if codes is None else codes.index_select(0, rays)
            color = self.field.color(part, *shown)
            if not semantics or self.field.semantic_head is None:
                return color, None
            summed = self.config.render.accumulate == "probabilities"
            return color, self.field.class_probabilities(part) if summed else self.field.logits(part)

        if torch.is_grad_enabled():
            return shade(ray_indices, chosen)
        assert chosen is not None  # two passes are made for gradients only
        return read_in_slices(shade, ray_indices, chosen)  # type: ignore[return-value]

    def _environment(
        self,
        directions: torch.Tensor,
        opacity: torch.Tensor,
        packed_info: PackedInfo,
        codes: torch.Tensor | None,
        semantics: bool,
    ) -> EnvironmentRays | None:
        """What is behind the field where it has this opacity (R,); `packed_info` packs the visible samples."""
        if self.environment is None:
            return None
        if not torch.is_grad_enabled():
            return self.environment.visible_rays(self.field, directions, opacity, self.config.render.cull, semantics)
        weight = 1 - opacity
        if packed_info.left_out is not None:  # what they show was not read
            weight = weight * ~packed_info.left_out
        return self.environment.rays(self.field, directions, weight, codes, semantics)

    @torch.no_grad()
    def observe(self, rendered: list[Rendered]) -> None:
        """Let the occupancy grid see what a training step read, and note how much of it was visible."""
        points = torch.cat([r.evaluated_points for r in rendered])
        density = torch.cat([r.evaluated_density for r in rendered])
        self.occupancy.observe(points, density, self.warming_up)
        visible = torch.stack([r.visible for r in rendered]).sum()
        self.visible_share += 0.05 * (visible / (density >= 0).sum().clamp(min=1) - self.visible_share)

    def _probabilities(self, classes: torch.Tensor, weight: torch.Tensor, packed_info: PackedInfo) -> torch.Tensor:
        pull = self.label_pull
        weight = torch.lerp(weight.detach(), weight, pull) if pull > 0 else weight.detach()
        if self.config.render.accumulate == "probabilities":
            return weighted_sum(classes, weight, packed_info)
        total = weighted_sum(torch.cat([classes, torch.ones_like(weight)[:, None]], 1), weight, packed_info)
        return torch.softmax(total[:, :-1], 1) * total[:, -1:]
