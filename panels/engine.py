"""The Engine panel."""

from __future__ import annotations

from bpy.types import Context

from ..addon import jobs
from .base import StepPanel


class FIELDWORK_PT_engine(StepPanel):
    bl_label = "Engine"

    def draw(self, context: Context) -> None:
        link = jobs.queue.link
        running = link is not None and link.alive
        self.draw_state(running, "Running" if running else "Not running; starts when needed")
        row = self.layout.row()
        row.operator("fieldwork.doctor")
        row.operator("fieldwork.stop_engine")


CLASSES = [FIELDWORK_PT_engine]
