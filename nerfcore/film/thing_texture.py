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
    """Write what takes the place of `T1.npy` of a baked field.

    Returns:
        {"names", "of_class", "cubes"}: of the things that have the indices after the classes, the index of the class of each,
        and the matrix (4, 4) from the cube [−1, 1]³ to the part of the world in which it lies
    Raises:
        ProjectError: there is no mesh that tells things apart. SettingError: the field is not baked. DiskError.
    """
    things = field.instances
    told, names, of_class = things.all_told_apart()
    texels = texels_of(told.vertices, TEXELS)[:, 1].reshape(-1, *(VERTICES,) * 3, 4)
    with disk_errors(path), open(path, "wb") as file:
        np.save(file, to_texture(texels))
    return {"names": names, "of_class": of_class, "cubes": [things.world_from_cube(name).tolist() for name in names]}
