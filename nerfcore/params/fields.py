"""What the verbs of a field are asked for: training, measuring, baking, rendering."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from .base import LONGEST_RUN, MANY, Holdout, Params, Pass, PictureSize, Preset, RunName, Settings


class TrainParams(Params):
    project: Path
    preset: Preset = "standard"
    run: RunName = "main"
    holdout: Holdout = 8
    time_limit: float | None = Field(default=None, gt=0, le=LONGEST_RUN, description="seconds of training")
    steps: int | None = Field(default=None, gt=0, le=LONGEST_RUN, description="optimisation steps")
    set: Settings
    resume: bool = Field(default=False, description="go on with the training of this run that was stopped")


class EvaluateParams(Params):
    project: Path
    run: RunName = "main"
    split: Literal["test", "train"] = Field(
        default="test", description="the photos that were held out, or those trained on"
    )
    speed: bool = Field(default=False, description="measure frames of 800x800 too; on a CPU this can take minutes")
    baked: bool = Field(default=False, description="measure the baked field, and what it lost against the field")
    time_limit: float | None = Field(
        default=None, gt=0, le=LONGEST_RUN, description="seconds; as many photos, evenly spread, as fit: at least one"
    )
    report: Path | None = Field(
        default=None, description=".html or .pdf to write: whether the capture is good, and what to photograph next"
    )


class BakeParams(Params):
    project: Path
    run: RunName = "main"
    memory: float = Field(
        default=100, ge=2, le=1500, description="megabytes of graphics memory that the baked field takes at most"
    )


class RenderParams(Params):
    project: Path
    out: Path = Field(description="folder for the pictures")
    run: RunName = "main"
    test: bool = Field(
        default=False, description="from the held-out photos; one of --test, --all, --camera and --orbit is needed"
    )
    all: bool = Field(default=False, description="from every photo, also those of training")
    camera: Path | None = Field(
        default=None,
        description="from the cameras of this file, written like a transforms.json: w, h, fl_x (pixels), and frames with a "
        "transform_matrix each, in the aligned world",
    )
    orbit: int | None = Field(
        default=None,
        gt=0,
        le=MANY,
        description="from so many places around the subject, or along the arc that was photographed",
    )
    size: PictureSize | None = Field(
        default=None, description="WxH; cut where a camera has other proportions (held-out and all photos: resampled)"
    )
    passes: list[Pass] = Field(default=["rgb", "depth", "semantic"], min_length=1, description="what to render")
    baked: bool = Field(default=False, description="from the baked field, which is faster, instead of the field")
    edits: Path | None = Field(
        default=None,
        description="JSON file of the classes and things that are hidden, dimmed, recoloured, moved or copied; with `--baked`",
    )
    frame_range: tuple[int, int] | None = Field(
        default=None,
        description="first and last frame of these, counted from 0, to render only a part: several programs may render "
        "parts of one render at the same time, and a render of all keeps what they made",
    )

    @model_validator(mode="after")
    def _cameras_of_one_kind(self) -> Self:
        if self.test + self.all + (self.camera is not None) + (self.orbit is not None) > 1:
            raise ValueError("give one of test, all, camera and orbit")
        return self

    @model_validator(mode="after")
    def _range_goes_up(self) -> Self:
        if self.frame_range is not None and not 0 <= self.frame_range[0] <= self.frame_range[1]:
            raise ValueError(f"frame_range: {self.frame_range[0]} to {self.frame_range[1]} is no range of frames")
        return self

    @model_validator(mode="after")
    def _edits_are_of_the_baked_field(self) -> Self:
        if self.edits is not None and not self.baked:
            raise ValueError("edits: only a baked field is edited; say `--baked` as well")
        return self
