"""Colours and opacities of a baked field, changed so that it looks like the photos.

Reading a field at the vertices of a grid loses what is thinner than a cell. Rays through the photos' pixels are marched
through the baked field, and each vertex takes the mean of the errors it has a part in, weighted by its part (the
simultaneous iterative reconstruction of Gilbert, 1972; for opacities a Gauss–Newton step on the diagonal).
"""

from __future__ import annotations

from dataclasses import replace

import torch

from ..data.pixels import Batch, PixelStore
from ..kernels.traversal import MarchSettings
from ..kernels.voxel_field import CELLS, VERTICES, VoxelField
from ..kernels.voxel_fit import add_errors
from ..kernels.voxel_march import march
from ..render.model import Model
from .blocks import CHUNK, Blocks, Check
from .colors import HARMONIC_RANGE

# Measured (docs/experiments.md, “What does a baked field lose?”):
ROUNDS = 7
RAYS = 800_000  # in a round
RATE = 0.5  # of the step of opacities
# Not tuned: the next four.
DAMPING = 0.05  # weight of what a vertex was before, in pixels
LARGEST = 0.15  # change of an opacity's root in a round
EXPOSURE_RAYS = 200_000  # that tell how bright each photo is
EXPOSURES = 0.5, 2.0  # of a photo against the field


@torch.no_grad()
def fitted(
    model: Model,
    blocks: Blocks,
    texels: torch.Tensor,
    changes: torch.Tensor,
    photos: PixelStore,
    settings: MarchSettings,
    check: Check,
) -> Blocks:
    """Fit texels (S · 9³, 2, 4) uint8 of blocks as `colors.vertex_texels` makes them to photos, in place; returns the blocks
    with the opacities that they have then.

    Args:
        changes: (S · 5³, 3, 4) uint8 of the same, which stay.
        photos: of the run, with the poses that the field was trained with.
        settings: the step is as long as a cell.
    """
    if len(blocks) == 0 or len(photos) == 0:
        return blocks
    device = texels.device
    generator = torch.Generator(device).manual_seed(0)
    same, count = shared_vertices(blocks)
    color, root = texels[:, 0, :3].float() / 255, texels[:, 0, 3].float() / 255

    def field() -> VoxelField:
        texels[:, 0] = (torch.cat([color, root[:, None]], 1) * 255).round().to(torch.uint8)
        now = replace(blocks, roots=texels[:, 0, 3].contiguous())
        return baked_field(now, texels, changes, model.field.classes)

    def drawn(rays: int) -> tuple[Batch, torch.Tensor]:
        # In their order, so that rays beside each other meet the same vertices.
        batch = photos.batch(photos.random_pixels(rays, generator).sort().values)
        return batch, batch.before(behind(model, batch.directions, generator, check))

    batch, background = drawn(min(EXPOSURE_RAYS, len(photos)))
    gains = exposures(field(), batch, background, settings, len(photos.views))
    for _ in range(ROUNDS):
        batch, background = drawn(min(RAYS, len(photos)))
        wanted = composed(batch, background, gains)
        sums = torch.zeros(len(texels), 6, device=device)
        now = field()
        for rows in torch.arange(len(wanted), device=device).split(RAYS // 8):
            check()
            origins, directions = batch.origins[rows], batch.directions[rows]
            add_errors(sums, origins, directions, wanted[rows], background[rows], now, settings)
        sums = torch.zeros(count, 6, device=device).index_add_(0, same, sums)[same]
        color = (color + sums[:, :3] / (sums[:, 3:4] + DAMPING)).clamp(0, 1)
        change = RATE * sums[:, 4] / (sums[:, 5] + DAMPING)
        root = (root + change.clamp(-LARGEST, LARGEST)).clamp(0, 1)
    field()
    return replace(blocks, roots=texels[:, 0, 3].contiguous())


def baked_field(blocks: Blocks, texels: torch.Tensor, changes: torch.Tensor, classes: int) -> VoxelField:
    """The field of blocks with their texels (S · 9³, 2, 4) and changes (S · 5³, 3, 4) uint8, all classes opaque."""
    words, coarse = (value.reshape(-1).view(torch.int32) for value in (texels, changes))
    opaque = torch.ones(256, device=words.device)
    return VoxelField(blocks.side, blocks.index(), words, coarse, opaque, HARMONIC_RANGE, classes)


def shared_vertices(blocks: Blocks) -> tuple[torch.Tensor, int]:
    """Number (S · 9³,) of each vertex, the same for the one place that several blocks have, and how many there are."""
    axis = torch.arange(VERTICES, device=blocks.places.device)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    places = (blocks.places[:, None] * CELLS + torch.stack([x, y, z], -1).view(1, -1, 3)).reshape(-1, 3)
    side = blocks.side * CELLS + 1
    found, same = torch.unique((places[:, 2] * side + places[:, 1]) * side + places[:, 0], return_inverse=True)
    return same, len(found)


def behind(model: Model, directions: torch.Tensor, generator: torch.Generator, check: Check) -> torch.Tensor:
    """What is behind the field along directions (R, 3): the environment, or any colour where there is none, so that only
    what is opaque hides it."""
    if model.environment is None:
        return torch.rand(len(directions), 3, generator=generator, device=directions.device)
    colors = []
    for part in directions.split(CHUNK):
        check()
        far = model.environment.rays(model.field, part, torch.ones_like(part[:, 0]), semantics=False)
        colors.append(far.color.float())
    return torch.cat(colors)


def composed(batch: Batch, background: torch.Tensor, gains: torch.Tensor) -> torch.Tensor:
    """What rays shall see (R, 3): photos as bright as the field, before their background (R, 3)."""
    seen = (batch.rgb * gains[batch.image]).clamp(0, 1)
    return torch.lerp(background, seen, batch.alpha[:, None])


def exposures(
    field: VoxelField, batch: Batch, background: torch.Tensor, settings: MarchSettings, photos: int
) -> torch.Tensor:
    """By what each photo's colours are to be multiplied to be those of the field, (photos, 3)."""
    rays = march(batch.origins, batch.directions, field, settings)
    shown = rays.color + (1 - rays.opacity)[:, None] * background
    photo = composed(batch, background, torch.ones(photos, 3, device=shown.device))
    both, own = (torch.full((photos, 3), 1.0, device=shown.device) for _ in range(2))
    both.index_add_(0, batch.image, shown * photo)
    own.index_add_(0, batch.image, photo * photo)
    return (both / own).clamp(*EXPOSURES)
