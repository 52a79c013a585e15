"""One verb at work: its reporter, its state on disk, its lock on the project."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from ..errors import DiskError, ProjectError
from ..files import disk_errors
from ..params import Params
from ..progress import Reporter
from . import status as st
from .protocol import encode, notification, plain

log = logging.getLogger("fieldwork.engine")

Send = Callable[[dict[str, Any]], None]
PROGRESS_PERIOD = 0.1  # seconds between two progress notifications
LOCK_FILE = "engine.lock"


def project_of(params: Params) -> Path | None:
    """The project folder a verb writes to, None for a verb without one."""
    folder = getattr(params, "project", None)
    if folder is None and "photos" in type(params).model_fields:
        folder = getattr(params, "out", None)
    return Path(folder).absolute() if folder is not None else None


@contextmanager
def project_lock(project: Path | None, owner: str) -> Iterator[None]:
    """Hold the project for writing. The operating system lets go of it when the process dies.

    Raises:
        ProjectError: another process holds it; the message says which.
        DiskError: the folder is not writable.
    """
    if project is None:
        yield
        return
    folder = project / st.FOLDER
    try:
        with disk_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise ProjectError(f"{folder} cannot be a folder: a file is in its way.", "Choose another folder.") from error
    note = folder / (LOCK_FILE + ".owner")
    lock = FileLock(folder / LOCK_FILE, thread_local=False)
    try:
        with disk_errors(folder / LOCK_FILE):
            lock.acquire(timeout=0)
    except Timeout as error:
        holder = note.read_text(encoding="utf-8") if note.is_file() else "another process"
        raise ProjectError(
            f"{project} is being worked on by {holder}.", "Wait until it is done, or cancel it there."
        ) from error
    try:
        with disk_errors(note):
            note.write_text(f"{owner} (process {os.getpid()})", encoding="utf-8")
        yield
    finally:
        note.unlink(missing_ok=True)
        lock.release()


class Estimate:
    """Remaining seconds of a stage from its recent speed."""

    WINDOW = 30.0  # seconds of history: long enough to be calm, short enough to follow a change of speed

    def __init__(self) -> None:
        self.points: deque[tuple[float, float]] = deque()

    def reset(self, now: float) -> None:
        self.points.clear()
        self.points.append((now, 0.0))

    def update(self, now: float, fraction: float) -> float | None:
        """Seconds left at `fraction` of the stage, None while nothing can be said."""
        if self.points and fraction < self.points[-1][1]:
            self.points.clear()
        self.points.append((now, fraction))
        while len(self.points) > 2 and now - self.points[0][0] > self.WINDOW:
            self.points.popleft()
        f0, seconds = self.points[0][1], now - self.points[0][0]
        if fraction <= f0 or seconds < 0.5:
            return None
        return (1.0 - fraction) * seconds / (fraction - f0)


class Job(Reporter):
    """A queued or running verb. It is its own reporter: progress goes to the caller and to the job file."""

    def __init__(self, job: str, verb: str, params: Params, request: Any, send: Send, detached: bool) -> None:
        super().__init__()
        self.verb, self.params, self.request, self.detached = verb, params, request, detached
        self.project = project_of(params)
        self.status = st.JobStatus(
            id=job,
            verb=verb,
            params=params.model_dump(mode="json"),
            pid=os.getpid(),
            pid_started=st.process_start(os.getpid()) or time.time(),
            log=str(self.log_path) if self.project else "",
        )
        self.answered = False
        self._send, self._estimate = send, Estimate()
        self._lock = threading.RLock()
        self._changed, self._sent, self._written = True, 0.0, 0.0

    @property
    def log_path(self) -> Path | None:
        return self.project / st.FOLDER / f"{self.verb}.log" if self.project else None

    @property
    def lockable(self) -> Path | None:
        """The project folder, None when it is not there and the verb would not make it: that is the verb's to tell."""
        makes_it = {"photos", "dataset"} & type(self.params).model_fields.keys()
        return self.project if self.project and (makes_it or self.project.is_dir()) else None

    # What the verb calls.

    def stage(self, name: str) -> None:
        self.check()
        with self._lock:
            self._estimate.reset(time.monotonic())
            self._set(stage=name, fraction=0.0, message="", eta_s=None)
        self._notify(force=True)

    def progress(self, fraction: float, message: str = "") -> None:
        self.check()
        fraction = min(max(float(fraction), 0.0), 1.0)
        with self._lock:
            eta = self._estimate.update(time.monotonic(), fraction)
            self._set(fraction=fraction, message=message, eta_s=None if eta is None else round(eta, 1))
        self._notify(force=fraction >= 1.0)

    def event(self, kind: str, **data: Any) -> None:
        self._send(notification("event", job=self.status.id, kind=kind, **data))
        if self.project and self.project.is_dir():
            line = encode({"kind": kind, "time": time.time(), **data})
            path = st.events_path(self.project, self.status.id)
            try:
                path.parent.mkdir(exist_ok=True)
                with open(path, "ab") as file:
                    file.write(line)
            except OSError as error:
                log.warning("The events of the job cannot be written to %s: %s", path, error)

    def warn(self, message: str) -> None:
        super().warn(message)
        with self._lock:
            self._set(warnings=[*self.warnings])

    # What the server calls.

    def begin(self) -> None:
        with self._lock:
            self._set(state="running", started=time.time())
        self.write()
        if self.project:
            st.prune_jobs(self.project, self.status)
        self._notify(force=True)

    def end(self, state: str, result: dict[str, Any] | None = None, error: dict[str, Any] | None = None) -> None:
        with self._lock:
            done = {"fraction": 1.0} if state == "done" else {}
            self._set(state=state, result=plain(result), error=plain(error), eta_s=None, **done)
        self.write()
        if self.project:
            with suppress(OSError):  # a folder that cannot be written has no cancel file to remove
                st.cancel_path(self.project, self.status.id).unlink(missing_ok=True)

    def heartbeat(self) -> None:
        """Called twice a second from the server's clock: write what changed, look for a cancel file."""
        if self.project and st.cancel_path(self.project, self.status.id).exists():
            self.cancel()
        if self._changed or time.monotonic() - self._written > st.HEARTBEAT:
            self.write()

    def write(self) -> None:
        """Write the job file. The job goes on when that fails: its own writes will tell of a full disk."""
        # A verb that makes its project decides itself whether the folder may be made.
        if self.project is None or not self.project.is_dir():
            return
        with self._lock:
            self._changed, self._written = False, time.monotonic()
            try:
                st.write_job(self.project, self.status)
            except (DiskError, OSError) as error:
                log.warning("The state of the job cannot be written: %s", error)

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            setattr(self.status, name, value)
        self._changed = True

    def _notify(self, force: bool = False) -> None:
        now = time.monotonic()
        if not force and now - self._sent < PROGRESS_PERIOD:
            return
        self._sent = now
        s = self.status
        self._send(
            notification("progress", job=s.id, stage=s.stage, fraction=s.fraction, message=s.message, eta_s=s.eta_s)
        )
