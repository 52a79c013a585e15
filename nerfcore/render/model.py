"""Everything that is learned about one scene, and how rays are rendered with it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import nn

from ..config import RunConfig
from ..field.encoding import spherical_harmonics
from ..field.hybrid import HybridField
from ..geometry.contraction import grid_position
from ..kernels.composite import render_weights, weighted_sum
from ..kernels.march import Samples, sample
from ..sampling.occupancy import OccupancyGrid, class_interest
from ..sampling.render_grid import RenderGrid, present_grid, refined_grid

ONE_PASS_SHARE = 0.67
ROOM = 1.6  # places for samples that show, as a multiple of how many did lately


@dataclass(frozen=True)
class Rendered:
    """Of R rays: color (R, 3) without background, opacity (R,), depth (R,) expected distance (normalised units, not
    divided by opacity), probabilities (R, K) or None; of the samples that show: weights (N,), density (N,), packed as
    in `samples`; of all M samples the field was read at: `read_points` (M, 3) in grid coordinates and `read_density`,
    −1 where a place is unused.
    """

    color: torch.Tensor
    opacity: torch.Tensor
    depth: torch.Tensor
    probabilities: torch.Tensor | None
    weights: torch.Tensor
    density: torch.Tensor
    samples: Samples
    read_points: torch.Tensor
    read_density: torch.Tensor

    @property
    def evaluated(self) -> int:
        """Number of places at which the field was evaluated."""
        return len(self.read_density)


class Model(nn.Module):
    """The hybrid field with its occupancy grid.

    Args:
        config: all settings of the run.
        classes: number of classes; 0 without semantics.
        images: number of training images.
        contracted: the grid covers all of space.
        seen: (resolution³,) bool or None, see OccupancyGrid.
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
    ) -> None:
        super().__init__()
        self.config = config
        self.field = HybridField(config.field, classes, images)
        self.occupancy = OccupancyGrid(config.sampling, contracted, seen)
        self.register_buffer("priorities", torch.ones(max(classes, 1)) if priorities is None else priorities)
        self.priorities: torch.Tensor
        self.warming_up = False
        self.labelled = 1.0  # share of the training pixels that have a label
        self.register_buffer("shown_share", torch.ones(()))
        self.shown_share: torch.Tensor
        self._refined: RenderGrid | None = None
        # What is differentiated has places for as many samples as there may be, so that the host need not wait for
        # their number; None: on devices that run behind the host.
        self.fixed_places: bool | None = None
        self.known_share = 1.0  # `shown_share` as the host last read it

    def has_fixed_places(self) -> bool:
        """Whether `render` reads nothing back from the device where it keeps gradients."""
        return self.priorities.device.type == "cuda" if self.fixed_places is None else self.fixed_places

    def refresh(self) -> None:
        """Read back how many of the samples show."""
        self.known_share = float(self.shown_share)

    @property
    def contracted(self) -> bool:
        return self.occupancy.contracted

    def interest(self, points: torch.Tensor) -> torch.Tensor:
        """Interest (N,) of points (N, 3) for the sampling PDF."""
        kind = "literal" if self.config.sampling.pdf == "literal" else self.config.sampling.interest
        logits = self.field.logits(self.field.geometry(points))
        return class_interest(torch.softmax(logits, 1), kind, self.priorities)

    def wants_interest(self) -> bool:
        """Whether reading classes would change where samples go."""
        s = self.config.sampling
        if self.field.semantic_head is None or s.pdf == "uniform":
            return False
        if s.pdf == "literal":
            return True
        flat = bool((self.priorities == self.priorities[0]).all())
        return s.beta > 0 and (s.interest == "boundary" or (s.interest == "priority" and not flat))

    def refine(self, pixels: float = math.inf, check: Callable[[], None] | None = None) -> None:
        """Render from now on with a finer grid if it pays for so many pixels. Training leaves it behind: for fields that
        are finished."""
        if self._refined is None:
            c = self.config.render
            self._refined = refined_grid(self.occupancy, self.field.density, c.refine, c.per_bin, pixels, check)

    @property
    def label_pull(self) -> float:
        """Factor of the gradient that labels have in the geometry: the labelled share of the pixels, so that each label
        counts as if all pixels had one; else the few there are would bend the geometry to their photos."""
        return 0.0 if self.config.loss.detach_weights else self.labelled

    def render_grid(self) -> RenderGrid:
        """What the rays of a picture walk."""
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
    ) -> Rendered:
        """Render rays (R, 3) of the normalised frame; differentiable in the field.

        `grid`: what the rays walk, by default the occupancy grid, as in training; `jitter`, `shift`: see
        kernels.march.sample; `codes` (R, A): appearance code of each ray.
        """
        grid = grid or present_grid(self.occupancy, 0.0)
        learning = torch.is_grad_enabled()
        fixed = learning and self.has_fixed_places()
        if not fixed:
            self.refresh()
        capacity = len(origins) if fixed else None
        s = sample(origins, directions, grid.cells, grid.reach, grid.settings, samples_per_ray, jitter, shift, capacity)
        points = s.points
        if origins.requires_grad:  # pose refinement: samples move with their ray
            along = s.packing.ray.long()
            moved = origins[along] + directions[along] * s.depth[:, None]
            points = grid_position(moved, self.contracted).clamp(0, 1)
        # Where many samples turn out invisible, a first pass without gradients finds the others, and only those are
        # differentiated; where nearly all show, one pass is cheaper (3k + 1 against 3 forward costs at share k).
        first_look = not learning or self.known_share < ONE_PASS_SHARE
        with torch.set_grad_enabled(learning and not first_look):
            everywhere = self.field.geometry(points)
            weights = render_weights(everywhere.density, s.delta, s.packing)
        with torch.no_grad():
            visible = weights > self.config.render.cull
            room = math.ceil(len(s) * min(1.0, ROOM * self.known_share)) if fixed else None
            kept, packing = s.packing.subset(visible, room)
        delta = s.delta[kept]
        if learning and first_look:
            shown = self.field.geometry(
                points[kept], everywhere.explicit[kept] if everywhere.explicit is not None else None
            )
            weight = render_weights(shown.density, delta, packing)
        else:
            shown, weight = everywhere[kept], weights[kept]
            if fixed:
                weight = torch.where(packing.ray < 0, 0.0, weight)
        ray = packing.ray.long()
        # Per ray first: a ray's samples share direction and code.
        directional = spherical_harmonics(directions).to(self.field.dtype)
        color = self.field.color(shown, directional[ray], None if codes is None else codes[ray])
        depth = s.depth[kept]
        values = torch.cat([color, torch.ones_like(weight)[:, None], depth[:, None]], 1)
        summed = weighted_sum(values, weight, packing)
        probabilities = None
        if semantics and self.field.semantic_head is not None:
            probabilities = self._probabilities(self.field.logits(shown), weight, packing)
        shown_samples = Samples(s.points[kept], depth, delta, packing, s.first, s.last)
        return Rendered(
            summed[:, :3],
            summed[:, 3],
            summed[:, 4],
            probabilities,
            weight,
            torch.where(packing.ray < 0, 0.0, shown.density) if fixed else shown.density,
            shown_samples,
            s.points,
            torch.where(s.packing.ray < 0, -1.0, everywhere.density.detach()) if fixed else everywhere.density.detach(),
        )

    @torch.no_grad()
    def observe(self, rendered: list[Rendered]) -> None:
        """Let the occupancy grid see what a training step read, and note how much of it showed."""
        points = torch.cat([r.read_points for r in rendered])
        density = torch.cat([r.read_density for r in rendered])
        self.occupancy.observe(points, density, self.warming_up)
        shown = torch.stack([r.samples.packing.count.sum() for r in rendered]).sum()
        self.shown_share += 0.05 * (shown / (density >= 0).sum().clamp(min=1) - self.shown_share)

    def _probabilities(self, logits: torch.Tensor, weight: torch.Tensor, packing) -> torch.Tensor:
        pull = self.label_pull
        weight = torch.lerp(weight.detach(), weight, pull) if pull > 0 else weight.detach()
        if self.config.render.accumulate == "probabilities":
            return weighted_sum(torch.softmax(logits, 1), weight, packing)
        total = weighted_sum(torch.cat([logits, torch.ones_like(weight)[:, None]], 1), weight, packing)
        return torch.softmax(total[:, :-1], 1) * total[:, -1:]
