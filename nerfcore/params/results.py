"""What the verbs that hand on results are asked for: reports, .blend and other files."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from .base import Params, RunName, Split


class ReportParams(Params):
    project: Path
    run: RunName = "main"
    out: Path | None = Field(
        default=None, description=".html or .pdf file to write; default: exports/RUN/report.html of the project"
    )


class BlendParams(Params):
    project: Path
    out: Path = Field(description="Blender file to write")
    run: RunName = "main"
    split: Split = Field(default="none", description="classes, instances: one mesh object for each of them")
    renders: Path | None = Field(
        default=None,
        description="folder of rendered photos to show behind their cameras; default: those Blender's panel rendered",
    )


class ExportParams(Params):
    project: Path
    to: Literal[
        "glb", "obj", "ply", "stl", "usd", "masks", "transforms", "colmap", "onnx", "voxels", "splats", "vdb"
    ] = Field(description="format")
    run: RunName = "main"
    out: Path | None = Field(
        default=None,
        description="file to write, for masks and colmap the folder; default: exports/RUN/PROJECT of the project",
    )
    split: Split = Field(default="none", description="classes, instances: one object for each of them")
    resolution: int = Field(default=128, ge=8, le=512, description="voxels: cells along each side of the field's cube")


class PackageParams(Params):
    project: Path
    run: RunName = "main"
    renders: Path | None = Field(
        default=None, description="folder of rendered photos; default: exports/RUN/renders/photos of the project"
    )
