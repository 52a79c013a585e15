"""What the verbs of labelling are asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from .base import LARGEST_PICTURE, MANY, Params, RunName

Revision = Annotated[
    int | None, Field(ge=0, le=MANY, description="revision of the marks; default: the one that is shown")
]


Level = Literal["fine", "coarse"]


class LabelPrepareParams(Params):
    project: Path
    run: RunName = "main"
    surfels: int = Field(default=200_000, ge=1000, le=5_000_000, description="most surfels to make")
    features: Path | None = Field(
        default=None,
        description="ONNX file of a model such as DINOv2, whose features tell surfels apart too; default: the one used before",
    )


class LabelStrokeParams(Params):
    project: Path
    photo: str = Field(default="", description="name of the photo that the mark is drawn on")
    points: list[tuple[float, float]] = Field(
        default=[],
        description="pixels x,y of the photo, its top-left corner being 0,0: the corners of a line or an outline, or where "
        "clicked; on the command line x,y x,y …",
        max_length=100_000,
    )
    places: list[tuple[float, float, float]] = Field(
        default=[],
        description="instead of a photo: places x,y,z on the surface in the aligned world",
        max_length=100_000,
    )
    shape: Literal["line", "outline", "click", "part"] = Field(
        default="line",
        description="what the points are: a brush's line, the outline of an area, clicks, or clicks that each take the whole "
        "part of the surface that looks alike",
    )
    width: float = Field(
        default=8.0,
        gt=0,
        le=LARGEST_PICTURE,
        description="width of the brush: pixels of the photo, or units of the world on the surface",
    )
    level: Level = Field(default="fine", description="how large the parts are that shape part takes")
    class_id: int | None = Field(default=None, ge=0, le=65535, description="id of the class that is marked")
    void: bool = Field(default=False, description="what is marked is none of the classes")
    erase: bool = Field(default=False, description="take away earlier marks here")
    author: str = Field(default="", max_length=200, description="who made the mark")
    key: str = Field(default="", max_length=64, description="a mark sent again with the same key is not made again")

    @model_validator(mode="after")
    def _one_meaning(self) -> Self:
        if (self.class_id is not None) + self.void + self.erase != 1:
            raise ValueError("give one of class_id, void and erase")
        if bool(self.photo) + bool(self.places) != 1:
            raise ValueError("give a photo with points, or places on the surface")
        if self.photo and not self.points:
            raise ValueError("give at least one point of the photo")
        if self.places and self.shape == "outline":
            raise ValueError("an outline is drawn on a photo")
        return self


class LabelCarryParams(Params):
    project: Path
    other: Path | None = Field(
        default=None, description="project of an earlier epoch of the same object, which is labelled"
    )
    run: RunName = "main"
    other_run: RunName = Field(default="main", description="run of the earlier epoch")
    points: Path | None = Field(
        default=None,
        description="table (.csv: name,x,y,z,other_x,other_y,other_z) of points in both worlds; default: by the surfaces",
    )
    confirm: bool = Field(
        default=False, description="say that the labels carried before are right, instead of carrying"
    )
    author: str = Field(default="", max_length=200, description="who carries or confirms them")

    @model_validator(mode="after")
    def _one_thing(self) -> Self:
        if (self.other is not None) + self.confirm != 1:
            raise ValueError("give the project of the earlier epoch, or confirm")
        return self


class LabelPropagateParams(Params):
    project: Path
    run: RunName = "main"
    revision: Revision = None


class LabelCheckoutParams(Params):
    project: Path
    revision: int | None = Field(
        default=None, ge=0, le=MANY, description="revision to show, 0 being the one without marks; default: only tell"
    )


class LabelOverlayParams(Params):
    project: Path
    photo: str = Field(description="name of the photo")
    out: Path | None = Field(
        default=None, description="PNG to write; default: runs/RUN/overlays/PHOTO_KIND.png of the project"
    )
    run: RunName = "main"
    revision: Revision = None
    kind: Literal["ids", "colors", "confidence"] = Field(
        default="colors", description="class ids, their colours over the photo, or how sure they are"
    )


class LabelPartsParams(Params):
    project: Path
    photo: str = Field(description="name of the photo")
    points: list[tuple[float, float]] = Field(
        default=[], max_length=1000, description="pixels x,y of the photo whose parts are told"
    )
    level: Level = Field(default="fine", description="how large the parts are")
    out: Path | None = Field(default=None, description="PNG to write: the photo with the outlines of its parts")
    run: RunName = "main"


class LabelNextParams(Params):
    project: Path
    run: RunName = "main"
    revision: Revision = None
    count: int = Field(default=5, ge=1, le=1000, description="number of photos to suggest")


class LabelAcceptParams(Params):
    project: Path
    run: RunName = "main"
    revision: Revision = None
    seconds: float = Field(default=15.0, gt=0, le=3600, description="time for training the classes")


class LabelImportParams(Params):
    project: Path
    file: Path = Field(description="file or folder that a labelling tool wrote")
    format: Literal["auto", "coco", "cvat", "label-studio", "labelme", "segments", "supervisely", "png", "masks"] = (
        Field(
            default="auto",
            description="what the file is; masks: black and white pictures, as Metashape writes them; default: by its contents",
        )
    )
    class_name: str = Field(
        default="object", min_length=1, max_length=200, description="class of what is white in masks"
    )
    replace: bool = Field(default=False, description="also for photos that have labels of their own")


class LabelExportParams(Params):
    project: Path
    out: Path = Field(description="file or folder to write, as the format has it")
    format: Literal[
        "coco",
        "coco-panoptic",
        "cvat",
        "label-studio",
        "labelme",
        "segments",
        "supervisely",
        "png",
        "png-colors",
        "masks",
        "history",
    ] = Field(
        default="coco",
        description="coco, cvat, label-studio and history are one file, the others a folder; history: a table of who marked "
        "what when",
    )
    source: Literal["maps", "marks"] = Field(
        default="maps", description="label maps of the photos, or what was propagated from marks over all photos"
    )
    run: RunName = "main"
    revision: Revision = None
    class_name: str = Field(default="", max_length=200, description="class that is white in masks")


class AssistEmbedParams(Params):
    project: Path
    encoder: Path = Field(description="ONNX file of the encoder of a SAM, MobileSAM, SAM 2 or EfficientSAM")
    decoder: Path = Field(description="ONNX file of its decoder")
    photos: list[str] = Field(default=[], description="names of the photos; default: all")


class AssistSegmentParams(Params):
    project: Path
    photo: str = Field(description="name of the photo")
    encoder: Path = Field(description="ONNX file of the encoder of a SAM, MobileSAM, SAM 2 or EfficientSAM")
    decoder: Path = Field(description="ONNX file of its decoder")
    points: list[tuple[float, float]] = Field(default=[], max_length=1000, description="pixels x,y inside of the thing")
    outside: list[tuple[float, float]] = Field(default=[], max_length=1000, description="pixels x,y outside of it")
    box: tuple[float, float, float, float] | None = Field(
        default=None, description="left, top, right and bottom of a box around it in pixels"
    )
    class_id: int | None = Field(default=None, ge=0, le=65535, description="class of the mark that is made of it")
    void: bool = Field(default=False, description="make it a mark of what is none of the classes")
    author: str = Field(default="", max_length=200, description="who made the mark")
    key: str = Field(default="", max_length=64, description="a mark sent again with the same key is not made again")
    drawn_on: int | None = Field(
        default=None,
        ge=0,
        le=MANY,
        description="revision of the marks that was shown when it was asked for: marks drawn since stay on top of it",
    )

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.points and self.box is None:
            raise ValueError("give points or a box")
        if self.class_id is not None and self.void:
            raise ValueError("give one of class_id and void")
        return self


class AssistSuggestParams(Params):
    project: Path
    model: Path = Field(description="ONNX file of a model from pictures to logits of classes, such as SegFormer")
    mapping: Path = Field(description="JSON file with the project's class of each class of the model: {number: name}")
    photos: list[str] = Field(default=[], description="names of the photos; default: all")
    least: float = Field(default=0.5, ge=0, le=1, description="probability from which a pixel gets a class")
