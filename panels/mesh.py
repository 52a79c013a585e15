"""The Mesh panel."""

from __future__ import annotations

from bpy.types import Context

from .base import StepPanel, columns


class FIELDWORK_PT_mesh(StepPanel):
    bl_label = "Mesh"

    def draw(self, context: Context) -> None:
        settings = context.scene.fieldwork
        column = columns(self.layout)
        for name in ("resolution", "faces", "texture", "split"):
            column.prop(settings, name)
        self.layout.operator("fieldwork.mesh", icon="MESH_DATA")


CLASSES = [FIELDWORK_PT_mesh]
