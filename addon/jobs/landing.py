"""Results on their way into the scene: one after the other, when the scene may be touched (gate.py), in slices between
which the window lives.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from ..errors import EngineError, SceneChanged, SceneError
from ..scene.slices import new_slice
from ..text import t
from . import gate
from .job import Job, Steps

SLICE = 0.02  # seconds of bringing a result into the scene at a time
RESTARTS = 5  # of bringing a result into a scene that changes meanwhile
FAILED = "The result could not be brought into the scene"


def outcome(error: EngineError | None) -> str:
    """The state of a job that has ended."""
    return "done" if error is None else "cancelled" if error.kind == "cancelled" else "failed"


def scene_error(what: str, error: Exception) -> EngineError:
    """An error that nobody foresaw, for the panel, with the place where it happened in the report; it is logged too."""
    import logging  # not at the top: enabling the extension must be quick
    import traceback

    logging.getLogger("fieldwork.addon").error("%s", what, exc_info=error)
    return EngineError(
        "scene",
        f"{what}: {type(error).__name__}: {error}.",
        t("Try it again; if it stays, send the report."),
        "".join(traceback.format_exception(error)),
    )


def failure(what: str, error: Exception) -> EngineError:
    """What a job failed of in Blender, for the panel: errors that are written for the user as they are, others after `what`."""
    from ...nerfcore.errors import FieldworkError  # not at the top: enabling the extension must be quick

    if isinstance(error, EngineError):
        return error
    if isinstance(error, FieldworkError):
        return EngineError(error.code, error.message, error.hint)
    return EngineError("scene", str(error)) if isinstance(error, SceneError) else scene_error(what, error)


class Landing:
    """What jobs that have ended have to do in the scene."""

    def __init__(self, remember: Callable[[Job], None]) -> None:
        """`remember`: is called with each job whose result is there, or could not be brought."""
        self.remember = remember
        self.ended: list[Job] = []  # jobs whose result waits for its turn
        self.current: tuple[Job, Steps] | None = None  # the job whose result comes, and the steps that are left
        self.edits = 0  # files loaded, undone and redone steps: what is known of the scene may be wrong
        self._edits_seen = 0
        self._restarts = 0

    @property
    def jobs(self) -> list[Job]:
        return [*([self.current[0]] if self.current else []), *self.ended]

    def add(self, job: Job) -> None:
        """A job has ended: its `error` says how."""
        job.state = outcome(job.error)
        if job.on_done is None:
            self.remember(job)
        else:
            self.ended.append(job)
            self.land()

    def cancel(self, job: Job) -> None:
        """Leave the scene as it is now."""
        if job in self.ended:
            self.ended.remove(job)
        if self.current and self.current[0] is job:
            self.current = None
        self._brought(job, EngineError("cancelled", "Cancelled."))

    def settle(self) -> None:
        """Bring everything now, whatever goes on in the scene: where no timer will."""
        while self.jobs:
            self.land(at_once=True)
            self.bring(SLICE, at_once=True)

    def land(self, at_once: bool = False) -> None:
        """Begin to bring the next result into the scene; `at_once`: even where the scene should be left alone."""
        while self.ended and self.current is None:
            job = self.ended[0]
            if reason := None if at_once else gate.closed():
                job.stage, job.fraction, job.message = t("Updating the Scene"), None, reason
                return
            self.ended.remove(job)
            self._restarts = 0
            self._begin(job)

    def _begin(self, job: Job) -> None:
        """Ask a job what it has to do in the scene, and do that, or keep its steps for `bring`."""
        self.current, self._edits_seen = None, self.edits
        job.state = outcome(job.error)
        try:
            steps = job.on_done(job) if job.on_done else None
        except Exception as error:  # noqa: BLE001 - the job and its report tell it
            self._brought(job, scene_error(FAILED, error))
            return
        if steps is None:
            self._brought(job, job.error)
        else:
            job.state, job.stage, job.fraction, job.message = "running", t("Updating the Scene"), None, ""
            self.current = (job, steps)

    def bring(self, seconds: float, at_once: bool = False) -> None:
        """Bring a result into the scene for that long."""
        if self.current is None:
            return
        job, steps = self.current
        if reason := None if at_once else gate.closed():
            job.message = reason
            return
        if self._edits_seen != self.edits:
            # What the steps know of the scene may be wrong. Made again, they go on with what is there.
            self._begin(job)
            return
        new_slice()
        end = time.perf_counter() + seconds
        try:
            # A step at least, however short the time: else a slow machine gets nowhere.
            job.fraction, job.message = next(steps)
            while time.perf_counter() < end:
                job.fraction, job.message = next(steps)
        except StopIteration:
            self._brought(job, None)
        except (ReferenceError, SceneChanged) as error:
            self._restarts += 1
            if self._restarts <= RESTARTS:
                self._begin(job)
            else:
                self._brought(job, scene_error(FAILED, error))
        except Exception as error:  # noqa: BLE001 - the job and its report tell it
            self._brought(job, failure(FAILED, error))

    def _brought(self, job: Job, error: EngineError | None) -> None:
        if self.current and self.current[0] is job:
            self.current = None
        job.error, job.fraction, job.message = error, None, ""
        job.state = outcome(error)
        self.remember(job)
