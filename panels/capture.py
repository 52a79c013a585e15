"""The Capture panel: where the photos come from, and what was made of each."""

from __future__ import annotations

from bpy.types import Context, Panel, UIList

from ..addon.pictures import thumbnails
from ..addon.project import snapshot
from ..addon.text import t
from . import states
from .base import FieldworkPanel, StepPanel, columns, draw_wrapped, text_width
from .states import project_folder

STATUS_ICONS = {"ok": "CHECKMARK", "rejected": "CANCEL", "unregistered": "ERROR"}


class FIELDWORK_UL_images(UIList):
    """Photos with their thumbnail and, where one is not used, why."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0):
        folder = project_folder(context)
        thumbnail = thumbnails.picture(folder / item.file) if folder and item.file else 0
        row = layout.row(align=True)
        row.active = item.status == "ok"
        row.label(text=item.name, icon_value=thumbnail or 0) if thumbnail else row.label(text=item.name)
        marks = row.row(align=True)
        marks.alignment = "RIGHT"
        if item.labelled:
            marks.label(text="", icon="COLOR")
        if item.masked:
            marks.label(text="", icon="MOD_MASK")
        marks.label(text="", icon=STATUS_ICONS.get(item.status, "QUESTION"))


class FIELDWORK_PT_capture(StepPanel):
    bl_label = "Capture"
    state = staticmethod(states.capture)

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        folder = project_folder(context)
        row = layout.row(align=True)
        row.operator("fieldwork.open", text=t("Open…"), icon="FILE_FOLDER")
        row.operator("fieldwork.import_dataset", text=t("Import Posed…"), icon="IMPORT")
        column = columns(layout)
        column.enabled = not states.training(context)
        for name in ("photos", "labels", "masks", "class_file"):
            column.prop(settings, name)
        row = layout.row(align=True)
        row.operator("fieldwork.new", icon="IMAGE_DATA").add = False
        if snapshot.has_project(folder):
            row.operator("fieldwork.new", text=t("Add"), icon="ADD").add = True
        if settings.images:
            draw_images(layout, context)


class FIELDWORK_PT_capture_options(FieldworkPanel, Panel):
    bl_label = "Options"
    bl_parent_id = "FIELDWORK_PT_capture"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: Context) -> None:
        column = columns(self.layout)
        column.enabled = not states.training(context)
        for name in ("max_size", "frames", "mask_mode", "keep_backdrop", "keep_blurry"):
            column.prop(context.scene.fieldwork, name)


def draw_images(layout, context: Context) -> None:
    settings, folder = context.scene.fieldwork, project_folder(context)
    layout.template_list("FIELDWORK_UL_images", "capture", settings, "images", settings, "image_index", rows=4)
    if not 0 <= settings.image_index < len(settings.images):
        return
    image = settings.images[settings.image_index]
    icon = thumbnails.picture(folder / image.file) if folder and image.file else 0
    if icon:
        layout.template_icon(icon_value=icon, scale=6.0)
    if image.reason:
        draw_wrapped(layout, image.reason, text_width(context), icon=STATUS_ICONS.get(image.status, "INFO"))


CLASSES = [FIELDWORK_UL_images, FIELDWORK_PT_capture, FIELDWORK_PT_capture_options]
