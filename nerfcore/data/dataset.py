"""What every reader of posed data sets returns, before it becomes a capture project."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from ..errors import InputError
from ..geometry.cameras import Camera
from ..geometry.points import Points

# A world with y up, turned so that z is up.
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])

OTHER_SHAPE = 0.02  # difference of proportions that rounding sizes does not explain
FARTHEST = 1e12  # units of a data set's frame: a million times what geographic coordinates in metres reach


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
    confidence: Path | None = None
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
    classes_file: Path | None = None  # that the classes are from
    mask_mode: Literal["ignore", "empty"] | None = None  # what black in masks means, where the set says so
    points: Points = field(default_factory=Points.empty)
    bounds: np.ndarray | None = None
    warnings: list[str] = field(default_factory=list)
    # The folder with `labels`, `masks` and classes.json; None: what was given, or where that file lies.
    root: Path | None = None
    resources: tuple[object, ...] = ()  # temporary folders that live as long as this


def not_imported(count: int, source: Path) -> str:
    """What is said of so many photos that a data set names and has no pose for."""
    photos, were = ("photo has", "was") if count == 1 else ("photos have", "were")
    return f"{count} {photos} no pose in {source} and {were} not imported"


def lens_at_size(camera: Camera, size: tuple[int, int], image: Path) -> Camera:
    """The lens of a photo that is `size` (width, height), smaller or larger than the pictures that the lens is given for.

    Raises:
        InputError: its proportions are others, so that it was turned or cut since.
    """
    if size == (camera.width, camera.height):
        return camera
    if abs(size[0] / size[1] * camera.height / camera.width - 1) > OTHER_SHAPE:
        raise InputError(
            f"{image} is {size[0]}×{size[1]} pixels, but its lens is that of {camera.width}×{camera.height}: it was turned or "
            "cut after its pose was found.",
            "Use the photos as they were then.",
        )
    return camera.resized(*size)


def require(views: Iterable[DatasetView], source: Path, missing: Sequence[str] = ()) -> list[DatasetView]:
    """The views as a list.

    Raises:
        InputError: there is none, naming missing image files if that is why; a pose is not of finite numbers.
    """
    found = list(views)
    if not found:
        why = f"none of its images exists (for example {missing[0]})" if missing else "it has no images"
        raise InputError(f"{source} cannot be imported: {why}.", "Choose the folder that holds the images and poses.")
    for view in found:
        pose = np.asarray(view.camera_to_world, np.float64)
        if not (np.abs(pose) < FARTHEST).all():  # false for NaN too
            raise InputError(f"The pose of {view.name} in {source} is no rotation and position.", "Export it again.")
    return found
