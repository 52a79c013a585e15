"""The capture project: a folder that holds everything known about one capture.

    project.json        this schema: images, classes, frame, provenance
    images/ labels/ masks/ depth/   working copies, same stem for one photo
    poses/poses.json    estimated or imported cameras; poses/points.npz the sparse points
    runs/<name>/        config.json, field.safetensors, events.jsonl, metrics.json, …
    jobs/               status of the running and the last job of each verb
    exports/            meshes, .blend files, renders

Every write is atomic. Nothing here is ever pickled.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, TypeVar
from zipfile import BadZipFile

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from .data.cameras import Camera
from .data.scene import ClassInfo, Points, Scene, View
from .errors import ProjectError
from .files import atomic_path, disk_errors, write_json

FORMAT = "fieldwork-project"
VERSION = 1
PROJECT_FILE = "project.json"
POSES_FILE = "poses/poses.json"
POINTS_FILE = "poses/points.npz"
M = TypeVar("M", bound=BaseModel)
IDENTITY = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


class Model(BaseModel):
    model_config = ConfigDict(extra="forbid")


class ImageRecord(Model):
    """One ingested photo. Paths are relative to the project folder and use forward slashes.

    `status`: "ok", "rejected" (never used; `reason` says why) or "unregistered" (no pose found).
    `source` is where the original came from, `sha256` its hash; `width`/`height` those of the working copy.
    """

    name: str
    file: str = ""
    source: str = ""
    sha256: str = ""
    width: int = 0
    height: int = 0
    camera_group: str = ""
    focal_px: float | None = None
    exif: dict[str, Any] = {}
    sharpness: float | None = None
    label: str | None = None
    mask: str | None = None
    confidence: str | None = None  # how sure the labels are, 8-bit grey
    depth: str | None = None
    split: Literal["train", "test", "auto"] = "auto"
    status: Literal["ok", "rejected", "unregistered"] = "ok"
    reason: str = ""


class SemanticClass(Model):
    """A class of the label maps; id 0 is void unless `Project.ignore_id` says otherwise."""

    id: int = Field(ge=0)
    name: str
    color: tuple[float, float, float]
    priority: float = Field(default=1.0, ge=0)


class Frame(Model):
    """How the SfM frame lies in the world: z up, metres once `scale_known`."""

    world_from_sfm: list[list[float]] = IDENTITY
    up_confidence: float | None = None
    scale_known: bool = False
    bounds: list[list[float]] | None = None  # region of interest in the world: [min, max]


class ProvenanceStep(Model):
    verb: str
    time: str
    version: str
    settings: dict[str, Any] = {}
    result: dict[str, Any] = {}


class Project(Model):
    format: Literal["fieldwork-project"] = FORMAT
    version: int = VERSION
    created: str = Field(default_factory=lambda: now())
    images: list[ImageRecord] = []
    classes: list[SemanticClass] = []
    ignore_id: int = 0
    mask_mode: Literal["ignore", "empty"] = "ignore"
    frame: Frame = Frame()
    provenance: list[ProvenanceStep] = []

    def record(self, verb: str, settings: dict[str, Any], result: dict[str, Any]) -> None:
        """Append one step to the provenance."""
        from . import __version__

        self.provenance.append(
            ProvenanceStep(verb=verb, time=now(), version=__version__, settings=settings, result=result)
        )


class PosedImage(Model):
    """Pose of one registered image: camera-to-world 4×4 in the SfM frame, OpenCV axes."""

    name: str
    camera: int
    camera_to_world: list[list[float]]


class Poses(Model):
    """Registered images. `reprojection_px` and `report` come from SfM, absent for imported poses."""

    version: int = 1
    source: str = ""
    cameras: list[Camera] = []
    images: list[PosedImage] = []
    reprojection_px: float | None = None


def now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def load_project(folder: Path) -> Project:
    """Read `folder`/project.json.

    Raises:
        ProjectError: it is missing, foreign, truncated or from a newer version.
    """
    path = Path(folder) / PROJECT_FILE
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
    return _validated(Project, value, path)


def save_project(folder: Path, project: Project) -> None:
    """Atomically write `folder`/project.json. Raises DiskError when it cannot be written."""
    write_json(Path(folder) / PROJECT_FILE, project.model_dump(mode="json"))


def record_step(folder: Path, verb: str, settings: dict[str, Any], result: dict[str, Any]) -> None:
    """Append one step to the provenance of a project on disk, whatever else has changed in it meanwhile."""
    project = load_project(folder)
    project.record(verb, settings, result)
    save_project(folder, project)


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
    except (ValueError, OSError, KeyError, BadZipFile) as error:
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
    except (ValueError, OSError, KeyError, BadZipFile) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Run `fieldwork poses` again.") from error
    return {image.name: point[view == i] for i, image in enumerate(load_poses(folder).images)}


def world_from_sfm(project: Project) -> np.ndarray:
    """Similarity (4, 4) from the SfM frame to the Blender world."""
    return np.array(project.frame.world_from_sfm, np.float64)


def load_scene(folder: Path) -> Scene:
    """The posed views of a project in the world frame, split into train and test.

    Images whose split is "auto" are divided as usual for captures: every 8th one is held out, starting with the
    first, unless the project names test images itself.
    """
    folder = Path(folder)
    project, poses = load_project(folder), load_poses(folder)
    records = {image.name: image for image in project.images if image.status != "rejected"}
    views, splits = [], []
    for posed in sorted(poses.images, key=lambda image: image.name):
        record = records.get(posed.name)
        if record is None:
            continue
        views.append(
            View(
                name=posed.name,
                camera=poses.cameras[posed.camera],
                camera_to_world=np.array(posed.camera_to_world, np.float64),
                image=folder / record.file,
                label=folder / record.label if record.label else None,
                mask=folder / record.mask if record.mask else None,
                confidence=folder / record.confidence if record.confidence else None,
                depth=folder / record.depth if record.depth else None,
            )
        )
        splits.append(record.split)
    if not views:
        raise ProjectError(f"{folder} has no posed images.", "Run `fieldwork poses` again.")
    train, test = split_views(splits)
    bounds = np.array(project.frame.bounds, np.float64) if project.frame.bounds else None
    scene = Scene(
        views=views,
        train=train,
        test=test,
        classes=[ClassInfo(c.id, c.name, c.color, c.priority) for c in project.classes],
        ignore_id=project.ignore_id,
        points=load_points(folder),
        mask_mode=project.mask_mode,
    ).transformed(world_from_sfm(project), "world")
    return Scene(**{**vars(scene), "bounds": bounds})


def split_views(splits: list[str]) -> tuple[list[int], list[int]]:
    """Indices of training and held-out views from the "train"/"test"/"auto" marks of all views, in name order."""
    if "test" in splits:
        return [i for i, s in enumerate(splits) if s != "test"], [i for i, s in enumerate(splits) if s == "test"]
    automatic = [i for i, s in enumerate(splits) if s == "auto"]
    held_out = set(automatic[::8]) if len(automatic) >= 8 else set()
    return [i for i in range(len(splits)) if i not in held_out], sorted(held_out)


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
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise ProjectError(f"{path} is damaged: {place}: {first['msg']}.", "Restore it from a backup.") from error
