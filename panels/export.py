"""The Export panel."""

from __future__ import annotations

from pathlib import Path

from bpy.types import Context

from ..addon.jobs.queue import queue
from ..addon.project import runs
from ..addon.text import t
from .base import StepPanel, columns, project_folder


class FIELDWORK_PT_export(StepPanel):
    bl_label = "Export"

    def draw(self, context: Context) -> None:
        layout = self.layout
        settings, folder = context.scene.fieldwork, project_folder(context)
        last = next((j for j in reversed(queue.finished) if j.verb in ("blend", "export") and j.result), None)
        if last is not None and last.result is not None:
            first = last.result["file"] if last.verb == "blend" else last.result["files"][0]
            self.draw_state(True, t("Written: {}", Path(first).name))
        elif runs.has_run(folder, settings.run):
            self.draw_state(False, t("Ready to export"))
        else:
            self.draw_state(False, t("Run “{}” is not trained yet", settings.run))
        column = columns(layout)
        column.prop(settings, "export_to")
        column.prop(settings, "export_path")
        if settings.export_to == "voxels":
            column.prop(settings, "voxels")
        elif settings.export_to != "onnx":
            column.prop(settings, "export_split")
        if settings.export_to == "blend":
            layout.operator("fieldwork.blend", icon="FILE_BLEND")
        else:
            layout.operator("fieldwork.export", icon="EXPORT")


CLASSES = [FIELDWORK_PT_export]
