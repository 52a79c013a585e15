"""The Classes panel."""

from __future__ import annotations

from bpy.types import Context, UIList

from ..addon.project import snapshot
from ..addon.text import t
from . import states
from .base import StepPanel, columns
from .states import project_folder


class FIELDWORK_UL_classes(UIList):
    """Color, name, priority, visibility and area of each class."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0):
        row = layout.row(align=True)
        color = row.row()
        color.ui_units_x = 1.2
        color.prop(item, "color", text="")
        row.prop(item, "name", text="", emboss=False)
        side = row.row(align=True)
        side.alignment = "RIGHT"
        if item.area > 0:
            frame = snapshot.frame(project_folder(context))
            side.label(text=t("{:.3g} m²", item.area) if frame.get("scale_known") else f"{item.area:.3g}")
        weight = row.row()
        weight.ui_units_x = 2.4
        weight.prop(item, "priority", text="")
        row.prop(item, "visible", text="", icon="HIDE_OFF" if item.visible else "HIDE_ON", emboss=False)


class FIELDWORK_PT_classes(StepPanel):
    bl_label = "Classes"
    state = staticmethod(states.classes)

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        count = len(settings.classes)
        if not count:
            note = layout.row()
            note.active = False
            note.label(text=t("Choose a folder of labels under Capture, or add classes under Label"))
            return
        labelled = sum(image.labelled for image in settings.images)
        layout.label(text=t("{} classes on {} photos", count, labelled))
        layout.template_list("FIELDWORK_UL_classes", "", settings, "classes", settings, "class_index", rows=4)
        if 0 <= settings.class_index < count:
            entry = settings.classes[settings.class_index]
            column = columns(layout)
            column.prop(entry, "name")
            column.prop(entry, "color")
            column.prop(entry, "priority")


CLASSES = [FIELDWORK_UL_classes, FIELDWORK_PT_classes]
