"""The baked field as a volume: grids of density and colour, and one for each class, in a file of OpenVDB."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..data.box import Box
from ..errors import ProjectError
from ..geometry.similarity import similarity_scale
from ..images.picture import srgb_to_linear
from ..kernels.voxel_field import CELLS, TEXELS, VERTICES, occupied_blocks, texels_of
from ..progress import Reporter
from ..project.label_revision import label_facts
from ..render.baked import BakedField
from .vdb import Grid, write_vdb

DENSEST = 0.995  # opacity of a cell; an opaque one would be infinitely dense


def write_volume(
    path: Path, baked: BakedField, box: Box, class_names: list[str], label_revision: int | None, report: Reporter
) -> list[str]:
    """Write the grids and return their names.

    A voxel is a vertex of the baked field, in the world, z up. `density`: extinction for each unit of the world; `color`: linear
    (primaries of sRGB), without its changes with the direction; `class_NAME`: the class's probability; metadata of the file
    name the `label_revision` of the marks that classes are from, if they are from any. Of a field with a
    background beyond its cube only the cube is written: outside of it cells grow.

    Raises:
        ProjectError: the baked field is empty. DiskError.
    """
    report.stage("Reading the baked field")
    field = baked.field
    texels = texels_of(field.vertices, TEXELS)
    rows, places = solid_vertices(field.index.cpu().numpy(), field.blocks, texels[:, 0, 3] > 0)
    side = field.blocks * CELLS
    if box.contracted:
        inside = (np.abs(places / side - 0.5) <= 0.25).all(1)
        rows, places = rows[inside], places[inside]
    if not len(rows):
        raise ProjectError("The baked field is empty.", "Train longer, and run `fieldwork bake` again.")
    cell = (4.0 if box.contracted else 2.0) / side
    opacity = ((texels[rows, 0, 3] / 255.0) ** 2).clip(0, DENSEST)
    density = -np.log1p(-opacity) / (cell * similarity_scale(box.world_from_box))
    color = srgb_to_linear(texels[rows, 0, :3].astype(np.float32) / 255)
    grids = [Grid("density", places, density), Grid("color", places, color)]
    share = texels[rows, 1, 1] / np.float32(255)
    for index, name in enumerate(class_names):
        mine = np.where(texels[rows, 1, 0] == index, share, 0) + np.where(texels[rows, 1, 2] == index, 1 - share, 0)
        some = mine > 0
        grids.append(Grid(f"class_{name}", places[some], mine[some]))
    report.check()
    report.stage("Writing")
    world_from_index = box.world_from_box @ np.diag([cell, cell, cell, 1.0])
    world_from_index[:3, 3] = box.world_from_box[:3, 3] - world_from_index[:3, :3] @ np.full(3, side / 2)
    write_vdb(path, grids, world_from_index, label_facts(label_revision))
    return [grid.name for grid in grids]


def solid_vertices(index: np.ndarray, blocks: int, solid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows (N,) of the vertices that are `solid` (S · 9³,), and where they are (N, 3) in cells; those that blocks share
    come once."""
    occupied, order = occupied_blocks(index)
    corners = np.zeros((len(occupied), 3), np.int64)
    corner = np.stack([occupied % blocks, occupied // blocks % blocks, occupied // blocks**2], 1) * CELLS
    corners[order] = corner
    rows = np.flatnonzero(solid)
    block, local = np.divmod(rows, VERTICES**3)
    place = np.stack([local % VERTICES, local // VERTICES % VERTICES, local // VERTICES**2], 1)
    places = corners[block] + place
    side = blocks * CELLS + 1
    _, once = np.unique((places[:, 2] * side + places[:, 1]) * side + places[:, 0], return_index=True)
    return rows[once], places[once]
