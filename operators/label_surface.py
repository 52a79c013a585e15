"""The label tool of 3D viewports: strokes and clicks on the surface become marks."""

from __future__ import annotations

from functools import partial
from typing import Any

import bpy
from bpy.types import Context, Event, Operator, WorkSpaceTool
from mathutils import Vector

from ..addon.labels import draw, session, surface
from ..addon.labels.trail import Trail
from ..addon.project import snapshot
from ..addon.text import t
from .base import engine_reason, need_run
from .label_tool import LabelTool, keymap, mark_parameters


class FIELDWORK_OT_label_surface(Operator):
    """Draw a mark on the surface in the viewport; with Ctrl it erases"""

    bl_idname = "fieldwork.label_surface"
    bl_label = "Mark Surface"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: Context) -> bool:
        return context.space_data is not None and context.space_data.type == "VIEW_3D" and need_run(context) is None

    def invoke(self, context: Context, event: Event) -> set[str]:
        settings = context.scene.fieldwork
        reason = engine_reason()
        params = None if reason else surface_parameters(settings, event.ctrl)
        if params is None:
            self.report({"ERROR"}, reason or t("Add a class first: the + beside the list of classes"))
            return {"CANCELLED"}
        self._owner, self._trail = snapshot.owner(snapshot.folder_of(settings)), Trail(params["width"])
        draw.live = draw.Live("", params, pieces=self._trail.pieces)
        self._add(context, event)
        if params["shape"] == "part" or not surface.is_shown(context.visible_objects, self._owner):
            return self._finish(context)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: Context, event: Event) -> set[str]:
        if draw.live is None or event.type in {"ESC", "RIGHTMOUSE", "WINDOW_DEACTIVATE"}:
            draw.live = None
            context.area.tag_redraw()
            return {"CANCELLED"}
        if event.type in {"MOUSEMOVE", "INBETWEEN_MOUSEMOVE"}:
            self._add(context, event)
            context.area.tag_redraw()
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            return self._finish(context)
        return {"RUNNING_MODAL"}

    def _add(self, context: Context, event: Event) -> None:
        place = (event.mouse_x - context.region.x, event.mouse_y - context.region.y)
        self._trail.go(*place, partial(surface.under_mouse, context, self._owner))

    def _finish(self, context: Context) -> set[str]:
        stroke, draw.live = draw.live, None
        context.area.tag_redraw()
        if not stroke.pieces:
            missing = "There is no surface of the capture here: extract the mesh and press Update Scene."
            shown = surface.is_shown(context.visible_objects, self._owner)
            self.report({"WARNING"}, t("The stroke met no surface of the capture.") if shown else t(missing))
            return {"CANCELLED"}
        session.begin(context.scene.fieldwork)
        widths = [surface.width_at(context, piece[0], stroke.params["width"]) for piece in stroke.pieces]
        deliver(context.scene, stroke.params, stroke.pieces, widths)
        return {"FINISHED"}


def surface_parameters(settings: Any, erase: bool) -> dict[str, Any] | None:
    """What a mark on the surface says; a click takes the part that looks alike, for models know photos alone."""
    params = mark_parameters(settings, erase)
    if params is not None and params.pop("box", False):
        params["shape"] = "part"
    return params


def deliver(scene: bpy.types.Scene, params: dict[str, Any], pieces: list[list[Vector]], widths: list[float]) -> None:
    """Hand a stroke in the scene to the engine: a mark for each piece of it, all of them one step of undo."""
    folder = snapshot.folder_of(scene.fieldwork)
    owner = snapshot.owner(folder)
    for number, (places, width) in enumerate(zip(pieces, widths), 1):
        values = surface.parameters(scene, owner, places, max(width, 1e-6))
        session.mark(folder, {**params, **values}, more=number < len(pieces))


class FIELDWORK_TOOL_label_surface(LabelTool, WorkSpaceTool):
    bl_space_type = "VIEW_3D"
    bl_context_mode = "OBJECT"
    bl_idname = "fieldwork.label_surface"
    bl_description = "Mark what belongs to a class on the surface of a capture"
    bl_keymap = keymap("fieldwork.label_surface")


CLASSES = [FIELDWORK_OT_label_surface]


def register() -> None:
    bpy.utils.register_tool(FIELDWORK_TOOL_label_surface, separator=True)


def unregister() -> None:
    bpy.utils.unregister_tool(FIELDWORK_TOOL_label_surface)
