"""Mesh: the labelled surface of the field."""

from __future__ import annotations

from typing import Any

from bpy.types import Context

from .base import ProjectOperator, need_run, scene_settings


@scene_settings(
    run="run",
    resolution="resolution",
    detail="detail",
    region="mesh_region",
    turntable="turntable",
    faces="faces",
    lods="lods",
    texture="texture",
    texture_kind="texture_kind",
    watertight="watertight",
    out="mesh_file",
    split="split",
)
class FIELDWORK_OT_mesh(ProjectOperator):
    """Extract the surface with its colors and labels"""

    bl_idname = "fieldwork.mesh"
    bl_label = "Extract Mesh"
    verb = "mesh"
    needs = (need_run,)

    def parameters(self, context: Context) -> dict[str, Any]:
        return {
            "project": self.project_path(context),
            "run": self.value(context, "run"),
            "resolution": self.value(context, "resolution"),
            "detail": self.value(context, "detail") or None,
            "region": self.value(context, "region"),
            "turntable": self.path(context, "turntable"),
            "faces": self.value(context, "faces") or None,
            "lods": self.value(context, "lods"),
            "texture": int(self.value(context, "texture")) or None,
            "watertight": self.value(context, "watertight"),
            "texture_kind": self.value(context, "texture_kind"),
            "out": self.path(context, "out"),
            "split": self.value(context, "split"),
        }


CLASSES = [FIELDWORK_OT_mesh]
