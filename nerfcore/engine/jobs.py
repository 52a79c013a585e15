"""One verb at work: its reporter and its state on disk."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

from ..errors import DiskError
from ..params import Params
from ..progress import Estimate, Reporter
from ..project.lock import lockable, project_of
from . import status as st
from .protocol import encode, notification, plain

log = logging.getLogger("fieldwork.engine")

Send = Callable[[dict[str, Any]], None]
PROGRESS_PERIOD = 0.1  # seconds between two progress notifications


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
            pid_started=st.process_start(os.getpid()) or 0.0,
            log=str(self.log_path) if self.project else "",
        )
        self.answered = False
        self.cancelled_at: float | None = None  # monotonic time
        self._send, self._estimate = send, Estimate()
        self._lock = threading.RLock()
        self._told: set[str] = set()
        self._changed, self._sent, self._written = True, 0.0, 0.0

    @property
    def log_path(self) -> Path | None:
        return self.project / st.FOLDER / f"{self.verb}.log" if self.project else None

    @property
    def lockable(self) -> Path | None:
        """The folder to lock; asked when the job begins, because a job before it may have made the project."""
        return lockable(self.params)

    # What the verb calls.

    def stage(self, name: str) -> None:
        self.check()
        with self._lock:
            self._estimate = Estimate()
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
        if self.project and os.path.isdir(self.project):
            line = encode({"kind": kind, "time": time.time(), **data})
            path = st.events_path(self.project, self.status.id)
            try:
                path.parent.mkdir(exist_ok=True)
                with open(path, "ab") as file:
                    file.write(line)
            except OSError as error:
                self._tell_once("The events of the job cannot be written to %s: %s", path, error)

    def watching(self, training: Any) -> AbstractContextManager[Callable[[], None]]:
        from ..film.training_view import watched  # loads torch, as the training has done

        return watched(training, self.check)

    def warn(self, message: str) -> None:
        super().warn(message)
        with self._lock:
            self._set(warnings=[*self.warnings])

    # What the server calls.

    def cancel(self) -> None:
        if self.cancelled_at is None:
            self.cancelled_at = time.monotonic()
        super().cancel()

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
        if self.project and os.path.exists(st.cancel_path(self.project, self.status.id)):
            self.cancel()
        if self._changed or time.monotonic() - self._written > st.HEARTBEAT:
            self.write()

    def write(self) -> None:
        """Write the job file. The job goes on when that fails: its own writes will tell of a full disk."""
        # The folder is there from the time the project is locked, and goes when nothing came of a new project. Of a path that
        # the system refuses, os.path says that nothing is there; pathlib raises.
        if self.project is None or not os.path.isdir(self.project / st.FOLDER):
            return
        with self._lock:
            self._changed, self._written = False, time.monotonic()
            try:
                st.write_job(self.project, self.status)
            except (DiskError, OSError) as error:
                self._tell_once("The state of the job cannot be written: %s", error)

    def _tell_once(self, text: str, *values: Any) -> None:
        """Warn of what happens again several times a second as long as a disk is full."""
        log.log(logging.DEBUG if text in self._told else logging.WARNING, text, *values)
        self._told.add(text)

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
