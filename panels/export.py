"""The Export panel."""

from __future__ import annotations

from bpy.types import Context

from ..operators.export import OF_THE_MESH
from . import states
from .base import StepPanel, columns, open_folder

SPLIT = {"blend", *OF_THE_MESH} - {"masks"}  # formats that hold objects


class FIELDWORK_PT_export(StepPanel):
    bl_label = "Export"
    state = staticmethod(states.export)

    def draw(self, context: Context) -> None:
        layout = self.layout
        settings = context.scene.fieldwork
        column = columns(layout)
        column.prop(settings, "export_to")
        column.prop(settings, "export_path")
        if settings.export_to == "voxels":
            column.prop(settings, "voxels")
        elif settings.export_to in SPLIT:
            column.prop(settings, "export_split")
        if settings.export_to == "blend":
            layout.operator("fieldwork.blend", icon="FILE_BLEND")
        else:
            layout.operator("fieldwork.export", icon="EXPORT")
        file = states.exported(context)
        open_folder(layout, file.parent if file else None)


CLASSES = [FIELDWORK_PT_export]
