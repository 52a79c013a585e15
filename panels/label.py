"""The Label panel: in the sidebar of the 3D viewport, and beside the photo in image editors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bpy.types import Context, Panel, UILayout, UIList

from ..addon.jobs.queue import queue
from ..addon.labels import editor, journal, pending, session
from ..addon.project import runs
from ..addon.text import t
from . import label_states as states
from .base import StepPanel, columns, draw_job, draw_outcome, draw_wrapped, text_width
from .states import project_folder

MOST_CONFLICTS = 3  # in the panel
LEAST_ROWS, MOST_ROWS = 3, 9  # of the list of classes


class FIELDWORK_UL_label_classes(UIList):
    """Key, color, name, number of marks, share of the surface and confidence of each class."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0):
        facts = states.facts(context)
        row = layout.row(align=True)
        key = row.row()
        key.ui_units_x, key.active = 0.8, False
        key.label(text=str(index + 1) if index < 9 else "", translate=False)
        color = row.row()
        color.ui_units_x = 1.2
        color.prop(item, "color", text="")
        row.prop(item, "name", text="", emboss=False)
        side = row.row(align=True)
        side.alignment = "RIGHT"
        side.label(text=states.class_text(facts, item.id), translate=False)


class FIELDWORK_PT_label(StepPanel):
    bl_label = "Label"
    state = staticmethod(states.label)

    def draw(self, context: Context) -> None:
        draw_label(self.layout, context)


class FIELDWORK_PT_label_photo(Panel):
    bl_label = "Label"
    bl_space_type = "IMAGE_EDITOR"
    bl_region_type = "UI"
    bl_category = "Fieldwork"

    @classmethod
    def poll(cls, context: Context) -> bool:
        return editor.photo_of(context.space_data.image, project_folder(context)) is not None

    def draw(self, context: Context) -> None:
        layout = self.layout
        if queue.current is not None:
            draw_job(layout, queue.current)
        if queue.outcome is not None:
            draw_outcome(layout, context, queue.outcome)
        draw_label(layout, context)


def draw_label(layout: UILayout, context: Context) -> None:
    settings, folder = context.scene.fieldwork, project_folder(context)
    if folder is None or not runs.has_run(folder, settings.run):
        note = layout.row()
        note.active = False
        note.label(text=t("Train the field first"))
        return
    row = layout.row()
    rows = min(max(len(settings.classes), LEAST_ROWS), MOST_ROWS)
    row.template_list(
        "FIELDWORK_UL_label_classes", "", settings, "classes", settings, "class_index", rows=rows, sort_lock=True
    )
    side = row.column(align=True)
    side.operator("fieldwork.class_add", text="", icon="ADD")
    side.operator("fieldwork.class_remove", text="", icon="REMOVE")
    if 0 <= settings.class_index < len(settings.classes):
        entry = settings.classes[settings.class_index]
        draw_wrapped(layout, states.class_line(states.facts(context), entry.name, entry.id), text_width(context))
    shown = editor.shown_photo(folder)
    row = layout.row(align=True)
    if shown is None:
        row.scale_y = 1.5
        row.operator("fieldwork.label_photo", icon="BRUSH_DATA")
    else:
        row.operator("fieldwork.label_photo", text="", icon="TRIA_LEFT").step = -1
        row.label(text=f"  {shown}", translate=False)
        row.operator("fieldwork.label_photo", text="", icon="TRIA_RIGHT").step = 1
        draw_tools(layout, settings)
    if context.area is not None and context.area.type == "VIEW_3D":
        tool = layout.operator("wm.tool_set_by_id", text=t("Mark the Surface"), icon="MESH_DATA")
        tool.name = "fieldwork.label_surface"
    draw_state_of_marks(layout, context, folder, settings)
    row = layout.row(align=True)
    row.operator("fieldwork.label_next", icon="FORWARD")
    row.operator("fieldwork.label_accept", icon="CHECKMARK")
    column = columns(layout)
    column.prop(settings, "other_project")
    if settings.other_project:
        column.prop(settings, "other_run")
        column.prop(settings, "common_points")
        layout.operator("fieldwork.label_carry", icon="TRACKING_FORWARDS").confirm = False
    column = columns(layout)
    column.prop(settings, "label_features")
    if settings.label_features:
        layout.operator("fieldwork.label_prepare", icon="IMAGE_DATA")
        column = columns(layout)
    column.prop(settings, "label_author")
    column.prop(settings, "label_seconds")
    row = layout.row(align=True)
    row.operator("fieldwork.label_import", text=t("Import…"), icon="IMPORT")
    row.operator("fieldwork.label_export", text=t("Export…"), icon="EXPORT")


def draw_tools(layout: UILayout, settings: Any) -> None:
    # In two rows: the names of five would be cut off in one.
    column = layout.column(align=True)
    tools = [item.identifier for item in settings.bl_rna.properties["label_tool"].enum_items]
    for names in (tools[:3], tools[3:]):
        row = column.row(align=True)
        for name in names:
            row.prop_enum(settings, "label_tool", name)
    column = columns(layout)
    if settings.label_tool == "click":
        column.prop(settings, "label_encoder")
        column.prop(settings, "label_decoder")
        if settings.label_encoder and settings.label_decoder:
            layout.operator("fieldwork.assist_embed", icon="IMAGE_DATA")
        column = columns(layout)
    elif settings.label_tool == "part":
        column.prop(settings, "label_level")
    else:
        column.prop(settings, "label_width")
    column.prop(settings, "label_view")
    column.prop(settings, "label_opacity", slider=True)
    column.prop(settings, "label_strokes")


def draw_state_of_marks(layout: UILayout, context: Context, folder: Path, settings: Any) -> None:
    """Which revision is shown, whether it is being computed, how long that took, and what is wrong."""
    width = text_width(context) - 4
    facts = states.facts(context)
    box = layout.box().column(align=True)
    for text in states.lines(facts):
        draw_wrapped(box, text, width)
    error = pending.error(folder)
    if error is not None:
        draw_wrapped(box, error.message, width, icon="ERROR")
        count = len(pending.marks_of(folder))
        if count:
            kept = t("{} marks are kept and sent again.", count) if count > 1 else t("The mark is kept and sent again.")
            draw_wrapped(box, kept, width, icon="INFO")
    if error is not None or (facts.stale and session.job_of(folder) is None):
        box.operator("fieldwork.label_retry", icon="FILE_REFRESH")
    if facts.told.get("carried"):
        box.operator("fieldwork.label_carry", text=t("They Are Right"), icon="CHECKMARK").confirm = True
    for conflict in facts.told.get("conflicts", [])[:MOST_CONFLICTS]:
        draw_wrapped(box, states.conflict_text(conflict, journal.marks(folder)), width, icon="ERROR")
    for doubt in facts.told.get("doubtful", [])[:MOST_CONFLICTS]:
        names = {item.id: item.name for item in settings.classes}
        draw_wrapped(box, states.doubt_text(doubt, journal.marks(folder), names), width, icon="QUESTION")


CLASSES = [FIELDWORK_UL_label_classes, FIELDWORK_PT_label, FIELDWORK_PT_label_photo]
