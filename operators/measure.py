"""Measure: sizes of what is on the mesh, and drawings of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
from bpy.types import Context

from ..addon.choices import SIDES
from ..addon.jobs.job import Done, Job
from ..addon.project import snapshot
from ..addon.text import t
from .base import ProjectOperator, need_poses, need_project, refresh_scenes, scene_settings
from .scene import show_image


def need_mesh(context: Context) -> str | None:
    settings = context.scene.fieldwork
    folder = snapshot.folder_of(settings)
    there = folder is not None and (folder / "exports" / settings.run / "mesh.npz").is_file()
    return need_project(context) or (None if there else t("Extract the mesh first"))


def ordered(views: set[str]) -> list[str]:
    """Sides in the order in which the panel shows them."""
    return [name for name, *_ in SIDES if name in views]


@scene_settings(run="run", distances="distances", scale_error="scale_error", caps="caps")
class FIELDWORK_OT_measure(ProjectOperator):
    """Measure areas and volumes of classes and instances, and distances, with their uncertainty"""

    bl_idname = "fieldwork.measure"
    bl_label = "Measure"
    verb = "measure"
    needs = (need_mesh,)

    def parameters(self, context: Context) -> dict[str, Any]:
        return {
            "project": self.project_path(context),
            "run": self.value(context, "run"),
            "distances": self.path(context, "distances"),
            "scale_error": self.value(context, "scale_error") or None,
            "caps": self.value(context, "caps"),
        }


@scene_settings(run="run", out="turntable")
class FIELDWORK_OT_turntable(ProjectOperator):
    """Picture the mesh from eight sides, in its colors and in those of its classes"""

    bl_idname = "fieldwork.turntable"
    bl_label = "Look from All Sides"
    verb = "turntable"
    needs = (need_mesh,)

    def parameters(self, context: Context) -> dict[str, Any]:
        return {
            "project": self.project_path(context),
            "run": self.value(context, "run"),
            "out": self.path(context, "out"),
        }

    def after(self) -> Done:
        return show_drawing


@scene_settings(run="run", views="sides", conditions="conditions", turn="turn", scale="paper_scale", out="drawings")
class FIELDWORK_OT_plan(ProjectOperator):
    """Draw plans and elevations of the mesh to scale, in its colors and as maps of its classes"""

    bl_idname = "fieldwork.plan"
    bl_label = "Draw Plans"
    verb = "plan"
    needs = (need_mesh,)

    def parameters(self, context: Context) -> dict[str, Any]:
        views = self.value(context, "views")
        if not views:
            raise ValueError(t("Choose at least one view."))
        return {
            "project": self.project_path(context),
            "run": self.value(context, "run"),
            "views": ordered(views),
            "conditions": [name.strip() for name in self.value(context, "conditions").split(",") if name.strip()],
            "turn": self.value(context, "turn"),
            "scale": self.value(context, "scale") or None,
            "out": self.path(context, "out"),
        }

    def after(self) -> Done:
        return show_drawing


@scene_settings(run="run", plane="section_plane", turn="turn", scale="paper_scale", out="drawings")
class FIELDWORK_OT_section(ProjectOperator):
    """Draw the section of the mesh by a plane to scale"""

    bl_idname = "fieldwork.section"
    bl_label = "Draw Section"
    verb = "section"
    needs = (need_mesh,)

    def parameters(self, context: Context) -> dict[str, Any]:
        return {
            "project": self.project_path(context),
            "run": self.value(context, "run"),
            "plane": self.value(context, "plane"),
            "turn": self.value(context, "turn"),
            "scale": self.value(context, "scale") or None,
            "out": self.path(context, "out"),
        }

    def after(self) -> Done:
        return show_drawing


@scene_settings(
    run="run",
    other="other_project",
    other_run="other_run",
    points="common_points",
    limit="compare_limit",
    views="sides",
    scale="paper_scale",
    out="compare_path",
)
class FIELDWORK_OT_compare(ProjectOperator):
    """Compare the mesh with that of an earlier epoch of the same object: distances, and areas that changed"""

    bl_idname = "fieldwork.compare"
    bl_label = "Compare"
    verb = "compare"
    needs = (need_mesh,)

    def parameters(self, context: Context) -> dict[str, Any]:
        other = self.path(context, "other")
        if other is None:
            raise ValueError(t("Choose the project of the earlier epoch."))
        unit = context.scene.unit_settings.scale_length or 1.0
        return {
            "project": self.project_path(context),
            "other": other,
            "run": self.value(context, "run"),
            "other_run": self.value(context, "other_run"),
            "points": self.path(context, "points"),
            "limit": self.value(context, "limit") * unit or None,
            "views": ordered(self.value(context, "views")),
            "scale": self.value(context, "scale") or None,
            "out": self.path(context, "out"),
        }

    def after(self) -> Done:
        return show_drawing


@scene_settings(run="run", out="report_path")
class FIELDWORK_OT_report(ProjectOperator):
    """Write a report with photographs, calibration, accuracy and measures, by which others can check and repeat it"""

    bl_idname = "fieldwork.report"
    bl_label = "Write Report"
    verb = "report"
    needs = (need_poses,)

    def parameters(self, context: Context) -> dict[str, Any]:
        return {
            "project": self.project_path(context),
            "run": self.value(context, "run"),
            "out": self.path(context, "out"),
        }


def show_drawing(job: Job) -> None:
    """Show the first drawing in an image editor."""
    refresh_scenes(job)
    files = [Path(path) for path in (job.result or {}).get("files", [])]
    first = next((path for path in files if path.suffix == ".png"), None)
    if job.state == "done" and first is not None and not bpy.app.background:
        show_image(first)


CLASSES = [
    FIELDWORK_OT_turntable,
    FIELDWORK_OT_measure,
    FIELDWORK_OT_plan,
    FIELDWORK_OT_section,
    FIELDWORK_OT_compare,
    FIELDWORK_OT_report,
]
