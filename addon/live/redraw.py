"""Views in which fields may be."""

import bpy


def redraw_views() -> None:
    """Let all 3D viewports be drawn anew."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()
