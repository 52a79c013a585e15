"""The classes of a baked field with an index of its own for each thing, as Blender's viewport has them in a texture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..files import disk_errors
from ..kernels.voxel_field import TEXELS, VERTICES, texels_of
from ..render.baked import to_texture
from .fields import LoadedField


def write_thing_texture(field: LoadedField, path: Path) -> dict[str, Any]:
    """Write a file (npz) with what takes the place of `T1.npy` of a baked field, `texels`, and which of its S blocks have something of
    which class index, `marks` (S, indices) bool.

    Returns:
        {"names", "of_class", "cubes"}: of the things that have the indices after the classes, the index of the class of each,
        and the matrix (4, 4) from the cube [−1, 1]³ to the part of the world in which it lies
    Raises:
        ProjectError: there is no mesh that tells things apart. SettingError: the field is not baked. DiskError.
    """
    things = field.instances
    told, names, of_class = things.all_told_apart()
    texels = texels_of(told.vertices, TEXELS).reshape(-1, VERTICES**3, TEXELS, 4)
    with disk_errors(path), open(path, "wb") as file:
        texture = to_texture(texels[:, :, 1].reshape(-1, *(VERTICES,) * 3, 4))
        np.savez(file, texels=texture, marks=occurring(texels, told.classes))
    return {"names": names, "of_class": of_class, "cubes": [things.world_from_cube(name).tolist() for name in names]}


def occurring(texels: np.ndarray, indices: int) -> np.ndarray:
    """Which of so many class indices occur in each block, (S, indices) bool, of the texels (S, 9³, 2, 4) of its vertices."""
    found = np.zeros((len(texels), indices), bool)
    solid, sure = texels[..., 0, 3] > 0, texels[..., 1, 1] == 255
    for byte, there in ((0, solid), (2, solid & ~sure)):
        block, vertex = there.nonzero()
        found[block, texels[block, vertex, 1, byte]] = True
    return found
