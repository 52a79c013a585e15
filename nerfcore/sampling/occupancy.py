"""The occupancy grid: which cells are worth sampling, how dense they are, and how interesting their classes."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import nn

from ..config import SamplingConfig
from ..kernels.cells import MeanScratch, average, observe
from ..kernels.runtime import run_parallel
from ..kernels.traversal import PDF_DEFAULT, PDF_LITERAL, PDF_UNIFORM, MarchSettings, skip_distances
from .space import cell_states

MODES = {"default": PDF_DEFAULT, "uniform": PDF_UNIFORM, "literal": PDF_LITERAL}
CHUNK = 1 << 16
# Not tuned: the next three.
IMPORTANCE_RATE = 0.2  # at which a cell's importance follows each point read in it
SWEEPS = (1, 2, 4, 8, 12)  # updates of the warm-up at which the whole grid is read
PROBES = 64  # one cell in so many is read at an update, and as many occupied ones


class OccupancyGrid(nn.Module):
    """Moving maximum and mean of the field's density in each cell of a resolution³ grid over the field's domain.

    The maximum decides which cells are occupied. `cells` (resolution³, 2) is what rays read: mean density per normalised
    unit length, 0 where the cell is empty, and importance in [0, 1]. Cells that no camera sees are never occupied.

    Args:
        config: sampling settings.
        contracted: the grid covers all of space instead of the cube [−1, 1]³.
        seen: (resolution³,) bool, cells in some camera's view that no rule closes; None: all.
        unknown: (resolution³,) bool, cells that no photo shows; None: none.
    """

    def __init__(
        self,
        config: SamplingConfig,
        contracted: bool,
        seen: torch.Tensor | None = None,
        unknown: torch.Tensor | None = None,
    ) -> None:
        super().__init__()
        self.config, self.contracted = config, contracted
        n = config.resolution
        self.step = (4.0 if contracted else 2.0) / (n * config.bins_per_cell)
        seen = torch.ones(n**3, dtype=torch.bool) if seen is None else seen
        # Every seen cell starts half opaque: opacity 1 − e^−1 over a sixth of the domain.
        self.register_buffer("density", torch.where(seen, 3.0, 0.0))
        self.register_buffer("importance", torch.zeros(n**3))
        self.register_buffer("seen", seen)
        self.register_buffer("unknown", torch.zeros_like(seen) if unknown is None else unknown)
        self.unknown: torch.Tensor
        # Rays read these; they follow the density at updates only, so they are part of a checkpoint.
        self.register_buffer("cells", torch.stack([self.density, self.importance], 1))
        # How far from every camera of the capture nothing was seen: other cameras outside of the cube need not look.
        self.register_buffer("empty_distance", torch.zeros(()))
        self.empty_distance: torch.Tensor
        self._host_empty_distance = (-1, 0.0)
        self._scratch: MeanScratch | None = None
        self.register_buffer("mean", torch.where(seen, 3.0, 0.0))
        self.mean: torch.Tensor
        self.density: torch.Tensor
        self.importance: torch.Tensor
        self.seen: torch.Tensor
        self.register_buffer("scratch", torch.full((n**3,), -1.0), persistent=False)
        self.scratch: torch.Tensor
        self.register_buffer("skip_distance", torch.zeros((n // 4) ** 3, dtype=torch.uint8))
        self.cells: torch.Tensor
        self.skip_distance: torch.Tensor

    def _mean_scratch(self) -> MeanScratch:
        if self._scratch is None or self._scratch.sums.device != self.mean.device:
            self._scratch = MeanScratch(len(self.mean), self.mean.device)
        return self._scratch

    def march_settings(self, near: float = 0.02) -> MarchSettings:
        c = self.config
        if self._host_empty_distance[0] != self.empty_distance._version:  # reading it back from a device takes long
            self._host_empty_distance = (self.empty_distance._version, float(self.empty_distance))
        beta = c.beta if c.importance != "none" else 0.0
        return MarchSettings(
            c.resolution,
            self.step,
            near,
            1000.0,
            self.contracted,
            MODES[c.pdf],
            beta,
            c.epsilon,
            self._host_empty_distance[1],
        )

    def rebuild(self) -> None:
        """Recompute what rays read from densities and importance."""
        opacity = self.density * self.step
        threshold = min(float(opacity[self.seen].mean()), self.config.threshold) if bool(self.seen.any()) else 1.0
        occupied = (opacity > threshold) & self.seen
        # Neighbours of occupied cells count as occupied too, or rays would slip through where they only graze a thin shell of cells.
        n = self.config.resolution
        grown = occupied.view(n, n, n).clone()
        for axis in range(3):
            along = occupied.view(n, n, n)
            grown.narrow(axis, 1, n - 1).logical_or_(along.narrow(axis, 0, n - 1))
            grown.narrow(axis, 0, n - 1).logical_or_(along.narrow(axis, 1, n - 1))
        occupied = grown.view(-1) & self.seen
        # What a ray meets in a cell is rather its mean than its largest density, and even of that no cell may take all
        # the samples: the ray may pass through its empty part.
        self.cells[:, 0] = torch.where(occupied, self.mean.clamp(1e-3, self.config.optical_depth / self.step), 0.0)
        self.cells[:, 1] = self.importance
        self.skip_distance.copy_(skip_distances(occupied.view(n, n, n)))

    def states(self) -> torch.Tensor:
        """State (resolution³,) uint8 of every cell: `space.UNKNOWN`, `EMPTY` or `OCCUPIED`."""
        return cell_states(self.unknown, self.cells[:, 0] > 0)

    def positions(self, cells: torch.Tensor, generator: torch.Generator | None = None) -> torch.Tensor:
        """A random point (N, 3) in [0, 1]³ inside each of the cells (N,)."""
        n = self.config.resolution
        corner = torch.stack([cells % n, cells // n % n, cells // (n * n)], 1)
        return (corner + torch.rand(len(cells), 3, device=cells.device, generator=generator)) / n

    def _chosen(self, generator: torch.Generator | None) -> torch.Tensor:
        n3, device = self.config.resolution**3, self.density.device
        anywhere = torch.randint(0, n3, (n3 // PROBES,), device=device, generator=generator)
        occupied = (self.cells[:, 0] > 0).nonzero()[:, 0]
        if len(occupied) > n3 // PROBES:
            occupied = occupied[torch.randint(0, len(occupied), (n3 // PROBES,), device=device, generator=generator)]
        return torch.cat([anywhere, occupied])

    def _sweep(self, density: Callable[[torch.Tensor], torch.Tensor], generator: torch.Generator | None) -> None:
        """Read one point in every block of 4³ cells, with quick forgetting of the initial guess."""
        side = self.config.resolution // 4
        axis = torch.arange(side, device=self.density.device)
        z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
        corner = torch.stack([x, y, z], -1).reshape(-1, 3)
        points = (corner + torch.rand(corner.shape, device=corner.device, generator=generator)) / side
        fresh = torch.cat([density(part) for part in points.split(CHUNK)])
        blocks = fresh.view(side, 1, side, 1, side, 1).expand(side, 4, side, 4, side, 4).reshape(-1)
        torch.maximum(self.density * self.config.warmup_decay, blocks, out=self.density)
        self.density[~self.seen] = 0

    @torch.no_grad()
    def observe(self, points: torch.Tensor, density: torch.Tensor, warming_up: bool) -> None:
        """Take in the densities (N,) that a training step read anyway at points (N, 3); rays see it at the next update.

        Points with a negative density were not read."""
        # A cell is observed at up to every step: its decay is spread over them.
        decay = 0.9 if warming_up else self.config.decay ** (1 / self.config.update_every)
        n = self.config.resolution
        mean = partial(average, self.mean, self._mean_scratch(), n, points, density, self.config.mean_rate)
        largest = partial(observe, self.density, self.scratch, n, points, density, decay)
        run_parallel([mean, largest], points.device)

    @torch.no_grad()
    def update(
        self,
        step: int,
        density: Callable[[torch.Tensor], torch.Tensor],
        importance: Callable[[torch.Tensor], torch.Tensor] | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        """Read the field in some cells and rebuild the grid.

        Args:
            density: points (N, 3) → (N,), per normalised unit length.
            importance: points (N, 3) → (N,) in [0, 1], asked for occupied cells only.
        """
        if step < self.config.warmup:
            if step // self.config.update_every in SWEEPS:
                self._sweep(density, generator)
            self.rebuild()
            return
        cells = self._chosen(generator)
        cells = cells[self.seen[cells]]
        points = self.positions(cells, generator)
        fresh = torch.cat([density(part) for part in points.split(CHUNK)]) if len(points) else points[:, 0]
        # A cell may have been chosen twice.
        n, scratch = self.config.resolution, self._mean_scratch()
        observe(self.density, self.scratch, n, points, fresh, self.config.decay)
        average(self.mean, scratch, n, points, fresh, self.config.mean_rate)
        if importance is not None:
            dense = fresh * self.step > self.config.threshold
            if bool(dense.any()):
                value = torch.cat([importance(part) for part in points[dense].split(CHUNK)])
                average(self.importance, scratch, n, points[dense].contiguous(), value, IMPORTANCE_RATE)
        self.rebuild()


def class_importance(probabilities: torch.Tensor, kind: str, priorities: torch.Tensor) -> torch.Tensor:
    """Interest r (N,) in [0, 1] of points from class probabilities (N, K).

    "priority": Σ_k π_k p_k with priorities scaled to a maximum of 1; "boundary": H(p) / log K.
    """
    if kind == "boundary":
        entropy = -(probabilities * probabilities.clamp(min=1e-8).log()).sum(1)
        return entropy / math.log(max(probabilities.shape[1], 2))
    if kind == "literal":
        return probabilities.max(1).values
    return probabilities @ (priorities / priorities.max().clamp(min=1e-8))
