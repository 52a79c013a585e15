"""What the verbs of a surface are asked for: the mesh, and what is measured and drawn of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from .base import CloseGaps, FaceCount, Params, RunName, Split, TextureSize, Watertight


class MeshParams(Params):
    project: Path
    run: RunName = "main"
    out: Path | None = Field(
        default=None,
        description="file to write the mesh to as well: .ply, .obj, .glb, .stl, .usdc, .usda, .usd or .usdz",
    )
    faces: FaceCount = Field(default=None, description="triangles of the mesh; 0 or nothing: all there are")
    resolution: int | None = Field(
        default=None,
        ge=16,
        le=2048,
        description="cells along the longest side of the region; default: 512, or up to 1024 where photos are finer",
    )
    detail: float | None = Field(
        default=None,
        gt=0,
        le=1e9,
        description="side of a cell in millimetres, instead of resolution; needs a known scale",
    )
    region: str = Field(
        default="auto",
        description="where to look: auto (the region of interest, or what the photos show where there is none), photos "
        "(what they show), or x0,y0,z0,x1,y1,z1 in the aligned world",
    )
    texture: TextureSize = Field(
        default=None,
        description="texture size in pixels, or auto: what the photos' pixels need; none: vertex colours only",
    )
    watertight: Watertight = False
    close_gaps: CloseGaps = 0.0
    texture_kind: Literal["photo", "field"] = Field(
        default="photo", description="what the texture shows: the photos, or the field's colours"
    )
    split: Split = Field(default="none", description="classes, instances: one object of each in the file of `out`")
    lods: int = Field(
        default=0, ge=0, le=6, description="levels of detail to write as well, each with a quarter of the triangles"
    )
    turntable: Path | None = Field(
        default=None, description="folder for pictures of the mesh from eight sides: its colours and its classes"
    )
    preview: bool = Field(
        default=False,
        description="only a first look, in seconds: exports/RUN/preview.npz; the mesh that is there stays",
    )


class TurntableParams(Params):
    project: Path
    run: RunName = "main"
    out: Path | None = Field(
        default=None, description="folder to write to; default: exports/RUN/turntable of the project"
    )


class MeasureParams(Params):
    project: Path
    run: RunName = "main"
    distances: Path | None = Field(
        default=None,
        description="table (.csv: name,from,to,metres,u_mm,use) of distances to measure; known ones scale or check",
    )
    scale_error: float | None = Field(
        default=None,
        ge=0,
        le=100,
        description="standard uncertainty of the scale in percent; default: by the distances, or how it was set",
    )
    caps: float = Field(
        default=0.1,
        ge=0,
        lt=1,
        description="share of its area that caps over openings may have of a thing with a volume",
    )


Side = Literal["top", "bottom", "front", "back", "left", "right"]
Turn = Annotated[
    float,
    Field(ge=-360, le=360, description="degrees about z from the world to the front that is drawn, for slanted fronts"),
]
PaperScale = Annotated[
    float | None, Field(gt=0, le=1e9, description="N of the scale 1:N on paper; default: the largest that fits on A3")
]


class PlanParams(Params):
    project: Path
    run: RunName = "main"
    views: list[Side] = Field(default=["top", "front", "right", "back", "left"], description="sides to draw")
    conditions: list[str] = Field(
        default=[],
        description="classes to map as conditions, such as damages: hatched over the drawing, numbered, listed with their "
        "areas; or all",
    )
    turn: Turn = 0.0
    scale: PaperScale = None
    out: Path | None = Field(
        default=None, description="folder to write to; default: exports/RUN/drawings of the project"
    )


class SectionParams(Params):
    project: Path
    plane: str = Field(description="plane of the section in the aligned world: x=…, y=… or z=…")
    run: RunName = "main"
    turn: Turn = 0.0
    scale: PaperScale = None
    out: Path | None = Field(
        default=None, description="folder to write to; default: exports/RUN/drawings of the project"
    )


class CompareParams(Params):
    project: Path
    other: Path = Field(description="project of an earlier epoch of the same object")
    run: RunName = "main"
    other_run: RunName = Field(default="main", description="run of the earlier epoch")
    points: Path | None = Field(
        default=None,
        description="table (.csv: name,x,y,z,other_x,other_y,other_z) of points in both worlds; default: by the surfaces",
    )
    limit: float | None = Field(
        default=None,
        gt=0,
        le=1e9,
        description="distance beyond which surfaces do not belong together, world units; default: 20 cells of the mesh",
    )
    views: list[Side] = Field(default=["top", "front", "right", "back", "left"], description="sides to draw")
    scale: PaperScale = None
    out: Path | None = Field(
        default=None, description="folder to write to; default: exports/RUN/compare of the project"
    )
