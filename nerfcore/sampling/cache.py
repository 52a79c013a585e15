"""The coarse cache: which tiles of the training images meet the field at all.

A batch drawn only from such tiles spends no rays on empty surroundings; a share of the rays still comes from
everywhere, so that space that empties or fills again is noticed.
"""

from __future__ import annotations

import torch

from ..data.pixels import PixelStore
from ..kernels.march import sample

TILE = 16  # pixels a side; not tuned
RAYS = 1 << 17  # at once


class CoarseCache:
    """Flags of TILE × TILE pixel tiles of all images of a store; all set until the first `rebuild`."""

    def __init__(self, store: PixelStore) -> None:
        self.store = store
        device = store.device
        sizes = [(-(-c.width // TILE), -(-c.height // TILE)) for c in store.cameras]
        self.columns = torch.tensor([w for w, _ in sizes], device=device)
        self.width = torch.tensor([c.width for c in store.cameras], device=device)
        self.height = torch.tensor([c.height for c in store.cameras], device=device)
        counts = torch.tensor([w * h for w, h in sizes])
        self.first = torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)]).to(device)
        self.hit: torch.Tensor | None = None

    def _pixels(self, tiles: torch.Tensor, dx: torch.Tensor, dy: torch.Tensor) -> torch.Tensor:
        """Flat pixel indices at offset (dx, dy) in [0, TILE) of tiles; those that would reach beyond the image lie at its
        edge, so that none of their pixels comes more often."""
        image = torch.bucketize(tiles, self.first[1:], right=True)
        local = tiles - self.first[image]
        row, column = torch.div(local, self.columns[image], rounding_mode="floor"), local % self.columns[image]
        width, height = self.width[image], self.height[image]
        x = (column * TILE).minimum(width - TILE).clamp(min=0) + dx % width
        y = (row * TILE).minimum(height - TILE).clamp(min=0) + dy % height
        return self.store.first[image] + y * width + x

    @torch.no_grad()
    def rebuild(self, model) -> None:
        """Cast rays through nine pixels of every tile; a tile counts when one of them meets an occupied cell."""
        device, count = self.store.device, int(self.first[-1])
        tiles = torch.arange(count, device=device)
        hit = torch.zeros(count, dtype=torch.bool, device=device)
        for dy in (0, TILE // 2, TILE - 1):
            for dx in (0, TILE // 2, TILE - 1):
                unhit = tiles[~hit]
                for part in unhit.split(RAYS):
                    offset = torch.full_like(part, dx), torch.full_like(part, dy)
                    batch = self.store.batch(self._pixels(part, *offset))
                    occupancy = model.occupancy
                    t_first = sample(
                        batch.origins,
                        batch.directions,
                        occupancy.cells,
                        occupancy.skip_distance,
                        occupancy.march_settings(),
                        1,
                    ).t_first
                    hit[part] = t_first >= 0
        self.hit = tiles[hit] if bool((~hit).any()) and bool(hit.any()) else None

    def draw(self, count: int, everywhere: float, generator: torch.Generator) -> torch.Tensor:
        """`count` flat pixel indices (R,): random pixels of hit tiles, and a share `everywhere` of any."""
        if self.hit is None or self.store.usable is not None:
            return self.store.random_pixels(count, generator)
        free = int(count * everywhere)
        device = self.store.device

        def random(limit: int) -> torch.Tensor:
            return torch.randint(0, limit, (count - free,), device=device, generator=generator)

        chosen = self._pixels(self.hit[random(len(self.hit))], random(TILE), random(TILE))
        return torch.cat([chosen, self.store.random_pixels(free, generator)])
