"""The Things panel: what is on the mesh, each thing below what holds it, and questions."""

from __future__ import annotations

from bpy.types import Context, UILayout

from ..addon.project import things
from ..addon.text import t
from ..operators.measure import need_mesh
from .base import StepPanel
from .states import State, project_folder

MOST_LINES = 60
ICONS = {"part of": "LINKED", "in": "PACKAGE", "on": "TRIA_DOWN_BAR", "hangs on": "HOOK"}


def state(context: Context) -> State:
    known = things.graph(project_folder(context), context.scene.fieldwork.run)
    return State(known is not None, t("{} things", len(known["things"])) if known is not None else "")


def what_is_next(context: Context) -> str:
    """What is to be done before there is a list of things."""
    if need_mesh(context) is None:
        return t("The things on the mesh are listed once their relations are found")
    return t("Extract the mesh, then find its relations")


class FIELDWORK_PT_things(StepPanel):
    bl_label = "Things"
    state = staticmethod(state)

    def draw(self, context: Context) -> None:
        layout, settings = self.layout, context.scene.fieldwork
        known = things.graph(project_folder(context), settings.run)
        row = layout.row(align=True)
        row.prop(settings, "thing_query", text="", icon="VIEWZOOM")
        row.operator("fieldwork.relations", text=t("Select") if settings.thing_query else t("Find Relations"))
        if known is None:
            note = layout.row()
            note.active = False
            note.label(text=what_is_next(context))
            return
        draw_outline(layout, things.outline(known))
        row = layout.row(align=True)
        row.operator("fieldwork.instances", text=t("Rename…"), icon="GREASEPENCIL")
        row.operator("fieldwork.instances", text=t("Join"), icon="AUTOMERGE_ON").merge = True
        row.operator("fieldwork.instances", text=t("Split"), icon="MOD_EXPLODE").split = True


def draw_outline(layout: UILayout, lines: list[things.Line]) -> None:
    """A line for each thing, indented by what holds it; a click selects it."""
    box = layout.box().column(align=True)
    for line in lines[:MOST_LINES]:
        row = box.row(align=True)
        if line.depth:
            space = row.row()
            space.ui_units_x = 0.8 * line.depth
            space.label(text="")
        side = row.row(align=True)
        side.alignment = "LEFT"
        button = side.operator(
            "fieldwork.select_thing",
            text=line.name,
            icon=ICONS.get(line.relation, "MESH_CUBE"),
            emboss=False,
            translate=False,
        )
        button.number = line.id
        told = row.row()
        told.alignment, told.active = "RIGHT", False
        words = [t(line.relation)] * bool(line.relation) + [t("next to {}", ", ".join(line.beside[:2]))] * bool(
            line.beside
        )
        told.label(text=", ".join(words), translate=False)
    if len(lines) > MOST_LINES:
        box.label(text=t("{} more in scene_graph.json", len(lines) - MOST_LINES))


CLASSES = [FIELDWORK_PT_things]
