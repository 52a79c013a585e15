"""Keeps the scenes that render the field and its shadows in step with the one that they were made for, and tells why a
field is missing in a composite.

In a window a timer does that: a render runs in a thread, which may not touch the scene. Without one, each render does.
"""

from __future__ import annotations

import textwrap
import time
from typing import Any

import bpy

from ..errors import EngineError
from ..jobs import gate
from ..jobs.job import Job
from ..jobs.queue import queue
from ..roles import is_local
from ..text import t
from . import engine
from .shared_scene import FIELD_SCENE

PERIOD = 0.25  # seconds between two looks
WIDTH = 60  # characters of a line of the message


@bpy.app.handlers.persistent
def _rendering(scene: bpy.types.Scene, *_: Any) -> None:
    from . import compositor  # not at the top: enabling the extension must be quick

    compositor.follow(scene)


def _taken() -> str:
    """Why a field is missing in what was rendered last; the panel tells it from now on."""
    message = engine.untold[0]
    engine.untold.clear()
    error = EngineError("scene", t("The field is missing in the render: {}", message))
    queue.remember(Job("frame", {}, f"frame-{time.time_ns()}", state="failed", error=error))
    queue.redraw()
    return message


def _show(message: str) -> None:
    """Show it at the mouse."""
    lines = textwrap.wrap(message, WIDTH)
    # The newest window is that of the render, where it has one.
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[-1]):
        bpy.context.window_manager.popup_menu(
            lambda menu, _: _draw(menu, lines), title=t("The field is missing in the render"), icon="ERROR"
        )


def _draw(menu: Any, lines: list[str]) -> None:
    for line in lines:
        menu.layout.label(text=line, translate=False)


def _look() -> None:
    if engine.untold and not bpy.app.is_job_running("RENDER"):
        _show(_taken())
    composited = [scene for scene in bpy.data.scenes if FIELD_SCENE in scene and is_local(scene)]
    if composited and gate.closed() is None:
        from . import compositor

        for scene in composited:
            compositor.follow(scene)


def _tick() -> float:
    try:
        _look()
    except Exception as error:  # noqa: BLE001 - a timer that raises is dropped by Blender
        queue.tell(error)
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
