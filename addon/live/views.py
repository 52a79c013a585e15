"""Lets 3D viewports draw fields. What draws them is loaded when the first is seen: enabling the extension must be quick."""

from __future__ import annotations

import sys
from typing import Any

import bpy

from . import fields, hint

LATER = ("viewport", "training", "scene_depth", "thing_texels")  # modules beside this one that are loaded later
_handle: Any = None


def _draw() -> None:
    context = bpy.context
    if not context.scene.fieldwork_live.viewport or context.region_data is None:
        return
    shown = fields.seen_parts(context.view_layer, context.space_data)
    if shown and not hint.lacks_overlays(context.space_data):
        from .viewport import viewport

        viewport.draw(context, shown)


def register() -> None:
    global _handle
    if not bpy.app.background:
        _handle = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")


def unregister() -> None:
    global _handle
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
        _handle = None
    for name in LATER:
        module = sys.modules.get(f"{__package__}.{name}")
        if module is not None:
            module.unregister()
