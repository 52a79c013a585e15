"""The Capture panel."""

from __future__ import annotations

from bpy.types import Context, UIList

from ..addon import state
from .base import StepPanel, columns, project_folder

STATUS_ICONS = {"ok": "CHECKMARK", "rejected": "CANCEL", "unregistered": "ERROR"}


class FIELDWORK_UL_images(UIList):
    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0):
        row = layout.row(align=True)
        row.active = item.status == "ok"
        row.label(text=item.name, icon=STATUS_ICONS.get(item.status, "QUESTION"))
        if item.reason:
            row.label(text=item.reason)


class FIELDWORK_PT_capture(StepPanel):
    bl_label = "Capture"

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        folder = project_folder(context)
        count = sum(image.status != "rejected" for image in settings.images)
        rejected = len(settings.images) - count
        if state.has_project(folder):
            text = f"{count} photos" + (f", {rejected} rejected" if rejected else "")
            self.draw_state(True, text)
        else:
            self.draw_state(False, "No photos yet")
        column = columns(layout)
        column.prop(settings, "photos")
        column.prop(settings, "labels")
        column.prop(settings, "masks")
        layout.operator("fieldwork.new", icon="IMAGE_DATA")
        layout.operator("fieldwork.import_dataset", icon="IMPORT")


CLASSES = [FIELDWORK_UL_images, FIELDWORK_PT_capture]
