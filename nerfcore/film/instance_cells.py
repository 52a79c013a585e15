"""Single things of a baked field: each vertex belongs to the instance of the nearest face of the mesh that has its class."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ..errors import InputError, ProjectError
from ..geometry.contraction import uncontract
from ..kernels.closest import ClosestPoints
from ..kernels.voxel_field import TEXELS, VERTICES, VoxelField, occupied_blocks, texels_of
from ..mesh.instances import read_instances
from ..mesh.stored import load_surface, mesh_folder
from ..render.baked import BakedField

MOST_INDICES = 256  # of classes, and of things that are told apart from them: a byte
MARGIN = 0.1  # of the diagonal of a thing's faces: how far beside them it may reach


class InstanceCells:
    """The instances of a baked field.

    Args:
        world_from_box: (4, 4). class_ids: of the field's class indices. project, run: whose mesh tells instances apart.
    Raises:
        ProjectError: there is no mesh, or it tells no instances apart.
    """

    def __init__(
        self, baked: BakedField, world_from_box: np.ndarray, class_ids: list[int], project: Path, run: str
    ) -> None:
        self._field = baked.field
        surface, _ = load_surface(project, run)
        self._known = {one.name: one for one in read_instances(mesh_folder(project, run))}
        if surface.face_instance is None or not self._known:
            raise ProjectError(
                f"The mesh of the run “{run}” in {project} tells no things apart.",
                "Give it classes, then run `fieldwork mesh` again.",
            )
        self._vertices, self._faces = surface.vertices.astype(np.float64), surface.faces
        self._face_instance = surface.face_instance.astype(np.int64)
        texels = texels_of(baked.field.vertices, TEXELS)
        solid = texels[:, 0, 3] > 0
        # Instance of each vertex as one of its more probable, and of its less probable class; 0: none.
        self._first, self._second = (np.zeros(len(texels), np.int32) for _ in range(2))
        points = None
        for index, class_id in enumerate(class_ids):
            own = np.flatnonzero(surface.face_class == class_id)
            if not len(own) or not self._face_instance[own].any():
                continue
            first, second = solid & (texels[:, 1, 0] == index), solid & (texels[:, 1, 2] == index)
            rows = np.flatnonzero(first | second)
            if points is None:
                points = vertex_places(baked, world_from_box)
            face, _, _ = ClosestPoints(self._vertices, self._faces[own]).find(points[rows])
            instance = self._face_instance[own][face]
            self._first[rows] = np.where(first[rows], instance, self._first[rows])
            self._second[rows] = np.where(second[rows], instance, self._second[rows])
        self._class_index = {class_id: index for index, class_id in enumerate(class_ids)}
        self._made: tuple[tuple[str, ...], VoxelField] = ((), baked.field)

    def told_apart(self, names: list[str]) -> tuple[VoxelField, list[str], list[int]]:
        """The field with a class index of its own for each of some instances.

        Returns:
            the field; the names of the instances that have the indices after its classes, which may be more than were
            asked for; and the index of the class of each of them
        Raises:
            InputError: there is no such instance, or there are too many.
        """
        for name in names:
            if name not in self._known:
                there = ", ".join(list(self._known)[:20])
                raise InputError(f"The mesh has no thing “{name}”.", f"There are {there}.")
        made, field = self._made
        if not set(names) <= set(made):
            most = MOST_INDICES - self._field.classes
            made = tuple(dict.fromkeys([*names, *made]))
            if len(made) > most:
                made = tuple(dict.fromkeys(names))
            if len(made) > most:
                raise InputError(
                    f"{len(made)} things of one field are edited; at most {most} can be.",
                    "Edit the whole class of some.",
                )
            field = self._split(made)
            self._made = made, field
        return field, list(made), [self._class_index[self._known[name].class_id] for name in made]

    def all_told_apart(self) -> tuple[VoxelField, list[str], list[int]]:
        """As `told_apart`, for all instances; where there are too many, for the largest. Nothing is kept."""
        known = sorted(self._known.values(), key=lambda one: -one.area)
        known = [one for one in known if one.class_id in self._class_index][: MOST_INDICES - self._field.classes]
        names = tuple(one.name for one in known)
        return self._split(names), list(names), [self._class_index[one.class_id] for one in known]

    def _split(self, names: tuple[str, ...]) -> VoxelField:
        classes, words = self._field.classes, self._field.vertices.clone()
        texels = words.view(torch.uint8).reshape(-1, TEXELS, 4)
        for number, name in enumerate(names):
            for byte, of_vertex in ((0, self._first), (2, self._second)):
                rows = torch.from_numpy(np.flatnonzero(of_vertex == self._known[name].id)).to(words.device)
                texels[rows, 1, byte] = classes + number
        opacity = self._field.class_opacity.clone()
        for number, name in enumerate(names):
            opacity[classes + number] = opacity[self._class_index[self._known[name].class_id]]
        return replace(self._field, vertices=words, class_opacity=opacity, classes=classes + len(names))

    def world_from_cube(self, name: str) -> np.ndarray:
        """The matrix (4, 4) from the cube [−1, 1]³ to the part of the world in which an instance lies."""
        own = self._vertices[self._faces[self._face_instance == self._known[name].id]].reshape(-1, 3)
        low, high = (own.min(0), own.max(0)) if len(own) else (np.zeros(3), np.ones(3))
        half = (high - low) / 2 + MARGIN * float(np.linalg.norm(high - low))
        matrix = np.diag([*half, 1.0])
        matrix[:3, 3] = (low + high) / 2
        return matrix


def vertex_places(baked: BakedField, world_from_box: np.ndarray) -> np.ndarray:
    """Where the vertices (S · 9³, 3) of a baked field are in the world, in the order of its texels."""
    field, n = baked.field, baked.field.blocks
    cells, number = occupied_blocks(field.index.cpu().numpy())
    cells = cells[np.argsort(number)]
    blocks = np.stack([cells % n, cells // n % n, cells // n**2], 1)
    z, y, x = np.meshgrid(*[np.arange(VERTICES)] * 3, indexing="ij")
    local = np.stack([x, y, z], -1).reshape(1, -1, 3)
    grid = torch.from_numpy((blocks[:, None] + local / (VERTICES - 1)).reshape(-1, 3) / n).float()
    box = uncontract(grid) if baked.settings.contracted else grid * 2 - 1
    return box.numpy() @ world_from_box[:3, :3].T.astype(np.float32) + world_from_box[:3, 3].astype(np.float32)
