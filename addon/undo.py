"""Steps of undo for what jobs and timers do: Blender makes them only for what operators do."""

from __future__ import annotations

import bpy


def undo_step(message: str) -> None:
    """Make what was done since the last step one of its own; without a window there is no undo."""
    if not bpy.app.background:
        bpy.ops.ed.undo_push(message=message)
