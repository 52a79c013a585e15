"""Classes of a baked field, changed so that it shows those of the label maps.

The field's classes, read at vertices beside a surface, are not quite those of the surface. Rays through labelled pixels are marched
through the baked field, and each vertex takes the labels of the rays it has a part in, by its part, beside what was read.
"""

from __future__ import annotations

import torch

from ..data.pixels import VOID, PixelStore
from ..kernels.traversal import MarchSettings
from ..kernels.voxel_field import VIEWS
from ..kernels.voxel_march import add_views
from .blocks import Blocks, Check, weights_and_cameras
from .colors import stored_shares
from .fit import shared_vertices

# Measured (docs/experiments.md, “Classes of a baked field from label maps”):
PRIOR = 1.0  # weight of what was read, in pixels
ROUNDS = 16
RAYS = 100_000  # in a round: so few that hardly two meet at a vertex, of which the nearer one counts
LEAST = 0.01  # weight that a ray has at a vertex, below which it does not count; not tuned
MOST_INDICES = 256  # of classes: a byte


@torch.no_grad()
def vote(
    blocks: Blocks, texels: torch.Tensor, classes: int, photos: PixelStore, settings: MarchSettings, check: Check
) -> None:
    """Change the classes in texels (S · 9³, 2, 4) uint8 of blocks in place.

    Args:
        photos: of the run, with labels as indices of its classes. settings: the step is as long as a cell.
    """
    if classes < 2 or len(blocks) == 0 or len(photos) == 0:
        return
    same, count = shared_vertices(blocks)
    keys, sums = _votes(blocks, same, photos, settings, check)
    if len(keys) == 0:  # no pixel that meets it has a label
        return
    places = torch.unique(keys // MOST_INDICES)
    # What was read, of one of the vertices at each place.
    row = torch.zeros(count, dtype=torch.long, device=keys.device)
    row[same] = torch.arange(len(same), device=keys.device)
    read = texels[row[places], 1].long()
    share = PRIOR * read[:, 1] / 255
    more = (places * MOST_INDICES + read[:, 0], places * MOST_INDICES + read[:, 2])
    keys, sums = _summed(torch.cat([keys, *more]), torch.cat([sums, share, PRIOR - share]))
    found = _two_largest(keys, sums)
    row.fill_(-1)
    row[places] = torch.arange(len(places), device=keys.device)
    changed = (row[same] >= 0).nonzero()[:, 0]
    texels[changed, 1, :3] = found[row[same[changed]]]


def _votes(
    blocks: Blocks, same: torch.Tensor, photos: PixelStore, settings: MarchSettings, check: Check
) -> tuple[torch.Tensor, torch.Tensor]:
    """How many pixels of which class each vertex has a part in: keys (N,) vertex · MOST_INDICES + class, in order, and their
    sums (N,)."""
    device = same.device
    generator = torch.Generator(device).manual_seed(0)
    index = blocks.index()
    keys, sums = torch.zeros(0, dtype=torch.long, device=device), torch.zeros(0, device=device)
    for _ in range(ROUNDS):
        check()
        batch = photos.batch(photos.random_pixels(min(RAYS, len(photos)), generator).sort().values)
        sure = torch.rand(len(batch.label), generator=generator, device=device) < batch.confidence
        used = (sure & (batch.label != VOID)).nonzero()[:, 0]
        labels = torch.zeros(len(same), VIEWS, dtype=torch.int32, device=device)
        number = batch.label[used].to(torch.int32)
        add_views(labels, batch.origins[used], batch.directions[used], number, index, blocks.roots, settings)
        vertex, column = labels.nonzero().T
        weight, number = weights_and_cameras(labels[vertex, column])
        kept = weight > LEAST
        fresh = same[vertex[kept]] * MOST_INDICES + number[kept]
        keys, sums = _summed(torch.cat([keys, fresh]), torch.cat([sums, weight[kept]]))
    return keys, sums


def _summed(keys: torch.Tensor, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The keys (N,) once each, in order, and the sums of their values."""
    found, place = torch.unique(keys, return_inverse=True)
    return found, torch.zeros(len(found), device=keys.device).index_add_(0, place, values)


def _two_largest(keys: torch.Tensor, sums: torch.Tensor) -> torch.Tensor:
    """Class with the largest sum, its share and the class with the second largest (P, 3) uint8 of each vertex, in order; keys as
    in `_votes`, at least two of a vertex."""
    vertex, order = keys // MOST_INDICES, sums.argsort(descending=True, stable=True)
    order = order[vertex[order].argsort(stable=True)]
    vertex = vertex[order]
    first = torch.cat([vertex.new_ones(1, dtype=torch.bool), vertex[1:] != vertex[:-1]])
    total = torch.zeros(int(first.sum()), device=keys.device).index_add_(0, first.cumsum(0) - 1, sums[order])
    begin = first.nonzero()[:, 0]
    top, second = order[begin], order[begin + 1]
    share = stored_shares(sums[top] / total)
    return torch.stack([keys[top] % MOST_INDICES, share, keys[second] % MOST_INDICES], 1).to(torch.uint8)
