"""What every reader of posed data sets returns, before it becomes a capture project."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from ..errors import InputError
from .cameras import Camera
from .scene import Points

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".exr", ".bmp", ".ppm", ".heic", ".heif")

# A world with y up, turned so that z is up.
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True)
class DatasetView:
    """One posed image of a data set. Paths are absolute.

    `camera_to_world` is (4, 4) in the data set's own frame with OpenCV camera axes. `depth_scale` turns the values of
    the depth file into units of that frame (distance along the camera's z axis).
    """

    name: str
    image: Path
    camera: Camera
    camera_to_world: np.ndarray
    label: Path | None = None
    mask: Path | None = None
    depth: Path | None = None
    depth_scale: float = 1.0
    split: Literal["train", "test", "auto"] = "auto"


@dataclass(frozen=True)
class Dataset:
    """A posed data set as read. `world_from_sfm` (4, 4) turns its frame into one with z up."""

    format: str
    views: list[DatasetView]
    world_from_sfm: np.ndarray = field(default_factory=lambda: np.eye(4))
    up_confidence: float | None = None
    scale_known: bool = False
    class_names: dict[int, str] = field(default_factory=dict)
    ignore_id: int = 0
    class_colors: dict[int, tuple[int, int, int]] = field(default_factory=dict)  # in RGB label maps
    points: Points = field(default_factory=Points.empty)
    bounds: np.ndarray | None = None
    warnings: list[str] = field(default_factory=list)
    resources: tuple[object, ...] = ()  # temporary folders that live as long as this


def unique_names(paths: Sequence[Path], root: Path) -> list[str]:
    """A name for each image: its stem, or its path below `root` with "_" for separators when stems repeat.

    White space becomes "_": COLMAP's lists of names are split at it.
    """
    names = [path.stem for path in paths]
    if len(set(map(_joined, names))) < len(names):
        names = ["/".join(_below(path, root).with_suffix("").parts) for path in paths]
    names = [_joined(name) for name in names]
    if len(set(names)) < len(names):  # a.jpg beside a.png
        names = [f"{name}_{path.suffix[1:].lower()}" for name, path in zip(names, paths)]
    if len(set(names)) < len(names):
        names = [f"{name}_{i}" for i, name in enumerate(names)]
    return names


def _joined(name: str) -> str:
    return "_".join(name.replace("/", "_").split()) or "photo"


def _below(path: Path, root: Path) -> Path:
    return path.relative_to(root) if path.is_relative_to(root) else Path(*path.parts[-2:])


def find_image(path: Path) -> Path | None:
    """The image file at `path`, or with a usual image suffix appended when the path has none."""
    if path.is_file():
        return path
    for suffix in IMAGE_SUFFIXES:
        for candidate in (path.with_name(path.name + suffix), path.with_name(path.name + suffix.upper())):
            if candidate.is_file():
                return candidate
    return None


def list_images(folder: Path) -> list[Path]:
    """Image files directly in `folder`, by name."""
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())


def beside(folder: Path, stem: str, exact: bool = True) -> Path | None:
    """The image in `folder` for a photo called `stem`: `<stem>.png`, or when not `exact` also `<stem>*.png|jpg`."""
    for suffix in (".png", ".PNG", ".tif", ".tiff", ".exr", ".jpg", ".JPG", ".jpeg"):
        if (folder / f"{stem}{suffix}").is_file():
            return folder / f"{stem}{suffix}"
    if exact or not folder.is_dir():
        return None
    # "<stem>_mask.png", "<stem>.JPG.png"; not "<stem>0.png", which belongs to another photo.
    found = [p for p in list_images(folder) if p.name.startswith(stem) and not p.name[len(stem)].isalnum()]
    return found[0] if found else None


def require(views: Iterable[DatasetView], source: Path, missing: Sequence[str] = ()) -> list[DatasetView]:
    """The views as a list. Raises InputError when there is none, naming missing image files if that is why."""
    found = list(views)
    if not found:
        why = f"none of its images exists (for example {missing[0]})" if missing else "it has no images"
        raise InputError(f"{source} cannot be imported: {why}.", "Choose the folder that holds the images and poses.")
    return found


def plain_name(image: Path) -> str:
    """The name of an image in sets whose stems are unique."""
    return _joined(image.stem)
