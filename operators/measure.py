"""Measure: sizes of what is on the mesh."""

from __future__ import annotations

from typing import Any

from bpy.types import Context

from ..addon.project import snapshot
from ..addon.text import t
from .base import ProjectOperator, need_project, scene_settings


def need_mesh(context: Context) -> str | None:
    settings = context.scene.fieldwork
    folder = snapshot.folder_of(settings)
    there = folder is not None and (folder / "exports" / settings.run / "mesh.npz").is_file()
    return need_project(context) or (None if there else t("Extract the mesh first"))


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


CLASSES = [FIELDWORK_OT_measure]
