"""When the timer may touch the scene: never under the user's hands. Else what it has to do there waits."""

from __future__ import annotations

import bpy

from ..text import t

BUSY = ("RENDER", "OBJECT_BAKE")  # Blender's own jobs that read the scene meanwhile

_loading = False


def set_loading(loading: bool) -> None:
    """A file begins to load, or is loaded, or could not be."""
    global _loading
    _loading = loading


def closed() -> str | None:
    """Why the scene must be left alone just now, in a few words for the panel; None when it may be changed."""
    if _loading:
        return t("Waits until the file is loaded")
    if any(bpy.app.is_job_running(kind) for kind in BUSY):
        return t("Waits until the render ends")
    for window in bpy.context.window_manager.windows:
        active = window.view_layer.objects.active
        if active is not None and active.mode != "OBJECT":
            return t("Waits for Object Mode")
        for operator in window.modal_operators:
            return t("Waits until “{}” ends", operator.name)
    return None
