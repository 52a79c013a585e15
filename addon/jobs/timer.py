"""What drives the queue of jobs: one persistent timer, and handlers for other files, undo and redo."""

from __future__ import annotations

from typing import Any

import bpy

from .. import machine
from ..project import snapshot as state
from . import queue as jobs


def _tick() -> float:
    return jobs.queue.tick()


@bpy.app.handlers.persistent
def _undone(*_: Any) -> None:
    jobs.queue.edits += 1
    for scene in bpy.data.scenes:
        state.undone(scene.fieldwork)


@bpy.app.handlers.persistent
def _file_loaded(*_: Any) -> None:
    """Another file: its project may have a job that runs elsewhere."""
    jobs.queue.edits += 1
    settings = getattr(bpy.context.scene, "fieldwork", None)
    folder = state.folder_of(settings) if settings else None
    if folder is not None:
        state.refresh(settings)
        if not bpy.app.background:
            jobs.queue.reattach(folder)


def register() -> None:
    bpy.app.handlers.load_post.append(_file_loaded)
    bpy.app.handlers.undo_post.append(_undone)
    bpy.app.handlers.redo_post.append(_undone)
    if not bpy.app.background:
        bpy.app.timers.register(_tick, first_interval=jobs.IDLE_PERIOD, persistent=True)


def unregister() -> None:
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    bpy.app.handlers.load_post.remove(_file_loaded)
    bpy.app.handlers.undo_post.remove(_undone)
    bpy.app.handlers.redo_post.remove(_undone)
    jobs.queue.stop_engine(detach=jobs.queue.running is not None and machine.preferences().on_close == "continue")
    jobs.queue.__init__()
