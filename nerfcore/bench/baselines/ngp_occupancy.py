"""The occupancy grid of Instant-NGP.

Source: Müller et al., “Instant Neural Graphics Primitives with a Multiresolution Hash Encoding”, 2022, appendix C. Space
beyond the cube is contracted here instead of covered by larger cubes.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from ...config import SamplingConfig
from ...kernels.traversal import skip_distances
from ...sampling.occupancy import CHUNK, OccupancyGrid

UPDATE_EVERY, DECAY = 16, 0.95
ALL_UNTIL = 256  # steps in which every update reads all cells; later ones read half as many points as there are cells
PUBLISHED_SAMPLES = 1 << 18  # of a step


class NGPOccupancy(OccupancyGrid):
    """Ours, but half of the reads are anywhere, half in occupied cells, and a cell is occupied by itself alone. With fewer
    samples a step than published, an update reads fewer cells in proportion, and only those fade; cells never read, of
    density −1, are occupied.

    Args:
        samples: of a training step.
    """

    def __init__(self, config: SamplingConfig, contracted: bool, samples: int) -> None:
        super().__init__(config, contracted)
        self.share = min(samples / PUBLISHED_SAMPLES, 1.0)
        self.density.fill_(-1.0)

    def rebuild(self) -> None:
        opacity, unread = self.density * self.step, self.density < 0
        mean = float(opacity.clamp(min=0).sum() / (~unread).sum().clamp(min=1))
        occupied = unread | (opacity > min(mean, self.config.threshold))
        n = self.config.resolution
        self.cells[:, 0] = occupied.float()
        self.skip_distance.copy_(skip_distances(occupied.view(n, n, n)))

    @torch.no_grad()
    def refresh(self, step: int, density: Callable[[torch.Tensor], torch.Tensor], generator: torch.Generator) -> None:
        """One update before training step `step`; density: points (N, 3) in [0, 1]³ → (N,)."""
        n3, device = len(self.density), self.density.device
        if step < ALL_UNTIL and self.share == 1:
            cells = torch.arange(n3, device=device)
        else:
            reads = round(n3 * self.share * (1.0 if step < ALL_UNTIL else 0.25))
            cells = torch.randint(0, n3, (reads,), device=device, generator=generator)
            occupied = (self.cells[:, 0] > 0).nonzero()[:, 0]
            if step >= ALL_UNTIL and len(occupied):
                chosen = torch.randint(0, len(occupied), (reads,), device=device, generator=generator)
                cells = torch.cat([cells, occupied[chosen]])
        fresh = torch.cat([density(self.positions(part, generator)) for part in cells.split(CHUNK)])
        faded = self.density.clone()
        faded[cells] *= DECAY
        self.density.copy_(faded.scatter_reduce_(0, cells, fresh, "amax"))
        self.rebuild()
