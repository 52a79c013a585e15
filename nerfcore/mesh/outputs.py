"""What `mesh` leaves on disk: all of it, or, where it is stopped, what was there before."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..data.box import Box
from ..data.scene import Scene
from ..files import atomic_path, staged
from ..geometry.similarity import transform_points
from ..params import MeshParams
from ..progress import Reporter
from ..project.runs import MEASURES, MESH_RECORD, SCENE_GRAPH
from ..project.store import load_project
from ..project.written import remove_former
from .build import Built
from .features import features_of
from .instances import Instance, write_instances, write_kept
from .lods import Level, level_files, write_level
from .painted import MAPS, Painted, write_maps
from .parts import Texture
from .stored import COARSE, MESH, TEXTURE
from .surface import Surface
from .turntable import write_pictures


@dataclass(frozen=True)
class Made:
    """A finished mesh in the world: `built`, in the frame of `box`, is what it was made of; pictures: by file name, of
    the turntable; beyond: instances that are known and lie outside of its region; world_from_marks: see `write_kept`; label_revision: of the marks that its classes are from, if they are from any."""

    surface: Surface
    texture: Texture | None
    painted: Painted
    built: Built
    box: Box
    instances: list[Instance]
    beyond: list[Instance]
    world_from_marks: np.ndarray
    levels: list[Level]
    pictures: dict[str, np.ndarray]
    label_revision: int | None = None


class Places(ExitStack):
    """Folders in which files wait, see `staged`, until those for all folders are written."""

    def __init__(self) -> None:
        super().__init__()
        self._goals: dict[Path, Path] = {}

    def waiting(self, folder: Path) -> Path:
        """Where files for a folder are written first."""
        place = self.enter_context(staged(folder))
        self._goals[place] = folder
        return place

    def goals(self, files: Iterable[Path]) -> list[Path]:
        """Where files that wait come to."""
        return [self._goals[path.parent] / path.name for path in files]


def write_outputs(target: Path, made: Made, scene: Scene, params: MeshParams, report: Reporter) -> list[Path]:
    """Write a mesh to its folder, to the file that was asked for, and its turntable. Nothing that was there is changed
    before everything is written.

    Returns:
        the files written.
    Raises:
        DiskError: one cannot be written. Cancelled.
    """
    from .files import write_surface  # with its libraries, a quarter of a second

    with Places() as places:
        here = places.waiting(target)
        there = places.waiting(params.out.parent) if params.out is not None else here
        files = _write_arrays(here, made) + [write_instances(here, made.instances)]
        write_kept(here, made.beyond, made.world_from_marks)
        files += write_maps(here, made.painted, {c.id: c.color for c in scene.classes}, report.check)
        surface = made.surface
        features = features_of(surface, scene.classes, scene.ignore_id, made.instances, made.label_revision)
        files += write_surface(here / "mesh.ply", surface, features, "none", check=report.check)
        if params.out is not None:
            out = there / params.out.name
            files += write_surface(out, surface, features, params.split, made.texture, check=report.check)
        for number, level in enumerate(made.levels, 1):
            report.progress(number / (len(made.levels) + 1))
            files += write_level(here, number, level, report.check)
            features = features_of(level.surface, scene.classes, scene.ignore_id, made.instances, made.label_revision)
            base = Path("mesh.glb") if params.out is None else params.out
            path = there / f"{base.stem}_lod{number}{base.suffix}"
            files += write_surface(path, level.surface, features, params.split, level.texture, check=report.check)
        if params.turntable is not None:
            files += write_pictures(places.waiting(params.turntable), made.pictures, report)
        report.check()
        # From here on nothing stops it. What these say is no longer true, and what has no successor goes.
        written = {path.name for path in files if path.parent == here}
        for path in [target / MESH_RECORD, target / MEASURES, target / SCENE_GRAPH, *level_files(target)]:
            path.unlink(missing_ok=True)
        for name in {TEXTURE, *MAPS} - written:
            (target / name).unlink(missing_ok=True)
    files = places.goals(files)
    if params.out is not None:
        remove_former(load_project(params.project), "mesh", params.out, files)
    return files


def _write_arrays(folder: Path, made: Made) -> list[Path]:
    """Write mesh.npz, and the coarse surface that `measure` compares it with."""
    painted, built = made.painted, made.built
    sure = {"confidence": painted.classes.confidence, "face_confidence": painted.classes.face_confidence}
    uv = {} if painted.uv is None else {"uv": painted.uv.corners}
    unseen = {} if built.unseen is None else {"unseen": built.unseen}
    with atomic_path(folder / MESH) as temporary, open(temporary, "wb") as file:
        np.savez(file, **vars(made.surface), **sure, **uv, **unseen)
    with atomic_path(folder / COARSE) as temporary, open(temporary, "wb") as file:
        vertices, faces = built.coarse
        np.savez(file, vertices=transform_points(made.box.world_from_box, vertices), faces=faces)
    return [folder / MESH, folder / COARSE]
