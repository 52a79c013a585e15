"""Draws anew what shows jobs: nothing else in Blender knows that they have changed."""

from __future__ import annotations

import bpy


def panels() -> bool:
    """Let sidebars, labelled photos, preferences and the status bar be drawn anew; whether the status bar of every window will be."""
    everywhere = True
    for window in bpy.context.window_manager.windows:
        # Nothing else redraws the status bar; a running tool's own text in it must stay.
        if getattr(window, "modal_operators", None):
            everywhere = False
        else:
            with bpy.context.temp_override(window=window):
                window.workspace.status_text_set_internal(None)
        for area in window.screen.areas:
            if area.type in ("VIEW_3D", "PREFERENCES", "IMAGE_EDITOR"):
                for region in area.regions:
                    if region.type in ("UI", "WINDOW") and (area.type != "VIEW_3D" or region.type == "UI"):
                        region.tag_redraw()
    return everywhere
