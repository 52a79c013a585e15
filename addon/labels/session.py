"""Labelling in the open Blender: marks go to the engine, which propagates them; undo and redo show other revisions.

One persistent timer, and handlers for undo, redo and other files.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ..jobs import gate, redraw
from ..jobs.job import Job
from ..jobs.queue import queue
from ..project import snapshot
from ..undo import undo_step
from . import ahead, journal, pending

BUSY_PERIOD = 0.05  # seconds between two looks while the engine has something of ours
IDLE_PERIOD = 0.5
VERBS = ("label prepare", "label propagate")

_live: set[Path] = set()  # projects that are being labelled in this Blender
# The revision, and the ids of the classes, for which the last propagation of a run was asked.
_tried: dict[tuple[Path, str], tuple[int, set[int]]] = {}
_undo: dict[Path, int] = {}  # how many steps to undo once all marks are steps
_before: dict[str, int] = {}  # the revision that each scene had before the undo or redo under way


def begin(settings: Any) -> None:
    """The scene's project is labelled from now on: undo comes back to the revision that is shown now."""
    folder = snapshot.folder_of(settings)
    if folder is not None and snapshot.has_project(folder):
        _live.add(folder)
        settings.label_revision = pending.shown(folder)


def mark(folder: Path, params: dict[str, Any], more: bool = False) -> None:
    """Take a mark (parameters of `label stroke`) to the engine; without a window, wait until it is on disk. `more`: the next
    one belongs to the same step of undo.

    Raises:
        EngineError: without a window, the engine did not take it.
    """
    _live.add(folder)
    pending.mark(folder, params, more)
    if bpy.app.background:
        pending.send_all(folder, queue.ask_and_wait)
    hurry()
    wrong = pending.error(folder)
    if bpy.app.background and wrong is not None:
        raise wrong


def undo_later(folder: Path) -> None:
    """Undo a step as soon as the marks on their way are steps themselves: Blender would undo the one before them."""
    _undo[folder] = _undo.get(folder, 0) + 1


def taken(folder: Path, revision: int) -> None:
    """A mark that the engine made by itself is in the journal."""
    _live.add(folder)
    pending.fulfilled(folder, revision)
    hurry()


def job_of(folder: Path | None) -> Job | None:
    """The job that prepares or propagates for a project, if any."""
    jobs = (*queue.landing.jobs, queue.running, queue.followed, *queue.waiting)
    return next((job for job in jobs if job and job.verb in VERBS and job.project == folder), None)


def work() -> None:
    """Hear and tell the engine what there is of marks, and let it propagate what is shown."""
    pending.send(queue.ask_and_wait if bpy.app.background else queue.ask)
    if queue.link is not None:
        queue.link.pump()
    _land()
    if not bpy.app.background:
        _propagate(bpy.context.scene)
        ahead.encode(bpy.context.scene)


def retry() -> None:
    """Send at once what the engine did not take, and propagate again what failed."""
    _tried.clear()
    pending.send(queue.ask_and_wait if bpy.app.background else queue.ask, at_once=True)


def _land() -> None:
    """What the engine has taken becomes a step of undo, when the scene may be touched."""
    if not bpy.app.background and gate.closed() is not None:
        return
    for taken in pending.take():
        if taken.verb == "label stroke":
            for scene in bpy.data.scenes:
                if snapshot.folder_of(scene.fieldwork) == taken.folder:
                    scene.fieldwork.label_revision = taken.revision
            if not taken.more:
                undo_step("Label")
        if not bpy.app.background:
            redraw.panels()
    for folder in [folder for folder in _undo if not pending.unfinished(folder)]:
        steps = _undo.pop(folder)
        if pending.error(folder) is None:  # else the last mark is none
            _undo_steps(steps)


def _undo_steps(count: int) -> None:
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):  # a timer has none
        for _ in range(count):
            if bpy.ops.ed.undo.poll():
                bpy.ops.ed.undo()


def _propagate(scene: bpy.types.Scene) -> None:
    folder, run = snapshot.folder_of(scene.fieldwork), scene.fieldwork.run
    if folder not in _live or pending.waiting(folder) or job_of(folder) is not None:
        return
    from . import results  # not at the top: it needs numpy, and enabling the extension must be quick

    revision = journal.shown(folder)
    wanted = revision, results.class_ids(folder)
    if revision == 0 or _tried.get((folder, run)) == wanted or results.is_current(folder, run, revision):
        return
    _tried[folder, run] = wanted
    queue.submit(queue.make("label propagate", {"project": str(folder), "run": run, "revision": revision}))


def hurry() -> None:
    """Do not wait for the timer's next turn."""
    work()
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
        bpy.app.timers.register(_tick, first_interval=BUSY_PERIOD, persistent=True)


def _tick() -> float:
    try:
        work()
    except Exception as error:  # noqa: BLE001 - a timer that raises is dropped by Blender
        queue.tell(error)
    return BUSY_PERIOD if pending.waiting() or (queue.link is not None and queue.link.busy) else IDLE_PERIOD


@bpy.app.handlers.persistent
def _undoing(*_: Any) -> None:
    _before.update({scene.name: scene.fieldwork.label_revision for scene in bpy.data.scenes})


@bpy.app.handlers.persistent
def _undone(*_: Any) -> None:
    """After an undo or redo of a mark the project shows the revision that the scene had then. That of anything else hides no
    mark that was made elsewhere meanwhile."""
    try:
        for scene in bpy.data.scenes:
            folder, revision = snapshot.folder_of(scene.fieldwork), scene.fieldwork.label_revision
            moved = revision >= 0 and revision != _before.get(scene.name)
            if folder in _live and moved and revision != pending.shown(folder):
                pending.check_out(folder, revision)
        hurry()
    except Exception as error:  # noqa: BLE001 - of errors in handlers only a terminal would hear
        queue.tell(error)


@bpy.app.handlers.persistent
def _file_loaded(*_: Any) -> None:
    """Another file: its project says which revision is shown, and undo begins there."""
    for scene in bpy.data.scenes:
        if scene.fieldwork.label_revision >= 0:
            begin(scene.fieldwork)


HANDLERS = (
    ("undo_pre", _undoing),
    ("redo_pre", _undoing),
    ("undo_post", _undone),
    ("redo_post", _undone),
    ("load_post", _file_loaded),
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
    # What the engine has been told before its input ends it does.
    pending.send_rest(queue.ask)
    pending.clear()
    ahead.clear()
    _live.clear()
    _tried.clear()
    _undo.clear()
    _before.clear()
