"""What drives the queue of jobs, and takes edits of the project to the engine: one persistent timer, and handlers for
other files, undo and redo."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import bpy

from .. import machine
from ..project import campaign, edits, lists, region, snapshot
from . import gate
from .follow import follow, reattach
from .queue import Queue, queue

BUSY_PERIOD = 0.1  # seconds between two looks at the engine while something goes on
IDLE_PERIOD = 0.5
SLICE_PERIOD = 0.01  # seconds between two slices of work in Blender
DRAW_PERIOD = 0.4  # seconds between two drawings of the panels and the status bar while a job runs


def tick(queue: Queue) -> float:
    """One look at the engine, and at what the scene says of its project. Returns the seconds until the next."""
    begin, busy_since = time.perf_counter(), time.thread_time()
    job = queue.current
    doing = f"{job.verb}: {job.stage} {job.message}" if job else ""
    # Edits before jobs: a training that starts now is to know of them.
    for part in (_follow_region, lambda: edits.send(queue.ask), lambda: follow(queue), queue.work, _follow_campaign):
        try:
            part()
        except Exception as error:  # noqa: BLE001 - a timer that raises is dropped by Blender, and all jobs with it
            queue.tell(error)
    due = queue.busy and time.monotonic() - queue.drawn > DRAW_PERIOD
    if due or queue.undrawn:
        queue.redraw()
    if job:
        doing += f" to {job.message}"
    seconds = time.perf_counter() - begin
    queue.slowest_cpu = max(queue.slowest_cpu, time.thread_time() - busy_since)
    if seconds > queue.slowest_tick:
        queue.slowest_tick, queue.slowest_step = seconds, doing
    return SLICE_PERIOD if queue.sliced else BUSY_PERIOD if queue.busy else IDLE_PERIOD


def _follow_region() -> None:
    if not bpy.app.background and gate.closed() is None:
        region.follow(bpy.context.scene)


def _follow_campaign() -> None:
    if not bpy.app.background and campaign.changed(bpy.context.scene.fieldwork):
        queue.redraw()


def _tick() -> float:
    return tick(queue)


@bpy.app.handlers.persistent
def _undone(*_: Any) -> None:
    queue.landing.edits += 1
    with _told():
        for scene in bpy.data.scenes:
            lists.undone(scene.fieldwork)
            region.undone(scene)


@bpy.app.handlers.persistent
def _file_loading(*_: Any) -> None:
    gate.set_loading(True)


@bpy.app.handlers.persistent
def _file_not_loaded(*_: Any) -> None:
    gate.set_loading(False)


@bpy.app.handlers.persistent
def _file_loaded(*_: Any) -> None:
    """Another file: its project may have a job that runs elsewhere."""
    gate.set_loading(False)
    queue.landing.edits += 1
    with _told():
        region.forget()
        for scene in bpy.data.scenes:
            lists.adopt(scene)
            if scene.fieldwork.project:
                lists.refresh(scene.fieldwork)
        folder = snapshot.folder_of(bpy.context.scene.fieldwork) if bpy.context.scene else None
        if snapshot.has_project(folder) and not bpy.app.background:
            reattach(queue, folder)


@contextmanager
def _told() -> Iterator[None]:
    """What goes wrong inside is shown in the panel: of errors in handlers only a terminal would hear."""
    try:
        yield
    except Exception as error:  # noqa: BLE001 - see above
        queue.tell(error)


HANDLERS = (
    ("load_pre", _file_loading),
    ("load_post", _file_loaded),
    ("load_post_fail", _file_not_loaded),
    ("undo_post", _undone),
    ("redo_post", _undone),
)


def register() -> None:
    for name, handler in HANDLERS:
        getattr(bpy.app.handlers, name).append(handler)
    if not bpy.app.background:
        bpy.app.timers.register(_tick, first_interval=IDLE_PERIOD, persistent=True)


def unregister() -> None:
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    for name, handler in HANDLERS:
        getattr(bpy.app.handlers, name).remove(handler)
    gate.set_loading(False)
    # What the engine has been told before its input ends it does.
    edits.send(queue.ask, at_once=True)
    edits.clear()
    queue.stop_engine(detach=queue.running is not None and machine.preferences().on_close == "continue")
    queue.__init__()
