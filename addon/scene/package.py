"""Reads the package that the engine prepares for Blender (see nerfcore/blender/package.py); no bpy here."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import SceneError
from ..roles import Owner

FORMAT, VERSION = "fieldwork-package", 1
SENSOR_MM = 36.0


class PackageError(SceneError):
    """The folder is no package, is damaged, or comes from a newer Fieldwork."""


@dataclass(frozen=True)
class Package:
    """One capture: `name` of its folder and `uuid` (may be empty) of its project. Points: `xyz` (N, 3), `rgb` (N, 3) uint8. `mesh` holds the arrays of mesh.npz, or None.

    `texture` is a picture for the mesh's "uv" (F, 3, 2), v upwards; None where colours are the vertices'. `instances` are
    the entries {"id", "name", "class_id"} for the mesh's "face_instance", `measures` the areas and volumes of measures.json,
    `relations` how the instances stand to each other: {"subject", "relation", "object"} with their ids; `label_revision`: of
    the marks that the mesh's classes are from, None where they are from none.
    """

    folder: Path
    name: str
    uuid: str
    classes: list[dict[str, Any]]
    ignore_id: int
    cameras: list[dict[str, Any]]
    xyz: np.ndarray
    rgb: np.ndarray
    mesh: dict[str, np.ndarray] | None
    texture: Path | None
    instances: list[dict[str, Any]]
    measures: dict[str, Any]
    relations: list[dict[str, Any]] = field(default_factory=list)
    label_revision: int | None = None


class BlenderCamera(NamedTuple):
    """Settings of a Blender camera with horizontal sensor fit that equal a pinhole in pixels.

    The pixel aspect belongs to the scene's render settings: `aspect` is (x, y), 1 and 1 for square pixels.
    """

    lens: float
    shift_x: float
    shift_y: float
    aspect: tuple[float, float]


def blender_camera(entry: dict[str, Any]) -> BlenderCamera:
    """Blender's form of a pinhole camera with width, height, fx, fy, cx, cy in pixels.

    Blender scales by the width, so fx alone fixes the lens; fy ≠ fx is the shape of the pixels. The shifts are the
    way from the principal point to the image's centre in widths; x to the right, y up.
    """
    width, height, fx, fy = entry["width"], entry["height"], entry["fx"], entry["fy"]
    tall = fx / fy  # height of a pixel over its width
    if abs(tall - 1) < 1e-6:
        tall = 1.0
    return BlenderCamera(
        lens=fx * SENSOR_MM / width,
        shift_x=(width / 2 - entry["cx"]) / width,
        shift_y=(entry["cy"] - height / 2) / width * tall,
        aspect=(1.0, tall) if tall >= 1 else (1 / tall, 1.0),
    )


def read_package(folder: Path | str) -> Package:
    """Read a package folder.

    Raises:
        PackageError: something of it is missing, damaged or newer than this add-on.
    """
    folder = Path(folder)
    try:
        value = json.loads((folder / "package.json").read_text("utf-8"))
    except OSError as error:
        raise PackageError(f"{folder} is not a Fieldwork package: {error.strerror}.") from error
    except ValueError as error:
        raise PackageError(f"{folder / 'package.json'} is damaged: {error}.") from error
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise PackageError(f"{folder} is not a Fieldwork package.")
    if value["version"] > VERSION:
        raise PackageError(f"{folder} was made by a newer Fieldwork. Update the extension.")
    points = _arrays(folder / "points.npz")
    mesh = _arrays(folder / "mesh.npz") if value["mesh"] else None
    return Package(
        folder=folder,
        name=value["name"],
        uuid=value.get("uuid") or "",
        classes=value["classes"],
        ignore_id=value["ignore_id"],
        cameras=value["cameras"],
        xyz=points["xyz"],
        rgb=points["rgb"],
        mesh=mesh,
        texture=folder / value["texture"] if value.get("texture") else None,
        instances=value.get("instances") or [],
        measures=value.get("measures") or {},
        relations=value.get("relations") or [],
        label_revision=value.get("label_revision"),
    )


def sketch_package(path: Path, owner: Owner, project: dict[str, Any]) -> Package:
    """A first look at the surface, as a package of nothing else; `project`: what the project file says.

    Raises:
        PackageError: it cannot be read.
    """
    return Package(
        folder=path.parent,
        name=owner.name,
        uuid=owner.uuid,
        classes=project.get("classes", []),
        ignore_id=project.get("ignore_id", 0),
        cameras=[],
        xyz=np.zeros((0, 3), np.float32),
        rgb=np.zeros((0, 3), np.uint8),
        mesh=_arrays(path),
        texture=None,
        instances=[],
        measures={},
    )


def _arrays(path: Path) -> dict[str, np.ndarray]:
    from ...nerfcore.files import UNREADABLE_ARRAYS  # not at the top: enabling the extension must be quick

    try:
        with np.load(path, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except UNREADABLE_ARRAYS as error:
        raise PackageError(f"{path} cannot be read: {error}.") from error
