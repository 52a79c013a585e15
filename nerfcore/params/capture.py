"""What the verbs of a capture are asked for: its photos, their poses, its classes and region; simulated scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from .base import (
    CLASSES,
    KEEP_BACKDROP,
    KEEP_EXPOSURE,
    LABELS,
    LARGEST_PICTURE,
    MANY,
    MASK_MODE,
    MASKS,
    Params,
    PictureSize,
)


class DoctorParams(Params):
    pass


class SimulateParams(Params):
    out: Path = Field(description="folder to write the simulated capture to")
    scene: str = Field(
        default="museum",
        description="built-in scene: museum (exhibits in a room), facade (weathered stone outdoors), fence (thin things: "
        "wire, leaves, a sign) or vase (closed bodies on a table)",
    )
    views: int = Field(default=48, ge=4, le=MANY, description="number of photos")
    overviews: int = Field(
        default=0, ge=0, le=MANY, description="how many of them show the whole from farther away, the last ones"
    )
    size: PictureSize = Field(default=(480, 320), description="photo width and height in pixels")
    seed: int = Field(default=0, ge=0, le=MANY, description="seed of the scene and of the camera path")
    samples: int = Field(default=4, ge=1, le=65536, description="Cycles samples per pixel")


class DatasetParams(Params):
    blend: Path = Field(description=".blend file whose active scene is photographed")
    out: Path = Field(description="folder to write the data set to")
    path: Literal["sphere", "hemisphere", "camera", "curve"] = Field(
        default="hemisphere",
        description="where the photos are taken from: around the scene, the scene's animated camera, a curve",
    )
    views: int = Field(
        default=100, ge=1, le=MANY, description="number of photos (camera: at most; spread over the frame range)"
    )
    center: tuple[float, float, float] | None = Field(
        default=None, description="what is looked at; default: the scene's middle"
    )
    radius: float | None = Field(
        default=None, gt=0, le=1e9, description="distance from it; default: so that all is in the picture"
    )
    curve: str | None = Field(default=None, description="name of the curve object, for path=curve")
    size: PictureSize | None = Field(default=None, description="photo width and height in pixels; default: the scene's")
    samples: int = Field(default=32, ge=1, le=65536, description="Cycles samples per pixel")
    labels: Literal["material", "object", "collection", "none"] = Field(
        default="material",
        description="what tells classes apart: pass index (or name) of materials or objects, or collections",
    )
    depth: bool = Field(default=True, description="write depth maps")
    transparent: bool = Field(
        default=False, description="alpha 0 where there is nothing, instead of the world's background"
    )


class NewParams(Params):
    project: Path
    photos: Path = Field(description="folder of photos, or a video file")
    labels: Path | None = Field(default=None, description=LABELS)
    masks: Path | None = Field(default=None, description=MASKS)
    classes: Path | None = Field(default=None, description=CLASSES)
    mask_mode: Literal["ignore", "empty"] | None = Field(default=None, description=MASK_MODE)
    keep_backdrop: bool = Field(default=False, description=KEEP_BACKDROP)
    max_size: int = Field(
        default=1600, ge=64, le=LARGEST_PICTURE, description="long side of the working copies in pixels"
    )
    frames: int = Field(default=80, ge=4, le=MANY, description="number of frames taken from a video")
    keep_blurry: bool = Field(default=False, description="use photos that look blurred too")
    add: bool = Field(default=False, description="add the photos to an existing project")


class ImportParams(Params):
    dataset: Path
    project: Path
    format: Literal[
        "auto",
        "transforms",
        "colmap",
        "llff",
        "scannet",
        "replica",
        "dtu",
        "strecha",
        "middlebury",
        "metashape",
        "realityscan",
        "meshroom",
    ] = Field(default="auto", description="how the dataset is laid out; auto finds it out")
    classes: Path | None = Field(default=None, description=CLASSES)
    mask_mode: Literal["ignore", "empty"] | None = Field(default=None, description=MASK_MODE)
    keep_backdrop: bool = Field(default=False, description=KEEP_BACKDROP)


class PosesParams(Params):
    project: Path
    preset: Literal["fast", "standard", "robust"] = Field(
        default="standard", description="how many features and pairs of photos are tried: robust takes longest"
    )
    restart: bool = Field(default=False, description="place all photos anew, also those that have a pose")
    group: int = Field(
        default=0,
        ge=0,
        le=MANY,
        description="where photos fall into separate groups: which to use, 0 being the largest",
    )
    keep_exposure: bool = Field(default=False, description=KEEP_EXPOSURE)


class AlignParams(Params):
    project: Path
    up: str | None = Field(default=None, description="direction that points up: x, -x, …, or three numbers a,b,c")
    scale: tuple[str, str, float] | None = Field(
        default=None, description="two points (x,y,z) or camera names, and their distance in metres"
    )
    gps: bool = Field(default=False, description="take scale and north from the photos' GPS positions")
    ground: bool = Field(default=False, description="level the ground and put it at z = 0")
    crop: str | None = Field(
        default=None, description="region of interest: auto, none, or x0,y0,z0,x1,y1,z1 in the aligned world"
    )


class ClassValues(Params):
    """One class; what is None stays as it is, or gets its default where the class is new."""

    id: int
    name: str
    color: tuple[float, float, float] | None = None  # sRGB in [0, 1]
    priority: float | None = Field(default=None, ge=0)


class ClassesParams(Params):
    project: Path
    classes: list[ClassValues] | None = Field(
        default=None, description="all classes the project shall have; None: list them"
    )
    file: Path | None = Field(
        default=None, description="classes.json with all classes the project shall have; without it they are listed"
    )


class RegionParams(Params):
    project: Path
    bounds: list[list[float]] | None = Field(
        default=None, description="region of interest x0 y0 z0 x1 y1 z1 in the aligned world"
    )
    clear: bool = Field(default=False, description="no region: everything is trained")
