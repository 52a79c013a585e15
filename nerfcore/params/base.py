"""What parameters have in common: names, sizes, bounds, and what is checked of all of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from ..files import is_text, name_problem, printable

# Bounds that only mistakes go beyond.
LARGEST_PICTURE = 32768  # pixels on a side
MANY = 1_000_000  # photos, frames
LONGEST_RUN = 1_000_000_000  # steps or seconds
FEWEST_FACES, MOST_FACES = 100, 1_000_000_000  # of a mesh: fewer have no shape
SMALLEST_TEXTURE, LARGEST_TEXTURE = 64, 16384  # pixels on a side
MASK_MODE = (
    "what black mask pixels mean; default: empty where masks cut an object out of nearly all photos, else ignore"
)
KEEP_BACKDROP = (
    "make no masks where nearly all photos show an object before dark surroundings, which is done unless masks or labels are "
    "given"
)
LABELS = (
    "folder of label maps (or .npy, .npz, .exr probability maps) named like the photos; confidence/ in it may hold grey maps "
    "of how sure they are"
)
MASKS = "folder of foreground masks named like the photos"
CLASSES = "classes.json: names of the label ids"
KEEP_EXPOSURE = "do not bring photos that differ in exposure or white balance to a common one"
Preset = Annotated[
    Literal["draft", "standard", "high"],
    Field(description="how large the field is and how long it is trained, unless steps or seconds are given"),
]
Settings = Annotated[
    dict[str, str],
    Field(
        default_factory=dict,
        description="a setting of training by its name, e.g. loss.semantic_weight=0.1; may be repeated",
    ),
]
Split = Literal["none", "classes", "instances"]
Pass = Literal["rgb", "depth", "semantic", "confidence", "normal", "unknown"]


def _leaves_some(every: int) -> int:
    if every == 1:
        raise ValueError("1 would hold out every photo; give 0 for none, or 2 and more")
    return every


Holdout = Annotated[
    int,
    Field(
        ge=0,
        le=MANY,
        description="every so many photos, one is held out for `evaluate`; 0: all are trained on, for a final field",
    ),
    AfterValidator(_leaves_some),
]


def _enough_faces(faces: int | None) -> int | None:
    if faces is not None and 0 < faces < FEWEST_FACES:
        raise ValueError(f"{faces} is too few for a surface; give 0 for all there are, or {FEWEST_FACES} and more")
    return faces or None


FaceCount = Annotated[  # None: all there are
    Annotated[int, Field(ge=0, le=MOST_FACES)] | None, AfterValidator(_enough_faces)
]


CloseGaps = Annotated[
    float,
    Field(
        ge=0,
        le=20,
        description="width, in percent of the longest side of the region, up to which holes, cracks and frayed borders are "
        "closed by a guess, whose faces are marked; 0: none. Not needed with watertight",
    ),
]
Watertight = Annotated[
    bool,
    Field(description="close the surface: what no photo shows counts as inside, and its faces are marked"),
]


def _texture_size(size: object) -> object:
    if size == "auto":
        return size
    try:
        pixels = int(str(size))
    except ValueError:
        pixels = -1
    if not SMALLEST_TEXTURE <= pixels <= LARGEST_TEXTURE:
        raise ValueError(
            f"{size} is no size of a texture; give {SMALLEST_TEXTURE} to {LARGEST_TEXTURE} pixels, or auto for as many as "
            "the photos have"
        )
    return pixels


TextureSize = Annotated[  # None: no texture
    int | Literal["auto"] | None,
    BeforeValidator(lambda size: None if size in (None, 0, "0", "none") else _texture_size(size)),
]


def _checked_name(name: str) -> str:
    problem = name_problem(name)
    if problem:
        raise ValueError(problem)
    return name


RunName = Annotated[str, Field(description="name of the run"), AfterValidator(_checked_name)]


def _picture(size: tuple[int, int]) -> tuple[int, int]:
    if not all(1 <= side <= LARGEST_PICTURE for side in size):
        raise ValueError(f"{size[0]}x{size[1]} is no size of a picture: sides have 1 to {LARGEST_PICTURE} pixels")
    return size


PictureSize = Annotated[tuple[int, int], AfterValidator(_picture)]


class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, defer_build=True)

    @model_validator(mode="after")
    def _paths_are_text(self) -> Self:
        """project.json and what is printed are UTF-8: a path of other bytes could be read and never written down."""
        for name in type(self).model_fields:
            path = getattr(self, name)
            if isinstance(path, Path) and not is_text(str(path)):
                raise ValueError(f"the path {printable(str(path))} is not UTF-8: rename it")
        return self
