"""Says in the header of a 3D viewport that fields are not shown rightly in it, where nothing else would."""

from __future__ import annotations

from typing import Any

import bpy

from ..text import t
from . import fields

# Up to there a handler gets no depth where overlays are hidden: a field would be before everything, or not there.
NEEDS_OVERLAYS = bpy.app.version < (4, 3, 0)


def lacks_overlays(space: Any) -> bool:
    """Whether a viewport does not show fields because its overlays are hidden."""
    return NEEDS_OVERLAYS and space is not None and not space.overlay.show_overlays


def draw(self: Any, context: bpy.types.Context) -> None:
    """Part of the header of a 3D viewport."""
    if not lacks_overlays(context.space_data) or not context.scene.fieldwork_live.viewport:
        return
    if fields.seen_parts(context.view_layer, context.space_data):
        row = self.layout.row()
        row.alert = True
        row.prop(context.space_data.overlay, "show_overlays", text=t("Show overlays to see the field"), icon="INFO")


def register() -> None:
    if not bpy.app.background:
        bpy.types.VIEW3D_HT_header.append(draw)


def unregister() -> None:
    if not bpy.app.background:
        bpy.types.VIEW3D_HT_header.remove(draw)
