"""What a worker does with a task: check that it may, run it, answer. Everything it is told and says is JSON text."""

from __future__ import annotations

import importlib
import json
import os
import platform
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .. import __version__
from ..errors import Cancelled, DeniedError, FieldworkError, explained
from ..progress import Reporter
from .storage import work_folder

TELL_EVERY = 1.0  # seconds between two signs of life
HINT_VERSION = "Install the same version of Fieldwork on all machines, or give --wheel."
Tell = Callable[[dict[str, Any]], None]


class Refusal(FieldworkError):
    """This worker is not one for the task; another may be."""

    code = "worker"


class WorkerReporter(Reporter):
    """Tells where the work stands, once a second, also while it is silent."""

    def __init__(self, tell: Tell) -> None:
        super().__init__()
        self._tell, self._state = tell, {"stage": "", "fraction": 0.0, "message": ""}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True)

    def _beat(self) -> None:
        while not self._over.wait(TELL_EVERY):
            self._tell(dict(self._state))

    @contextmanager
    def telling(self) -> Iterator[None]:
        self._thread.start()
        try:
            yield
        finally:
            self._over.set()

    def stage(self, name: str) -> None:
        self.check()
        self._state = {"stage": name, "fraction": 0.0, "message": ""}

    def progress(self, fraction: float, message: str = "") -> None:
        self.check()
        self._state = {**self._state, "fraction": min(max(float(fraction), 0.0), 1.0), "message": message}


def execute(text: str, tell: Tell) -> str:
    """Run one task.

    Args:
        text: JSON: function, values, version of the caller, folder the worker may write in (or storage, whose folder of
            this machine it is), cores, keep_free_gb.
        tell: takes {"stage", "fraction", "message"} about once a second.
    Returns:
        JSON: {"state": "done", "result"}, {"state": "cancelled"} or {"state": "failed" | "refused" | "full", "error":
        {"code", "message", "hint"}}, for want of rights with "denied", each with seconds, warnings, host and free_gb.
    """
    begin, job, report = time.monotonic(), json.loads(text), WorkerReporter(tell)
    before = os.environ.get("FIELDWORK_THREADS")
    os.environ["FIELDWORK_THREADS"] = str(max(1, int(job["cores"])))
    folder = Path(job["folder"])
    try:
        check_version(job["version"])
        if job.get("storage"):
            folder = work_folder(job["storage"])
            folder.mkdir(parents=True, exist_ok=True)
        check_room(folder, job["keep_free_gb"])
        with interruptible(report), report.telling():
            answer: dict[str, Any] = {"state": "done", "result": _function(job["function"])(job["values"], report)}
    except Cancelled:
        answer = {"state": "cancelled"}
    except Exception as error:  # noqa: BLE001 - the boundary of the worker: whatever happened becomes a sentence
        known = explained(error)
        state = known.code if known.code == "full" else "refused" if isinstance(known, Refusal) else "failed"
        answer = {"state": state, "error": {"code": known.code, "message": known.message, "hint": known.hint}}
        if isinstance(known, DeniedError):
            answer["error"]["denied"] = True
    finally:
        os.environ.pop("FIELDWORK_THREADS")
        if before is not None:
            os.environ["FIELDWORK_THREADS"] = before
    answer |= {"seconds": round(time.monotonic() - begin, 3), "warnings": report.warnings, "host": platform.node()}
    answer["free_gb"] = free_gb(folder)
    return json.dumps(answer, ensure_ascii=False, default=str)


def check_version(wanted: str) -> None:
    """Raise Refusal where this worker's Fieldwork is another one than the caller's."""
    if wanted != __version__:
        raise Refusal(
            f"The worker {platform.node()} has Fieldwork {__version__}, this campaign {wanted}.", HINT_VERSION
        )


class Full(FieldworkError):
    """There is too little room on the disk to begin."""

    code = "full"


def check_room(folder: Path, keep_free_gb: float) -> None:
    """Raise Full where the disk of the campaign has less room than shall stay free, Refusal where the folder is missing."""
    if not folder.is_dir():
        raise Refusal(
            f"The worker {platform.node()} does not have the folder {folder}.",
            "Mount it at the same place on all machines, or give --storage.",
        )
    free = free_gb(folder)
    if free < keep_free_gb:
        raise Full(
            f"The worker {platform.node()} has {free:.1f} GB free in {folder}, less than {keep_free_gb:g} GB.",
            "Free some space; the campaign goes on by itself.",
        )


def free_gb(folder: Path) -> float:
    """GB that are free on the disk of a folder; 0 where it is not there."""
    try:
        return round(shutil.disk_usage(folder).free / 1e9, 3)
    except OSError:
        return 0.0


def require_inside(path: Path, folder: Path) -> None:
    """Raise Refusal unless `path`, and all that links in it lead to, lies in `folder`: a worker writes nowhere else."""
    inside = (Path(place) / name for place, folders, files in os.walk(path) for name in (*folders, *files))
    root = os.path.realpath(folder)
    for one in (path, *(found for found in inside if found.is_symlink())):
        if not Path(os.path.realpath(one)).is_relative_to(root):
            raise Refusal(
                f"{one} is outside of the campaign's folder {folder}.",
                "Let all results be written below the list's folder, without links that lead out of it.",
            )


@contextmanager
def interruptible(report: Reporter) -> Iterator[None]:
    """What Ray does to cancel a task, an interrupt of the main thread, asks the work to stop at its next check."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda *_: report.cancel())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _function(name: str) -> Callable[[dict[str, Any], Reporter], dict[str, Any]]:
    module, _, function = name.partition(":")
    return getattr(importlib.import_module(module), function)
