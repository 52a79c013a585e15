"""The label tool of 3D viewports: strokes and clicks on the surface become marks."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.types import Context, Event, Operator, WorkSpaceTool
from mathutils import Vector

from ..addon.labels import draw, session, surface
from ..addon.project import snapshot
from ..addon.text import t
from .base import engine_reason, need_run
from .label_tool import LabelTool, keymap, mark_parameters

LEAST_STEP = 3.0  # pixels of the screen between two places of a stroke


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
        self._owner, self._last = snapshot.owner(snapshot.folder_of(settings)), (-1e9, -1e9)
        draw.live = draw.Live("", params)
        self._add(context, event)
        if not draw.live.places:
            draw.live = None
            self.report(
                {"WARNING"}, t("There is no surface of the capture here: extract the mesh and press Update Scene.")
            )
            return {"CANCELLED"}
        session.begin(settings)
        if params["shape"] == "part":
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
        if max(abs(a - b) for a, b in zip(place, self._last)) >= LEAST_STEP:
            found = surface.under_mouse(context, self._owner, *place)
            if found is not None:
                self._last = place
                draw.live.places.append(found)

    def _finish(self, context: Context) -> set[str]:
        stroke, draw.live = draw.live, None
        context.area.tag_redraw()
        width = surface.width_at(context, stroke.places[0], stroke.params["width"])
        deliver(context.scene, stroke.params, stroke.places, width)
        return {"FINISHED"}


def surface_parameters(settings: Any, erase: bool) -> dict[str, Any] | None:
    """What a mark on the surface says; a click takes the part that looks alike, for models know photos alone."""
    params = mark_parameters(settings, erase)
    if params is not None and params.pop("box", False):
        params["shape"] = "part"
    return params


def deliver(scene: bpy.types.Scene, params: dict[str, Any], places: list[Vector], width: float) -> None:
    """Hand a mark in the scene to the engine."""
    folder = snapshot.folder_of(scene.fieldwork)
    session.mark(folder, {**params, **surface.parameters(scene, snapshot.owner(folder), places, max(width, 1e-6))})


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
