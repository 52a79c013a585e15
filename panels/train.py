"""The Train panel."""

from __future__ import annotations

from bpy.types import Context

from ..addon import state
from .base import StepPanel, columns, project_folder


class FIELDWORK_PT_train(StepPanel):
    bl_label = "Train"

    def draw(self, context: Context) -> None:
        settings = context.scene.fieldwork
        done = state.has_run(project_folder(context), settings.run)
        self.draw_state(done, f"Run “{settings.run}” is trained" if done else "Not trained yet")
        column = columns(self.layout)
        column.prop(settings, "preset")
        self.layout.operator("fieldwork.train", icon="PLAY")


CLASSES = [FIELDWORK_PT_train]
