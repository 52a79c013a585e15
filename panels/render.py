"""The Render panel."""

from __future__ import annotations

from bpy.types import Context

from ..addon.text import t
from . import states
from .base import StepPanel, columns, open_folder


class FIELDWORK_PT_render(StepPanel):
    bl_label = "Render"
    state = staticmethod(states.render)

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        column = columns(layout)
        column.prop(settings, "render_from")
        if settings.render_from == "orbit":
            column.prop(settings, "orbit")
        column.prop(settings, "size")
        layout.column_flow(columns=3, align=True).prop(settings, "passes")
        columns(layout).prop(settings, "show_as")
        layout.operator("fieldwork.render", icon="RENDER_STILL")
        shown = states.rendered(context)
        if shown:
            row = layout.row(align=True)
            show = row.operator("fieldwork.show_image", text=t("Show"), icon="IMAGE_DATA")
            show.filepath = str(shown[0])
            open_folder(row, shown[0].parent)


CLASSES = [FIELDWORK_PT_render]
