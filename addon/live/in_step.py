"""Keeps the scenes that render the field and its shadows in step with the one that they were made for.

In a window a timer does that: a render runs in a thread, which may not touch the scene. Without one, each render does.
"""

from __future__ import annotations

from typing import Any

import bpy

from ..jobs import gate
from ..roles import is_local
from . import compositor

PERIOD = 0.25  # seconds between two looks


@bpy.app.handlers.persistent
def _rendering(scene: bpy.types.Scene, *_: Any) -> None:
    compositor.follow(scene)


def _tick() -> float:
    composited = [scene for scene in bpy.data.scenes if compositor.FIELD_SCENE in scene and is_local(scene)]
    if composited and gate.closed() is None:
        for scene in composited:
            compositor.follow(scene)
    return PERIOD


def register() -> None:
    if bpy.app.background:
        bpy.app.handlers.render_init.append(_rendering)
    else:
        bpy.app.timers.register(_tick, first_interval=PERIOD, persistent=True)


def unregister() -> None:
    if _rendering in bpy.app.handlers.render_init:
        bpy.app.handlers.render_init.remove(_rendering)
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
