"""The label tool of image editors: strokes and clicks on a photo become marks."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.types import Context, Event, Operator, UILayout, WorkSpaceTool

from ..addon.labels import draw, editor, session
from ..addon.project import snapshot
from ..addon.text import t
from .base import engine_reason
from .label_models import cut_out

LEAST_STEP = 1.0  # pixels of the screen between two points of a stroke
DIGITS = 2  # of pixels in the journal
NUMBERS = ("ONE", "TWO", "THREE", "FOUR", "FIVE", "SIX", "SEVEN", "EIGHT", "NINE")
KEYS = (
    ("fieldwork.label_size", {"type": "LEFT_BRACKET", "value": "PRESS"}, {"properties": [("factor", 0.8)]}),
    ("fieldwork.label_size", {"type": "RIGHT_BRACKET", "value": "PRESS"}, {"properties": [("factor", 1.25)]}),
    ("fieldwork.label_next", {"type": "N", "value": "PRESS", "shift": True}, None),
    ("fieldwork.label_undo", {"type": "Z", "value": "PRESS", "ctrl": True}, None),
    ("fieldwork.label_undo", {"type": "Z", "value": "PRESS", "oskey": True}, None),
    *(
        ("fieldwork.label_class", {"type": key, "value": "PRESS"}, {"properties": [("number", number)]})
        for number, key in enumerate(NUMBERS, 1)
    ),
)


class FIELDWORK_OT_label_mark(Operator):
    """Draw a mark on the photo; with Ctrl it erases"""

    bl_idname = "fieldwork.label_mark"
    bl_label = "Mark"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: Context) -> bool:
        folder = snapshot.folder_of(context.scene.fieldwork)
        space = context.space_data
        return space is not None and space.type == "IMAGE_EDITOR" and editor.photo_of(space.image, folder) is not None

    def invoke(self, context: Context, event: Event) -> set[str]:
        settings = context.scene.fieldwork
        reason = engine_reason()
        params = None if reason else mark_parameters(settings, event.ctrl)
        if params is None:
            self.report({"ERROR"}, reason or t("Add a class first: the + beside the list of classes"))
            return {"CANCELLED"}
        photo = editor.photo_of(context.space_data.image, snapshot.folder_of(settings))
        self._size, self._last = (photo["width"], photo["height"]), (-1e9, -1e9)
        draw.live = draw.Live(str(photo["name"]), {**params, "photo": str(photo["name"])})
        self._area, self._region = context.area, context.region
        self._add(event)
        if params["shape"] == "part" and not params.get("box"):
            return self._finish(context)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: Context, event: Event) -> set[str]:
        if draw.live is None or event.type in {"ESC", "RIGHTMOUSE", "WINDOW_DEACTIVATE"}:
            draw.live = None
            self._area.tag_redraw()
            return {"CANCELLED"}
        if event.type in {"MOUSEMOVE", "INBETWEEN_MOUSEMOVE"}:
            self._add(event)
            self._area.tag_redraw()
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            self._add(event)
            return self._finish(context)
        return {"RUNNING_MODAL"}

    def _add(self, event: Event) -> None:
        place = (event.mouse_x - self._region.x, event.mouse_y - self._region.y)
        if max(abs(a - b) for a, b in zip(place, self._last)) >= LEAST_STEP:
            self._last = place
            x, y = (round(v, DIGITS) for v in editor.pixel_at(self._region, self._size, *place))
            if draw.live.params.get("box") and draw.live.points:  # its corners, along the way that an outline goes
                left, top = draw.live.points[0]
                draw.live.points = [(left, top), (x, top), (x, y), (left, y)]
            else:
                draw.live.points.append((x, y))

    def _finish(self, context: Context) -> set[str]:
        stroke, draw.live = draw.live, None
        settings = context.scene.fieldwork
        folder = snapshot.folder_of(settings)
        self._area.tag_redraw()
        if stroke.params.get("box"):
            try:
                cut_out(settings, folder, stroke.photo, stroke.points[:: max(1, len(stroke.points) // 2)][:2])
            except RuntimeError as error:
                self.report({"ERROR"}, str(error))
                return {"CANCELLED"}
        else:
            session.mark(folder, {**stroke.params, "points": stroke.points})
        return {"FINISHED"}


def mark_parameters(settings: Any, erase: bool = False) -> dict[str, Any] | None:
    """What a mark with the chosen tool says, as parameters of `label stroke`; None where no class is chosen. `box`: a model is
    to be asked."""
    tool = "erase" if erase else settings.label_tool
    params: dict[str, Any] = {"shape": "line", "width": settings.label_width, "author": settings.label_author}
    if tool == "erase":
        return {**params, "erase": True}
    if tool == "void":
        return {**params, "void": True}
    if not 0 <= settings.class_index < len(settings.classes):
        return None
    shape = {"shape": "part", "width": 2.0} if tool in ("click", "part") else {}
    if tool == "part":
        shape["level"] = settings.label_level
    elif shape and settings.label_encoder and settings.label_decoder:
        shape = {"shape": "outline", "width": 2.0, "box": True}  # a model cuts out what is clicked or boxed
    return {**params, **shape, "class_id": settings.classes[settings.class_index].id}


class LabelTool:
    """What the tools of all editors share."""

    bl_label = "Label"
    bl_icon = "brush.generic"
    bl_cursor = "CROSSHAIR"

    @staticmethod
    def draw_settings(context: Context, layout: UILayout, tool: Any) -> None:
        settings = context.scene.fieldwork
        layout.prop(settings, "label_tool", text="")
        layout.prop(settings, "label_level" if settings.label_tool == "part" else "label_width")


def keymap(operator: str) -> tuple[Any, ...]:
    """The keys of a tool whose strokes an operator takes: with Ctrl they erase."""
    press = {"type": "LEFTMOUSE", "value": "PRESS"}
    return ((operator, press, None), (operator, {**press, "ctrl": True}, None), *KEYS)


class FIELDWORK_TOOL_label(LabelTool, WorkSpaceTool):
    bl_space_type = "IMAGE_EDITOR"
    bl_context_mode = "VIEW"
    bl_idname = editor.TOOL
    bl_description = "Mark what belongs to a class on the photos of a capture"
    bl_keymap = keymap("fieldwork.label_mark")

    @staticmethod
    def draw_settings(context: Context, layout: UILayout, tool: Any) -> None:
        LabelTool.draw_settings(context, layout, tool)
        settings = context.scene.fieldwork
        layout.prop(settings, "label_view", text="")
        layout.prop(settings, "label_opacity")

    @staticmethod
    def draw_cursor(context: Context, tool: Any, xy: tuple[int, int]) -> None:
        """The brush's circle around the mouse."""
        space = context.space_data
        photo = editor.photo_of(getattr(space, "image", None), snapshot.folder_of(context.scene.fieldwork))
        settings = context.scene.fieldwork
        if photo is None or context.region is None or settings.label_tool in ("click", "part"):
            return
        from gpu_extras.presets import draw_circle_2d

        radius = settings.label_width / 2 * editor.zoom(context.region, (photo["width"], photo["height"]))
        draw_circle_2d(xy, (1.0, 1.0, 1.0, 0.9), max(2.0, radius), segments=32)


CLASSES = [FIELDWORK_OT_label_mark]


def register() -> None:
    bpy.utils.register_tool(FIELDWORK_TOOL_label, separator=True)


def unregister() -> None:
    bpy.utils.unregister_tool(FIELDWORK_TOOL_label)
