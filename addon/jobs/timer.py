"""What drives the queue of jobs, and takes edits of the project to the engine: one persistent timer, and handlers for
other files, undo and redo."""

from __future__ import annotations

import time
from typing import Any

import bpy

from .. import machine
from ..project import edits, lists, region, snapshot
from .follow import follow, reattach
from .queue import Queue, queue

BUSY_PERIOD = 0.1  # seconds between two looks at the engine while something goes on
IDLE_PERIOD = 0.5
SLICE_PERIOD = 0.01  # seconds between two slices of work in Blender
DRAW_PERIOD = 0.4  # seconds between two drawings of the panels and the status bar while a job runs


def tick(queue: Queue) -> float:
    """One look at the engine, and at what the scene says of its project. Returns the seconds until the next."""
    begin, busy_since = time.perf_counter(), time.thread_time()
    doing = f"{queue.current.stage} {queue.current.message}" if queue.current else ""
    try:
        # Edits before jobs: a training that starts now is to know of them.
        if not bpy.app.background:
            region.follow(bpy.context.scene)
        edits.send(queue.ask)
        follow(queue)
        queue.work()
    except Exception:
        # A timer that raises is dropped by Blender, and all jobs with it.
        import logging

        logging.getLogger("fieldwork.addon").exception("Fieldwork's timer failed")
    due = queue.busy and time.monotonic() - queue.drawn > DRAW_PERIOD
    if due or queue.undrawn:
        queue.redraw()
    seconds = time.perf_counter() - begin
    queue.slowest_cpu = max(queue.slowest_cpu, time.thread_time() - busy_since)
    if seconds > queue.slowest_tick:
        queue.slowest_tick, queue.slowest_step = seconds, doing
    return SLICE_PERIOD if queue.sliced else BUSY_PERIOD if queue.busy else IDLE_PERIOD


def _tick() -> float:
    return tick(queue)


@bpy.app.handlers.persistent
def _undone(*_: Any) -> None:
    queue.edits += 1
    for scene in bpy.data.scenes:
        lists.undone(scene.fieldwork)
        region.undone(scene)


@bpy.app.handlers.persistent
def _file_loaded(*_: Any) -> None:
    """Another file: its project may have a job that runs elsewhere."""
    queue.edits += 1
    for scene in bpy.data.scenes:
        if scene.fieldwork.project:
            lists.refresh(scene.fieldwork)
    folder = snapshot.folder_of(bpy.context.scene.fieldwork) if bpy.context.scene else None
    if snapshot.has_project(folder) and not bpy.app.background:
        reattach(queue, folder)


def register() -> None:
    bpy.app.handlers.load_post.append(_file_loaded)
    bpy.app.handlers.undo_post.append(_undone)
    bpy.app.handlers.redo_post.append(_undone)
    if not bpy.app.background:
        bpy.app.timers.register(_tick, first_interval=IDLE_PERIOD, persistent=True)


def unregister() -> None:
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    bpy.app.handlers.load_post.remove(_file_loaded)
    bpy.app.handlers.undo_post.remove(_undone)
    bpy.app.handlers.redo_post.remove(_undone)
    # What the engine has been told before its input ends it does.
    edits.send(queue.ask, at_once=True)
    edits.clear()
    queue.stop_engine(detach=queue.running is not None and machine.preferences().on_close == "continue")
    queue.__init__()
