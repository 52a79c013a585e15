"""What is written in a capture project, as typed models."""

from __future__ import annotations

import uuid
from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from ..files import leads_outside
from ..geometry.cameras import Camera

FORMAT = "fieldwork-project"
VERSION = 2
IDENTITY = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def _own_name(name: str) -> str:
    if name in (".", "..") or "/" in name or "\\" in name:
        raise ValueError(f"“{name}” is no name of a photo")
    return name


def _own_file(path: str) -> str:
    if leads_outside(path):
        raise ValueError(f"“{path}” leads outside the project")
    return path


ImageName = Annotated[str, AfterValidator(_own_name)]
OwnFile = Annotated[str, AfterValidator(_own_file)]  # relative to the project folder


class Model(BaseModel):
    model_config = ConfigDict(extra="forbid")


class ImageRecord(Model):
    """One ingested photo. Paths are relative to the project folder and use forward slashes.

    `status`: "ok", "rejected" (never used; `reason` says why) or "unregistered" (no pose found).
    `source` is where the original came from, `sha256` its hash; `width`/`height` those of the working copy.
    """

    name: ImageName
    file: OwnFile = ""
    source: str = ""
    sha256: str = ""
    width: int = 0
    height: int = 0
    camera_group: str = ""
    focal_px: float | None = None
    exif: dict[str, Any] = {}
    sharpness: float | None = None
    label: OwnFile | None = None
    instances: OwnFile | None = None  # numbers of the labelled things of this photo, 0 for none
    mask: OwnFile | None = None
    confidence: OwnFile | None = None  # how sure the labels are, 8-bit grey
    depth: OwnFile | None = None
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
    marks_from_sfm: list[list[float]] = IDENTITY  # marks on the surface stay in the frame of the first poses
    up_confidence: float | None = None
    scale_known: bool = False
    bounds: list[list[float]] | None = None  # region of interest in the world: [min, max]


class ProvenanceStep(Model):
    """What a verb did, in the project's provenance or beside the artefact it made.

    `inputs` is the fingerprint of what it was made from (see fingerprints.py), `checkpoint` the field it was made of.
    """

    verb: str
    time: str
    version: str
    settings: dict[str, Any] = {}
    result: dict[str, Any] = {}
    inputs: dict[str, str] = {}
    checkpoint: str = ""


class Project(Model):
    format: Literal["fieldwork-project"] = FORMAT
    version: int = VERSION
    uuid: str = Field(default_factory=lambda: uuid.uuid4().hex)  # what it is known by, wherever its folder goes
    created: str = Field(default_factory=lambda: now())
    images: list[ImageRecord] = []
    classes: list[SemanticClass] = []
    former_class_ids: list[int] = []  # of classes that were removed: label maps and marks may still hold them
    ignore_id: int = 0
    mask_mode: Literal["ignore", "empty"] = "ignore"
    frame: Frame = Frame()
    provenance: list[ProvenanceStep] = []

    def record(
        self, verb: str, settings: dict[str, Any], result: dict[str, Any], inputs: dict[str, str] | None = None
    ) -> None:
        """Append one step to the provenance."""
        self.provenance.append(step(verb, settings, result, inputs))

    def last(self, verb: str) -> ProvenanceStep | None:
        """The newest step of a verb."""
        return next((step for step in reversed(self.provenance) if step.verb == verb), None)


def step(
    verb: str,
    settings: dict[str, Any],
    result: dict[str, Any],
    inputs: dict[str, str] | None = None,
    checkpoint: str = "",
) -> ProvenanceStep:
    """A step that was done just now."""
    from .. import __version__

    return ProvenanceStep(
        verb=verb,
        time=now(),
        version=__version__,
        settings=settings,
        result=result,
        inputs=inputs or {},
        checkpoint=checkpoint,
    )


class PosedImage(Model):
    """Pose of one registered image: camera-to-world 4×4 in the SfM frame, OpenCV axes; `gain`: what its red, green and blue
    are multiplied with to have the capture's common exposure."""

    name: ImageName
    camera: int
    camera_to_world: list[list[float]]
    gain: tuple[float, float, float] | None = None


class Poses(Model):
    """Registered images. `reprojection_px` and `report` come from SfM, absent for imported poses."""

    version: int = 1
    source: str = ""
    cameras: list[Camera] = []
    images: list[PosedImage] = []
    reprojection_px: float | None = None


def now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
