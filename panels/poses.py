"""The Poses panel."""

from __future__ import annotations

from bpy.types import Context

from ..addon import state
from .base import StepPanel, columns, project_folder


class FIELDWORK_PT_poses(StepPanel):
    bl_label = "Poses"

    def draw(self, context: Context) -> None:
        settings = context.scene.fieldwork
        done = state.has_poses(project_folder(context))
        registered = sum(image.status == "ok" for image in settings.images)
        self.draw_state(done, f"{registered} of {len(settings.images)} photos placed" if done else "No poses yet")
        columns(self.layout).prop(settings, "pose_preset")
        self.layout.operator("fieldwork.poses", icon="CAMERA_DATA")


CLASSES = [FIELDWORK_PT_poses]
