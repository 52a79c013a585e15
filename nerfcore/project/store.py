"""The capture project: a folder that holds everything known about one capture.

    project.json        this schema: images, classes, frame, provenance
    images/ labels/ masks/ depth/   working copies, same stem for one photo
    poses/poses.json    estimated or imported cameras; poses/points.npz the sparse points
    runs/<name>/        config.json, field.safetensors, events.jsonl, metrics.json, …
    jobs/               status of the running and the last job of each verb
    exports/            meshes, .blend files, renders

Every write is atomic. Nothing here is ever pickled. project.json is read, changed and written under a lock of its own
(`edit_project`) that nobody holds for long: an edit during a training is neither lost nor overwritten.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from filelock import FileLock, Timeout
from pydantic import BaseModel, ValidationError

from ..errors import ProjectError, wrong_value
from ..files import UNREADABLE_ARRAYS, atomic_path, disk_errors, write_json
from ..geometry.points import Points
from .migrate import migrated
from .schema import FORMAT, VERSION, Poses, Project

PROJECT_FILE = "project.json"
POSES_FILE = "poses/poses.json"
POINTS_FILE = "poses/points.npz"
FRAMES_FOLDER = "frames"  # of the frames of a video
FRAMES_FILE = "frames.json"  # in there: which they are
LOCK_FILE = "jobs/project.lock"
PATIENCE = 30.0  # seconds to wait for another edit, which takes milliseconds
M = TypeVar("M", bound=BaseModel)


def load_project(folder: Path) -> Project:
    """Read `folder`/project.json.

    Raises:
        ProjectError: it is missing, foreign, truncated or from a newer version.
    """
    path = Path(folder) / PROJECT_FILE
    if not Path(folder).exists():
        raise ProjectError(
            f"{folder} is not a capture project: the folder is not there.",
            "Connect the disk it is on, or choose the folder it was moved to.",
        )
    value = _read_json(path, f"{folder} is not a capture project: it has no {PROJECT_FILE}.")
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise ProjectError(
            f"{path} was not written by Fieldwork.", "Choose a folder made by `fieldwork new` or `import`."
        )
    if isinstance(value.get("version"), int) and value["version"] > VERSION:
        raise ProjectError(
            f"{path} has version {value['version']}; this Fieldwork reads up to {VERSION}.",
            "Update Fieldwork to open it.",
        )
    return _validated(Project, migrated(value), path)


@contextmanager
def locked(path: Path, lock_file: Path) -> Iterator[None]:
    """Keep other programs from changing the file `path` during the block: they wait for the lock beside it, as this does.

    Raises:
        ProjectError: it stays locked. DiskError: the lock cannot be made.
    """
    with disk_errors(lock_file):
        lock_file.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(lock_file, thread_local=False)
        try:
            lock.acquire(timeout=PATIENCE)
        except Timeout as error:
            raise ProjectError(
                f"{path} has been locked by another program for {PATIENCE:.0f} s.", "End that program, then try again."
            ) from error
    try:
        yield
    finally:
        lock.release()


@contextmanager
def edit_project(folder: Path, fresh: Project | None = None) -> Iterator[Project]:
    """Read project.json, let the block change it, write it: no other edit comes between. Keep the block short. Ids of classes
    that the block removes are noted, so that no new class gets them.

    Args:
        fresh: what to begin with where there is no project yet.
    Raises:
        ProjectError: there is no project, or it stays locked. DiskError. The block's own errors: nothing is written.
    """
    folder = Path(folder)
    if fresh is None or is_project(folder):
        load_project(folder)  # says what is wrong before a lock file is made
    with locked(folder / PROJECT_FILE, folder / LOCK_FILE):
        project = load_project(folder) if fresh is None or is_project(folder) else fresh
        before = {*project.former_class_ids, *(c.id for c in project.classes)}
        yield project
        project.former_class_ids = sorted(before - {c.id for c in project.classes})
        save_project(folder, project)


def save_project(folder: Path, project: Project) -> None:
    """Atomically write `folder`/project.json as a whole; whoever changes one that is there uses `edit_project`.

    Raises:
        DiskError: it cannot be written.
    """
    write_json(Path(folder) / PROJECT_FILE, project.model_dump(mode="json"))


def record_step(
    folder: Path,
    verb: str,
    settings: dict[str, Any],
    result: dict[str, Any],
    inputs: dict[str, str] | None = None,
) -> None:
    """Append one step to the provenance of a project on disk, whatever else has changed in it meanwhile."""
    with edit_project(folder) as project:
        project.record(verb, settings, result, inputs)


def is_project(folder: Path) -> bool:
    return (Path(folder) / PROJECT_FILE).is_file()


def load_poses(folder: Path) -> Poses:
    """Read the camera poses of a project. Raises ProjectError when there are none or the file is damaged."""
    path = Path(folder) / POSES_FILE
    value = _read_json(path, f"{folder} has no camera poses yet.", "Run `fieldwork poses` first.")
    return _validated(Poses, value, path)


def save_poses(
    folder: Path, poses: Poses, points: Points, visibility: tuple[np.ndarray, np.ndarray] | None = None
) -> None:
    """Atomically write poses and sparse points (SfM frame).

    `visibility` says which image saw which point: two int arrays (M,), indices into `poses.images` and into points.
    """
    view, point = visibility if visibility is not None else (np.zeros(0, np.int32), np.zeros(0, np.int32))
    with atomic_path(Path(folder) / POINTS_FILE) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, xyz=points.xyz, rgb=points.rgb, error=points.error, view=view, point=point)
    write_json(Path(folder) / POSES_FILE, poses.model_dump(mode="json"))


def load_points(folder: Path) -> Points:
    """Sparse points in the SfM frame; empty when the project has none."""
    path = Path(folder) / POINTS_FILE
    if not path.is_file():
        return Points.empty()
    try:
        with np.load(path, allow_pickle=False) as data:
            return Points(data["xyz"], data["rgb"], data["error"])
    except (*UNREADABLE_ARRAYS, KeyError) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Run `fieldwork poses` again.") from error


def load_visibility(folder: Path) -> dict[str, np.ndarray]:
    """For each image name, the indices (M,) of the sparse points it saw; empty when that is not known."""
    path = Path(folder) / POINTS_FILE
    if not path.is_file():
        return {}
    try:
        with np.load(path, allow_pickle=False) as data:
            if "view" not in data:
                return {}
            view, point = data["view"], data["point"]
    except (*UNREADABLE_ARRAYS, KeyError) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Run `fieldwork poses` again.") from error
    return {image.name: point[view == i] for i, image in enumerate(load_poses(folder).images)}


def world_from_sfm(project: Project) -> np.ndarray:
    """Similarity (4, 4) from the SfM frame to the Blender world."""
    return np.array(project.frame.world_from_sfm, np.float64)


def world_from_marks(project: Project) -> np.ndarray:
    """Similarity (4, 4) to the Blender world from the frame in which marks on the surface and carried labels stand."""
    return world_from_sfm(project) @ np.linalg.inv(np.array(project.frame.marks_from_sfm, np.float64))


def create_folder(folder: Path) -> None:
    """Make the project folder. Raises DiskError when that is not allowed."""
    with disk_errors(folder):
        Path(folder).mkdir(parents=True, exist_ok=True)


def _read_json(path: Path, missing: str, hint: str = "Choose a folder made by `fieldwork new` or `import`.") -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError) as error:
        raise ProjectError(missing, hint) from error
    except OSError as error:
        raise ProjectError(f"{path} cannot be read: {error.strerror}.", "Check its permissions.") from error
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Restore it from a backup.") from error


def _validated(model: type[M], value: Any, path: Path) -> M:
    try:
        return model.model_validate(value)
    except ValidationError as error:
        what = wrong_value(error.errors()[0])
        raise ProjectError(f"{path} is damaged: {what}.", "Restore it from a backup.") from error
