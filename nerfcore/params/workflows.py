"""What the verbs that run others are asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from .base import (
    CLASSES,
    KEEP_BACKDROP,
    KEEP_EXPOSURE,
    LABELS,
    LONGEST_RUN,
    MANY,
    MASK_MODE,
    MASKS,
    CloseGaps,
    FaceCount,
    Holdout,
    Params,
    Preset,
    Settings,
    TextureSize,
    Watertight,
)


class ReconstructParams(Params):
    photos: Path = Field(description="folder of photos, or a video file")
    out: Path = Field(description="folder of the project, made anew or gone on with")
    preset: Preset = "standard"
    labels: Path | None = Field(default=None, description=LABELS)
    masks: Path | None = Field(default=None, description=MASKS)
    mask_mode: Literal["ignore", "empty"] | None = Field(default=None, description=MASK_MODE)
    keep_backdrop: bool = Field(default=False, description=KEEP_BACKDROP)
    keep_exposure: bool = Field(default=False, description=KEEP_EXPOSURE)
    classes: Path | None = Field(default=None, description=CLASSES)
    blend: Path | None = Field(default=None, description="Blender file to write: cameras, points, mesh and materials")
    time_limit: float | None = Field(
        default=None,
        gt=0,
        le=LONGEST_RUN,
        description="seconds of training; all that comes after it gets half as much and a minute",
    )
    holdout: Holdout = 8
    set: Settings
    faces: FaceCount = Field(default=200_000, description="triangles of the mesh; 0: all there are")
    texture: TextureSize = Field(
        default="auto",
        description="size of the mesh's texture in pixels; auto: what the photos' pixels need; none: vertex colours only",
    )
    watertight: Watertight = False
    close_gaps: CloseGaps = 0.0
    report: Path | None = Field(default=None, description="report to write, .html or .pdf")
    renders: Path | None = Field(default=None, description="folder for renders of new views")
    render_count: int = Field(
        default=8, ge=1, le=MANY, description="number of renders of new views, around the subject"
    )


def needs_cluster(cluster: str | None, **given: object) -> None:
    """Raise ValueError where something is given that without a cluster would be left out silently."""
    for name, value in given.items():
        if cluster is None and value is not None:
            raise ValueError(f"{name}: only workers of a cluster use it; say which cluster as well")


class BatchParams(Params):
    list: Path = Field(description=".csv or .json file with one capture a row: the settings of reconstruct by name")
    retries: int = Field(default=1, ge=0, le=1000, description="how often a capture that failed is tried again")
    report: Path | None = Field(default=None, description="JSON report to write; default: LIST-report.json beside it")
    cluster: str | None = Field(
        default=None,
        description="spread the captures over a Ray cluster: HOST:PORT, or auto for one of this machine; default: one "
        "capture after the other",
    )
    storage: str | None = Field(
        default=None,
        description="with --cluster: where workers take files from and leave them, s3://BUCKET/FOLDER for instance; "
        "default: the list's folder, which all of them see at the same place",
    )
    wheel: Path | None = Field(default=None, description="with --cluster: wheel of Fieldwork that workers are to use")
    keep_free: float = Field(
        default=2.0,
        ge=0,
        le=1e6,
        description="with --cluster: a worker with fewer GB free on its disk gets nothing to do",
    )
    dry_run: bool = Field(
        default=False, description="do nothing: say what there is to do, what is missing, and how long it may take"
    )

    @model_validator(mode="after")
    def _on_a_cluster(self) -> Self:
        needs_cluster(self.cluster, storage=self.storage, wheel=self.wheel)
        return self


class BlocksParams(Params):
    project: Path
    count: int = Field(default=2, ge=2, le=1000, description="number of blocks")
    preset: Preset = "standard"
    steps: int | None = Field(default=None, gt=0, le=LONGEST_RUN, description="optimisation steps of each block")
    time_limit: float | None = Field(
        default=None, gt=0, le=LONGEST_RUN, description="seconds of training of each block"
    )
    set: Settings
    holdout: Holdout = 8
    faces: FaceCount = Field(default=200_000, description="triangles of each block; 0: all there are")
    resolution: int = Field(default=512, ge=16, le=2048, description="cells along the longest side of a block")
    out: Path | None = Field(
        default=None, description="file for the whole mesh: .ply, .obj, .glb, .stl, .usdc, .usda, .usd or .usdz"
    )
    texture: TextureSize = Field(
        default=None,
        description="size of the whole mesh's texture in pixels, or auto: what the photos' pixels need; none: vertex colours "
        "only",
    )
    lods: int = Field(
        default=0, ge=0, le=6, description="levels of detail to write as well, each with a quarter of the triangles"
    )
    turntable: Path | None = Field(
        default=None, description="folder for pictures of the whole mesh from eight sides: its colours and its classes"
    )
    cluster: str | None = Field(
        default=None,
        description="spread the blocks over a Ray cluster: HOST:PORT, or auto for one of this machine; default: one block "
        "after the other",
    )
    retries: int = Field(default=1, ge=0, le=1000, description="with --cluster: how often a task is tried again")
    wheel: Path | None = Field(default=None, description="with --cluster: wheel of Fieldwork that workers are to use")
    keep_free: float = Field(
        default=2.0,
        ge=0,
        le=1e6,
        description="with --cluster: a worker with fewer GB free on its disk gets nothing to do",
    )

    @model_validator(mode="after")
    def _on_a_cluster(self) -> Self:
        needs_cluster(self.cluster, wheel=self.wheel)
        return self


class BenchParams(Params):
    suite: Literal[
        "figures", "speed", "ablation", "robustness", "evidence", "gpu", "surface", "labels", "measures", "live"
    ] = Field(description="which table")
    out: Path = Field(default=Path("build/bench"), description="folder for results and scenes; finished runs are kept")
    data: Path | None = Field(default=None, description="folder of data sets; default: ../shared/data when it is there")
    scenes: list[str] | None = Field(
        default=None, description="data sets, simulated scenes (museum, facade, fence, vase), or capture projects"
    )
    variants: list[str] | None = Field(default=None, description="only these variants of the suite")
    tables: list[str] | None = Field(default=None, description="only these tables of the suite evidence")
    seconds: float | None = Field(
        default=None, gt=0, le=LONGEST_RUN, description="seconds of training a run, instead of the suite's"
    )
    steps: int | None = Field(
        default=None, gt=0, le=LONGEST_RUN, description="steps of training a run, instead of the suite's"
    )
    seeds: list[int] | None = Field(default=None, description="a run for each of these seeds, instead of the suite's")
    preset: Preset = "standard"
    set: dict[str, str] = Field(
        default_factory=dict, description="settings changed in every run, but for what a variant changes"
    )
    keep: bool = Field(default=False, description="keep the trained fields in OUT/projects")
    yardstick: Path | None = Field(default=None, description="speed: script of another trainer to run beside ours")
    page: Path | None = Field(
        default=None, description="Markdown page written anew from the folder figures beside it, which gets this table"
    )
    tests: Path | None = Field(default=None, description="gpu: JUnit file of the kernels' tests")
    profile: Literal["quick", "evening", "cpu", "gpu"] = Field(
        default="quick",
        description="evidence: which budget, a quarter of an hour, an evening, a day on a CPU, or a GPU's",
    )
    add_to_page: bool = Field(
        default=False, description="evidence: what stands on the page counts as measured; what it lacks is added"
    )
    lpips: Path | None = Field(
        default=None, description="evidence: torchvision's weights of VGG-16 for LPIPS; default: not measured"
    )
