"""The files of a mesh whose things were renamed, joined or split by hand, with the things as they are now."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import ProjectError
from ..files import UNREADABLE_ARRAYS, atomic_path
from ..mesh.formats import FORMATS
from ..mesh.instances import Instance
from ..mesh.parts import Texture
from ..mesh.stored import MESH, level_names, load_surface, mesh_folder, mesh_record
from ..mesh.surface import Surface
from ..progress import Reporter
from ..project.label_revision import LABEL_REVISION
from ..project.store import load_project


def write_files(
    here: Path, folder: Path, run: str, instances: Sequence[Instance], numbers: np.ndarray | None, report: Reporter
) -> None:
    """Write into `here` the files of a run's mesh and of its levels of detail that know its things. Of files elsewhere, which
    the user asked for, a warning says that they are as before.

    Args:
        numbers: the instance (F,) of each face of the mesh now; None where all have the one that they had.
    Raises:
        ProjectError: a file of the mesh is damaged. DiskError.
    """
    from ..mesh.features import features_of
    from ..mesh.files import write_surface  # with its libraries, a quarter of a second

    project, target, record = load_project(folder), mesh_folder(folder, run), mesh_record(folder, run)
    own = {target / "mesh.ply"}

    def write(name: str, surface: Surface, split: str, texture: Texture | None = None) -> None:
        revision = record.result.get(LABEL_REVISION)
        features = features_of(surface, project.classes, project.ignore_id, instances, revision)
        write_surface(here / name, surface, features, split, texture, check=report.check)

    full = None
    if numbers is not None:
        full, _ = load_surface(folder, run)
        _write_numbers(target / MESH, here / MESH, numbers)
        write("mesh.ply", replace(full, face_instance=numbers), "none")
    for level in range(1, 1 + len(record.result.get("lods", []))):
        name, file = level_names(level)[0], target / f"mesh_lod{level}.glb"
        if not (target / name).is_file():
            continue
        surface, texture = load_surface(folder, run, level)
        if numbers is not None and full is not None and surface.face_instance is not None:
            now = _as_in(surface, full, numbers)
            surface = replace(surface, face_instance=now)
            _write_numbers(target / name, here / name, now)
        if file.is_file():
            write(file.name, surface, record.settings.get("split", "none"), texture)
            own.add(file)
    others = [Path(f) for f in record.result.get("files", []) if Path(f).suffix.lower() in FORMATS]
    others = [path for path in others if target / path.name not in own and path.is_file()]
    if others:
        report.warn(
            f"{others[0]}{f' and {len(others) - 1} more' if others[1:] else ''} still has the things as they were before: "
            "`fieldwork export` writes them as they are now."
        )


def _as_in(level: Surface, full: Surface, numbers: np.ndarray) -> np.ndarray:
    """The instance of each face of a level of detail where those of the full surface are `numbers` (F,) now."""
    before, level_before = full.face_instance, level.face_instance
    assert before is not None
    assert level_before is not None
    changed = np.unique(before[before != numbers])
    own, there = np.flatnonzero(np.isin(level_before, changed)), np.flatnonzero(np.isin(before, changed))
    if not len(own):
        return level_before
    from ..kernels.closest import ClosestPoints  # torch and Warp

    middle = level.vertices[level.faces[own]].mean(1)
    found = level_before.copy()
    found[own] = numbers[there][ClosestPoints(full.vertices, full.faces[there]).find(middle)[0]]
    return found


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a stored mesh. Raises ProjectError."""
    try:
        with np.load(path, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except (*UNREADABLE_ARRAYS, KeyError) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Run `fieldwork mesh` again.") from error


def _write_numbers(source: Path, path: Path, numbers: np.ndarray) -> None:
    """Write a stored mesh whose faces have other instances. Raises ProjectError, DiskError."""
    arrays = read_arrays(source)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **{**arrays, "face_instance": numbers})  # pyright: ignore[reportArgumentType]
