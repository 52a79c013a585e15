"""The Export panel."""

from __future__ import annotations

from pathlib import Path

from bpy.types import Context

from ..addon import jobs
from ..addon.text import t
from .base import StepPanel, columns


class FIELDWORK_PT_export(StepPanel):
    bl_label = "Export"

    def draw(self, context: Context) -> None:
        layout = self.layout
        last = next((j for j in reversed(jobs.queue.finished) if j.verb == "blend" and j.state == "done"), None)
        if last is not None:
            self.draw_state(True, t("Written: {}", Path((last.result or {}).get("file", "")).name))
        columns(layout).prop(context.scene.fieldwork, "export_path")
        layout.operator("fieldwork.blend", icon="FILE_BLEND")


CLASSES = [FIELDWORK_PT_export]
