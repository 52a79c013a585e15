"""The march through baked blocks: its backends against each other, and against what must hold of any march."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from fieldwork.addon.live.shaders import LEAST_LEFT
from fieldwork.nerfcore.bake.blocks import Blocks
from fieldwork.nerfcore.kernels import voxel_march, voxel_march_torch
from fieldwork.nerfcore.kernels.traversal import MarchSettings
from fieldwork.nerfcore.kernels.voxel_field import (
    COARSE,
    SLOT_BITS,
    VERTICES,
    VIEWS,
    VoxelField,
    VoxelRays,
    cell_length,
)
from fieldwork.nerfcore.kernels.voxel_march import add_views, march

SIDE, CLASSES = 8, 5
CONTRACTED = pytest.mark.parametrize("contracted", [False, True])


@pytest.fixture(autouse=True, params=["host", "every device"])
def kernels_of(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The CPU runs its own kernels, and those that GPUs run."""
    if request.param == "every device":
        monkeypatch.setattr(voxel_march, "on_host", lambda device: False)


def settings(contracted: bool, step: float = 1.0, side: int = SIDE) -> MarchSettings:
    return MarchSettings(side * 8, step * cell_length(side, contracted), contracted=contracted)


def random_field(seed: int = 0) -> tuple[Blocks, VoxelField]:
    """Blocks at random places with random texels; of each block one octant or more is empty."""
    generator = torch.Generator().manual_seed(seed)
    places = (torch.rand(SIDE, SIDE, SIDE, generator=generator) < 0.08).nonzero()
    texels = torch.randint(0, 256, (len(places) * VERTICES**3, 2, 4), generator=generator).to(torch.uint8)
    texels[:, 0, 3] //= 3
    texels[:, 1, [0, 2]] %= CLASSES
    roots = texels[:, 0, 3].view(-1, VERTICES, VERTICES, VERTICES)
    roots[::2, :5, :5, :5], roots[1::2, 4:, 4:] = 0, 0
    changes = torch.randint(0, 256, (len(places) * COARSE**3, 3, 4), generator=generator).to(torch.uint8)
    return made(places, texels, changes, torch.rand(256, generator=generator), 0.4, CLASSES)


def made(
    places: torch.Tensor,
    texels: torch.Tensor,
    changes: torch.Tensor | None = None,
    opacity: torch.Tensor | None = None,
    harmonic_range: float = 0.0,
    classes: int = 0,
    side: int = SIDE,
) -> tuple[Blocks, VoxelField]:
    """Blocks at places (S, 3) and the field of their texels (S · 9³, 2, 4) and changes (S · 5³, 3, 4), bytes."""
    if changes is None:
        changes = torch.full((len(places) * COARSE**3, 3, 4), 128, dtype=torch.uint8)
    blocks = Blocks(side, places, texels[:, 0, 3].contiguous())
    words = [value.reshape(-1).view(torch.int32) for value in (texels, changes)]
    return blocks, VoxelField(
        side, blocks.index(), *words, torch.ones(256) if opacity is None else opacity, harmonic_range, classes
    )


def even_field(root: int, places: torch.Tensor, side: int = SIDE) -> VoxelField:
    """Blocks that are equally dense and grey everywhere, without classes."""
    texels = torch.full((len(places) * VERTICES**3, 2, 4), 128, dtype=torch.uint8)
    texels[:, 0, :3], texels[:, 0, 3] = 51, root
    return made(places, texels, side=side)[1]


def random_rays(count: int = 600, seed: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays from inside and outside, most of them through the cube."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.randn(count, 3, generator=generator) * 1.5
    towards = torch.randn(count, 3, generator=generator) * 0.5 - origins
    return origins, torch.nn.functional.normalize(towards, dim=1)


def moved(field: VoxelField, device: torch.device) -> VoxelField:
    there = {name: value.to(device) for name, value in vars(field).items() if isinstance(value, torch.Tensor)}
    return replace(field, **there)


def largest_difference(one: VoxelRays, other: VoxelRays) -> float:
    assert one.probabilities is not None
    assert other.probabilities is not None
    pairs = [(one.color, other.color), (one.opacity, other.opacity), (one.probabilities, other.probabilities)]
    return max(float((a.cpu() - b.cpu()).abs().max()) for a, b in pairs)


@CONTRACTED
@pytest.mark.parametrize("step", [0.5, 1.0, 1.7])
def test_backends_agree(device: torch.device, contracted: bool, step: float) -> None:
    _, field = random_field()
    origins, directions = random_rays()
    here = settings(contracted, step)
    ends = torch.full((len(origins),), here.far)
    ends[::3] = torch.linspace(1.0, 4.0, len(ends[::3]))
    expected = voxel_march_torch.march(origins, directions, field, here, ends)
    found = march(origins.to(device), directions.to(device), moved(field, device), here, ends.to(device))
    assert float(expected.opacity.mean()) > 0.03
    assert largest_difference(found, expected) < 1e-4
    assert torch.allclose(found.depth.cpu(), expected.depth, rtol=1e-3, atol=1e-4)


@CONTRACTED
@pytest.mark.parametrize("by_vertex", [False, True])
def test_backends_note_the_same_views(device: torch.device, contracted: bool, by_vertex: bool) -> None:
    blocks, field = random_field()
    origins, directions = random_rays()
    cameras = torch.arange(len(origins), dtype=torch.int32) % 77
    rows = len(blocks.roots) if by_vertex else len(blocks)
    expected = torch.zeros(rows, VIEWS, dtype=torch.int32)
    found = expected.to(device)
    here = settings(contracted)
    voxel_march_torch.add_views(expected, origins, directions, cameras, field.index, blocks.roots, here)
    there = [tensor.to(device) for tensor in (origins, directions, cameras, field.index, blocks.roots)]
    add_views(found, *there, here)
    assert float((expected > 0).float().mean()) > 0.05
    assert float(((found.cpu() >> 16) - (expected >> 16)).abs().max()) <= 1
    assert float((found.cpu() == expected).float().mean()) > 0.99
    seen = expected[expected > 0] & 0xFFFF
    assert int(seen.max()) < 77


@CONTRACTED
def test_leaping_over_empty_blocks_changes_nothing(contracted: bool) -> None:
    _, field = random_field()
    full = field.index | 255 << SLOT_BITS
    slow = replace(field, index=torch.where(field.index <= 0, -1, full))
    origins, directions = random_rays()
    # Samples do not fall on the same places: short steps make that a small difference.
    quick, careful = (march(origins, directions, f, settings(contracted, 0.1)) for f in (field, slow))
    assert float(careful.opacity.mean()) > 0.03
    assert float((quick.opacity - careful.opacity).abs().mean()) < 0.003
    assert float((quick.color - careful.color).abs().mean()) < 0.003


def test_opacity_of_a_slab_is_that_of_its_cells() -> None:
    """A ray along x through two blocks of 8 cells of opacity α each: 1 − (1 − α)¹⁶, whatever the step."""
    field = even_field(64, torch.tensor([[3, 4, 4], [4, 4, 4]]))
    alpha = (64 / 255) ** 2
    y = (4.5 / SIDE) * 2 - 1
    origins, directions = torch.tensor([[-3.0, y, y]]), torch.tensor([[1.0, 0.0, 0.0]])
    for step in (0.25, 0.5, 1.0):
        found = march(origins, directions, field, settings(False, step))
        opacity = 1 - (1 - alpha) ** 16
        assert float(found.opacity[0]) == pytest.approx(opacity, rel=2e-3)
        assert float(found.color[0, 0]) == pytest.approx(opacity * 0.2, rel=2e-3)
        assert found.probabilities is None
    # mean distance of an absorber between x = −0.25 and 0.25
    sigma = -math.log(1 - alpha) * SIDE * 8 / 2
    expected = 2.75 + 1 / sigma - 0.5 * math.exp(-sigma * 0.5) / (1 - math.exp(-sigma * 0.5))
    assert float(found.depth[0] / found.opacity[0]) == pytest.approx(expected, abs=0.004)


def test_hiding_a_class_shows_what_is_behind() -> None:
    places = torch.tensor([[2, 4, 4], [5, 4, 4]])
    texels = torch.full((2, VERTICES**3, 2, 4), 128, dtype=torch.uint8)
    texels[:, :, 0] = torch.tensor([0, 0, 0, 255], dtype=torch.uint8)
    texels[0, :, 0, 0], texels[1, :, 0, 1] = 255, 255  # red before green
    texels[:, :, 1, 0] = torch.tensor([[0], [1]], dtype=torch.uint8)
    texels[:, :, 1, 1] = 255
    texels[:, :, 1, 2] = 1
    y = (4.5 / SIDE) * 2 - 1
    origins, directions = torch.tensor([[-3.0, y, y]]), torch.tensor([[1.0, 0.0, 0.0]])
    for hidden, color in ((None, [1.0, 0.0, 0.0]), (0, [0.0, 1.0, 0.0])):
        opacity = torch.ones(256)
        if hidden is not None:
            opacity[hidden] = 0
        _, field = made(places, texels.flatten(0, 1), None, opacity, 0.0, 2)
        found = march(origins, directions, field, settings(False))
        assert found.probabilities is not None
        assert found.color[0].tolist() == pytest.approx(color, abs=1e-3)
        assert int(found.probabilities[0].argmax()) == (0 if hidden is None else 1)


def test_colours_change_with_the_direction() -> None:
    """The change along x is +½ · 0.4 for a ray towards +x and the opposite for one towards −x."""
    texels = torch.full((VERTICES**3, 2, 4), 128, dtype=torch.uint8)
    texels[:, 0, 3] = 255
    changes = torch.full((COARSE**3, 3, 4), 128, dtype=torch.uint8)
    changes[:, 0, :3] = 191  # half of the range
    _, field = made(torch.tensor([[4, 4, 4]]), texels, changes, None, 0.4)
    y = (4.5 / SIDE) * 2 - 1
    origins = torch.tensor([[-3.0, y, y], [3.0, y, y]])
    directions = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    color = march(origins, directions, field, settings(False)).color[:, 0]
    assert color.tolist() == pytest.approx([128 / 255 + 0.2, 128 / 255 - 0.2], abs=0.004)


@CONTRACTED
def test_an_empty_field_is_transparent(device: torch.device, contracted: bool) -> None:
    field = moved(even_field(255, torch.zeros(0, 3, dtype=torch.int64)), device)
    origins, directions = (tensor.to(device) for tensor in random_rays(50))
    found = march(origins, directions, field, settings(contracted))
    assert float(found.opacity.abs().max()) == 0
    assert march(origins[:0], directions[:0], field, settings(contracted)).color.shape == (0, 3)


def test_the_index_tells_distances() -> None:
    index = Blocks(4, torch.tensor([[0, 0, 0]]), torch.ones(VERTICES**3, dtype=torch.uint8)).index().view(4, 4, 4)
    assert index[0, 0, 0] == 1 + (255 << SLOT_BITS)
    assert index[0, 0, 3] == -3
    assert index[2, 1, 0] == -2
    assert np.unique(index.numpy())[:-1].tolist() == [-3, -2, -1]


def test_the_index_tells_empty_octants() -> None:
    """A vertex in the middle of a side belongs to all octants beside it."""
    roots = torch.zeros(2, VERTICES, VERTICES, VERTICES, dtype=torch.uint8)
    roots[0, 0, 0, 8] = 1  # z, y low, x high
    roots[1, 8, 4, 0] = 1
    index = Blocks(4, torch.tensor([[0, 0, 0], [1, 0, 0]]), roots.view(-1)).index()
    assert [int(entry) >> SLOT_BITS for entry in index[:2]] == [0b00000010, 0b01010000]
    assert [int(entry) & ((1 << SLOT_BITS) - 1) for entry in index[:2]] == [1, 2]


def test_reads_are_counted_to_where_the_shader_ends() -> None:
    assert voxel_march_torch.SHADER_STOP == LEAST_LEFT


def test_reads_of_textures_are_counted() -> None:
    """Rays beside the cube read nothing; in a wholly opaque one the index, a sample, and three times its changes; where there
    is hardly anything, a sample for each cell, and the index once a block."""
    along = torch.tensor([[1.0, 0.0, 0.0]])
    here, full = settings(False), torch.ones(SIDE, SIDE, SIDE).nonzero()
    meeting, beside = torch.tensor([[-3.0, 0.01, 0.01]]), torch.tensor([[-3.0, 5.0, 0.01]])
    reads = voxel_march_torch.texture_reads
    assert float(reads(beside, along, even_field(255, full), here)[0]) == 0
    assert float(reads(meeting, along, even_field(255, full), here)[0]) == 1 + 1 + 3
    thin = float(reads(meeting, along, even_field(1, full), here)[0])
    assert thin == pytest.approx(SIDE * 8 + SIDE + 3, abs=2)
    for marked, more in ((False, 0), (True, 2 + 4)):
        marks = torch.full((len(full),), marked)
        edited = float(reads(meeting, along, even_field(255, full), here, marks)[0])
        assert edited == 1 + 1 + 3 + 1 + more, (
            "the mark; the vertex, its classes, two rows of the table for each of these"
        )
    one = torch.tensor([[0, SIDE // 2, SIDE // 2]])
    assert float(reads(meeting, along, even_field(255, one), here)[0]) == 1 + 1 + 3
    behind = torch.tensor([[SIDE - 1, SIDE // 2, SIDE // 2]])
    assert 6 <= float(reads(meeting, along, even_field(255, behind), here)[0]) <= 12, "empty blocks are leapt over"
