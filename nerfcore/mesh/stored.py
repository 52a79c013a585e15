"""The surface of a run as the verb `mesh` left it on disk."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..errors import ProjectError
from ..files import UNREADABLE_ARRAYS
from ..images.limits import UNDECODABLE
from ..project.fingerprints import moved, read_made
from ..project.runs import MESH_RECORD
from ..project.schema import ProvenanceStep
from ..project.store import load_project
from .parts import Texture, texture_of
from .surface import Surface

MESH = "mesh.npz"
COARSE = "mesh_coarse.npz"  # the same surface at cells of twice the size
TEXTURE = "texture.png"
CLASS_MAP = "class_id.png"
LABEL_FIRST = "Label some photos, then run `fieldwork train` and `fieldwork mesh` again."  # for a mesh without classes


def mesh_folder(project: Path, run: str) -> Path:
    return Path(project) / "exports" / run


def level_names(level: int) -> tuple[str, str]:
    """The names of the surface and the texture of a level of detail; 0 is the full surface."""
    return (f"mesh_lod{level}.npz", f"texture_lod{level}.png") if level else (MESH, TEXTURE)


def load_surface(project: Path, run: str, level: int = 0) -> tuple[Surface, Texture | None]:
    """The surface of a run in the world, and its texture, as `mesh` left them; `level`: of detail, 0 for the full one.

    Raises:
        ProjectError: there is none, or its file is damaged.
    """
    name, picture_name = level_names(level)
    path = mesh_folder(project, run) / name
    with _reading(path, f"{path} is missing." if level else f"The run “{run}” has no mesh yet.") as data:
        stored = [field for field in fields(Surface) if field.name in data or field.default is MISSING]
        surface = Surface(**{field.name: data[field.name] for field in stored})
        uv = data.get("uv", None)
    picture = path.with_name(picture_name)
    if uv is None or not picture.is_file():
        return surface, None
    return surface, texture_of(surface.faces, uv, _picture(picture, "RGB"))


def load_guessed(project: Path, run: str) -> np.ndarray | None:
    """Which triangles (F,) bool of a run's mesh close gaps, or a surface that was to be watertight; None where none do.

    Raises:
        ProjectError: there is no mesh, or its file is damaged.
    """
    with _reading(mesh_folder(project, run) / MESH, f"The run “{run}” has no mesh yet.") as data:
        return data.get("unseen", None)


def load_class_map(project: Path, run: str) -> np.ndarray | None:
    """The class (S, S) of each texel of the texture of a run's mesh; None where `mesh` made none.

    Raises:
        ProjectError: the file is damaged.
    """
    path = mesh_folder(project, run) / CLASS_MAP
    return _picture(path) if path.is_file() else None


def load_coarse(project: Path, run: str) -> tuple[np.ndarray, np.ndarray]:
    """The surface of a run at cells of twice the size, in the world: vertices (V, 3) and faces (F, 3).

    Raises:
        ProjectError: there is none, or its file is damaged.
    """
    path = mesh_folder(project, run) / COARSE
    with _reading(path, f"{path} is missing.") as data:
        return data["vertices"].astype(np.float64), data["faces"]


def _picture(path: Path, mode: str | None = None) -> np.ndarray:
    try:
        with Image.open(path) as image:
            return np.array(image.convert(mode) if mode else image)
    except UNDECODABLE as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Run `fieldwork mesh` again.") from error


@contextmanager
def _reading(path: Path, missing: str) -> Iterator[Any]:
    """The arrays of an .npz that `mesh` wrote; `missing` says that it is not there. Raises ProjectError."""
    try:
        with np.load(path, allow_pickle=False) as data:
            yield data
    except FileNotFoundError as error:
        raise ProjectError(missing, "Run `fieldwork mesh`.") from error
    except (*UNREADABLE_ARRAYS, KeyError) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Run `fieldwork mesh` again.") from error


def mesh_label_revision(project: Path, run: str) -> int | None:
    """The revision of the marks that the classes of a run's mesh are from; None where they are from none."""
    made = read_made(mesh_folder(project, run) / MESH_RECORD)
    return None if made is None else made.result.get("label_revision")


def mesh_record(project: Path, run: str) -> ProvenanceStep:
    """What the mesh of a run was made from, provided that it still lies where the project does.

    Raises:
        ProjectError: nothing is known of the mesh, or the project was turned, moved or scaled since.
    """
    made = read_made(mesh_folder(project, run) / MESH_RECORD)
    if made is None:
        raise ProjectError(f"The run “{run}” has no mesh, or an unfinished one.", "Run `fieldwork mesh` first.")
    require_in_place(project, made)
    return made


def require_in_place(project: Path, made: ProvenanceStep) -> None:
    """Raise ProjectError where the project was turned, moved or scaled since the mesh of this record was made."""
    if moved(made, load_project(project)):
        raise ProjectError(
            "The project was aligned anew since its mesh was made: the mesh lies elsewhere, or is of another size.",
            "Run `fieldwork mesh` again.",
        )
