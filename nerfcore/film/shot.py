"""What one frame for Blender is made of: the lens, the fields in front of it, and the passes asked for.

Lengths and matrices are those of the Blender scene; a pixel's origin is the upper left corner of the whole frame.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from ..params import LARGEST_PICTURE, RunName

Matrix = list[list[float]]
# Channels of each pass, as they stand in the shared file.
CHANNELS = {
    "Combined": 4,
    "Depth": 1,
    "Position": 3,
    "Normal": 3,
    "Class Index": 1,
    "Class Color": 4,
    "Confidence": 1,
    "FieldFront": 4,
    "FieldBehind": 4,
}
CRYPTOMATTES = ("CryptoObject", "CryptoMaterial", "CryptoAsset")
MOST_LEVELS = 16  # of a Cryptomatte: Blender's limit


def channels_of(name: str) -> int:
    """Channels of a pass. Raises KeyError: there is no such pass."""
    return 4 if name[:-2] in CRYPTOMATTES else CHANNELS[name]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class Aperture(_Part):
    """A thin lens: radius in scene units, and the distance that is sharp; blades below 3 make a disc, ratio is
    Blender's (above 1: narrower across)."""

    radius: float = Field(gt=0)
    focus: float = Field(gt=0)
    blades: int = 0
    rotation: float = 0.0
    ratio: float = Field(default=1.0, gt=0)


class Lens(_Part):
    """A camera of Blender.

    scale, center: for "perspective" the focal lengths and the principal point in pixels, for "orthographic" the pixels
    per unit and the pixel of the axis; longitudes and latitudes bound an equirectangular picture; angle is that of an
    equidistant fisheye; equisolid fisheyes have focal and sensor in millimetres. clip: nearest and farthest distance,
    along the axis, or along the ray of a panorama. poses: (4, 4) scene from camera with Blender's axes, at even times
    while the shutter is open.
    """

    kind: Literal["perspective", "orthographic", "equirectangular", "equidistant", "equisolid"]
    width: int = Field(gt=0, le=LARGEST_PICTURE)
    height: int = Field(gt=0, le=LARGEST_PICTURE)
    scale: tuple[float, float] = (1.0, 1.0)
    center: tuple[float, float] = (0.0, 0.0)
    longitudes: tuple[float, float] = (0.0, 0.0)
    latitudes: tuple[float, float] = (0.0, 0.0)
    angle: float = 0.0
    focal: float = 0.0
    sensor: tuple[float, float] = (0.0, 0.0)
    clip: tuple[float, float]
    poses: list[Matrix] = Field(min_length=1)
    aperture: Aperture | None = None

    @property
    def panoramic(self) -> bool:
        return self.kind not in ("perspective", "orthographic")


class ClassLook(_Part):
    """How a class is shown: its opacity, and how much of the class's colour it gets."""

    opacity: float = Field(default=1.0, ge=0, le=1)
    tint: float = Field(default=0.0, ge=0, le=1)
    color: tuple[float, float, float] = (0.0, 0.0, 0.0)


class FieldItem(_Part):
    """A field in the scene: `name` is that of its object; scene_from_capture (4, 4); crop: (4, 4) scene from the cube
    [−1, 1]³ to which it is cut; motion, crop_motion: the same at even times while the shutter is open, empty where it stands
    still; look: 0 photo … 1 labels … 2 confidence; classes by id, instances of the mesh by name, whose opacity is a factor
    beside that of their class, and whose tint comes in place of it; only: the instance that alone is shown."""

    name: str
    project: Path
    run: RunName = "main"
    baked: bool = False
    scene_from_capture: Matrix
    crop: Matrix | None = None
    motion: list[Matrix] = []
    crop_motion: list[Matrix] = []
    look: float = Field(default=0.0, ge=0, le=2)
    classes: dict[int, ClassLook] = {}
    instances: dict[str, ClassLook] = {}
    only: str = ""

    @property
    def told_apart(self) -> list[str]:
        """The instances that look other than their class."""
        return list(dict.fromkeys([*self.instances, *filter(None, [self.only])]))


class Shot(_Part):
    """One frame. border: x0, y0, x1, y1 of the pixels that are rendered; world: linear colour behind everything, None
    leaves it transparent; occluders: file of triangles (npz: vertices, faces, and which of them are a holdout) that hide the field; file: where the
    pixels go; levels: Cryptomatte levels; filter_width: of the Blackman-Harris filter in pixels, as Blender's engines have it,
    0 for a pixel's own area."""

    lens: Lens
    border: tuple[int, int, int, int]
    samples: int = Field(default=1, ge=1, le=4096)
    fields: list[FieldItem] = Field(min_length=1)
    passes: list[str] = Field(min_length=1)
    filter_width: float = Field(default=0.0, ge=0, le=16)
    levels: int = Field(default=6, ge=2, le=MOST_LEVELS)
    world: tuple[float, float, float] | None = None
    sky: bool = True
    occluders: Path | None = None
    file: Path

    @model_validator(mode="after")
    def _within(self) -> Shot:
        x0, y0, x1, y1 = self.border
        if not (0 <= x0 < x1 <= self.lens.width and 0 <= y0 < y1 <= self.lens.height):
            raise ValueError(f"the border {self.border} is not within {self.lens.width} × {self.lens.height} pixels")
        unknown = [name for name in self.passes if name not in CHANNELS and name[:-2] not in CRYPTOMATTES]
        if unknown:
            raise ValueError(f"there is no pass {unknown[0]}")
        return self

    @property
    def blurred(self) -> bool:
        """Whether rays of a pixel differ by chance: in their place on the aperture or in their time."""
        moving = any(len(field.motion) > 1 or len(field.crop_motion) > 1 for field in self.fields)
        return self.lens.aperture is not None or len(self.lens.poses) > 1 or moving

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of what is rendered."""
        x0, y0, x1, y1 = self.border
        return x1 - x0, y1 - y0
