"""Export: the capture as a .blend of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bpy.types import Context

from ..addon.text import t
from .base import ProjectOperator, need_run, scene_settings


@scene_settings(run="run", out="export_path")
class FIELDWORK_OT_blend(ProjectOperator):
    """Write a .blend with the cameras, points, mesh and materials of the capture"""

    bl_idname = "fieldwork.blend"
    bl_label = "Write .blend"
    verb = "blend"
    needs = (need_run,)

    def parameters(self, context: Context) -> dict[str, Any]:
        project, run = self.project_path(context), self.value(context, "run")
        out = self.path(context, "out") or str(Path(project, "exports", run, f"{Path(project).name}.blend"))
        if not out.endswith(".blend"):
            raise ValueError(t("Name a file that ends in .blend."))
        return {"project": project, "run": run, "out": out}


CLASSES = [FIELDWORK_OT_blend]
