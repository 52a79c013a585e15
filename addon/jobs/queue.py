"""The queue of jobs on Blender's side: one engine, one job at a time.

In a window the timer (timer.py) lets it work; it is persistent, so jobs survive loading another file, undo, and the
operator that started them. Where there are no timers (`blender -b`, the `bpy` module) operators call `Queue.run`
instead, which blocks.

What a job has to do in Blender before it starts and when it has ended (landing.py) waits until the scene may be touched.
It may be a generator: it is then run in slices, between which the window lives.

Imported when the extension is enabled: what is needed only with a job is imported where it is used.
"""

from __future__ import annotations

import importlib
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy

from .. import machine
from ..errors import EngineError
from . import computer, gate, redraw
from .job import Done, Job, Steps
from .landing import SLICE, Landing, failure, scene_error

if TYPE_CHECKING:
    from ..engine.install import Installer
    from ..engine.link import DONE, Link

UNREAD = "The scene cannot be read"
LAST_WORDS = 2.0  # seconds until what a dead engine said last has been read
KEPT = 8  # finished jobs the panel remembers


def open_link(python: Path, log: Path) -> Link:
    """A way to an engine, which starts with the first request."""
    from ..engine.link import Link

    return Link(python, log)


def load_modules() -> None:
    """Import what results and curves need: numpy alone takes longer than the window may be held up."""
    for name in ("pictures.curve", "scene.build", "scene.visibility", "render.result"):
        importlib.import_module(f"..{name}", __package__)


class Queue:
    """All jobs of this Blender."""

    def __init__(self) -> None:
        self.link: Link | None = None
        self.running: Job | None = None
        self.waiting: list[Job] = []
        self.followed: Job | None = None
        self.finished: list[Job] = []
        self.facts: dict[str, Any] = {}  # what the engine last said of itself
        self.doctor: dict[str, Any] = {}  # what the doctor last found
        self.installer: Installer | None = None
        self.landing = Landing(self.brought)
        self.slowest_tick = 0.0  # seconds of the longest time Blender was held up
        self.slowest_step = ""  # what that was
        self.slowest_cpu = 0.0  # the same in seconds of the processor, which other programs do not lengthen
        self._loader: threading.Thread | None = None
        self._number = 0
        self._asked = 0.0
        self.drawn = 0.0  # when the panels were drawn, by the monotonic clock
        self._status_shown = ""  # id of the job that the status bar shows

    # For operators

    @property
    def current(self) -> Job | None:
        """The job the panels show."""
        landing = self.landing.jobs
        candidates = (*landing[:1], self.running, self.followed, *self.waiting)
        return next((job for job in candidates if job is not None), None)

    @property
    def last(self) -> Job | None:
        return self.finished[-1] if self.finished else None

    @property
    def outcome(self) -> Job | None:
        """The newest job whose failure or warnings should be read: not put away, and not made good since."""
        done: set[tuple[str, Path | None]] = set()
        for job in reversed(self.finished):
            key = (job.verb, job.project)
            if not job.dismissed and key not in done and (job.state == "failed" or job.warnings):
                return job
            if job.state == "done":
                done.add(key)
        return None

    def make(self, verb: str, params: dict[str, Any], on_done: Done | None = None, before: Steps | None = None) -> Job:
        self._number += 1
        folder = params.get("project") or (params.get("out") if verb == "reconstruct" else None)
        return Job(
            verb,
            params,
            id=f"{verb.replace(' ', '-')}-{time.strftime('%Y%m%d-%H%M%S')}-{self._number}",
            project=Path(folder) if folder else None,
            on_done=on_done,
            before=before,
        )

    def submit(self, job: Job) -> None:
        """Put a job at the end of the queue; it starts at once when nothing runs."""
        self.waiting.append(job)
        self._start_next()
        if not self._loader:
            self._loader = threading.Thread(target=load_modules, name="fieldwork-modules", daemon=True)
            self._loader.start()
        self.redraw()

    def follow_up(self, job: Job) -> None:
        """Another job from within the end of one: queued in a window, done at once without."""
        if bpy.app.background:
            self.run(job)
        else:
            self.submit(job)

    def run(self, job: Job) -> dict[str, Any]:
        """Run a job and wait for it. Raises EngineError."""
        job.state, job.started = "running", time.monotonic()
        self.running = job
        try:
            for _ in job.before or ():
                pass
            result = self._engine().run_blocking(job.verb, {**job.params, "job": job.id}, job.take)
        except Exception as error:
            told = failure(UNREAD, error)
            self.finish(job, None, told)
            self.landing.settle()
            raise told from error
        self.finish(job, result, None)
        self.landing.settle()
        return result

    def ask(self, method: str, params: dict[str, Any], on_done: DONE | None = None) -> None:
        """A request that the engine answers at once, also while a job runs. Raises EngineError."""
        self._engine().request(method, params, on_done)

    def ask_and_wait(self, method: str, params: dict[str, Any], on_done: DONE) -> None:
        """`ask`, with the answer taken before this returns. Raises EngineError: there is no engine."""
        engine = self._engine()
        try:
            result = engine.run_blocking(method, params)
        except EngineError as error:
            on_done(None, error)
        else:
            on_done(result, None)

    def cancel(self, job: Job | None = None) -> None:
        job = job or self.current
        if job is None:
            return
        if job in self.waiting:
            self.waiting.remove(job)
            self.finish(job, None, EngineError("cancelled", "Cancelled."))
        elif job in self.landing.jobs:
            self.landing.cancel(job)
        elif job.active:
            job.state = "cancelling"
            if job.followed and job.project:
                from ...nerfcore.engine import status

                status.request_cancel(job.project, job.id)
            elif self.link:
                self.link.cancel(job.id)
        self.redraw()

    def stop_engine(self, detach: bool = False, timeout: float | None = None) -> None:
        """End the engine and free its memory. A running job is cancelled, or goes on with `detach`."""
        link, self.link = self.link, None
        self.facts = {}
        if link is None:
            return
        if detach:
            self._hand_over(link)
        link.close(detach, timeout)
        job, self.running = self.running, None
        if job and not detach:
            self.finish(job, None, EngineError("cancelled", "The engine was stopped.", "Run it again to resume."))

    def _hand_over(self, link: Link) -> None:
        """Give an engine that is to go on by itself what waits as well; what has no project cannot be found again."""
        for job in [job for job in self.waiting if job.project is not None]:
            link.request(job.verb, {**job.params, "detach": True, "job": job.id})
            self.waiting.remove(job)

    # Work

    def work(self) -> None:
        """Hear what the engine has to say, and do for a moment what is to be done in Blender."""
        if self.link:
            self.link.pump()
        if self.running:
            self.running.seconds = time.monotonic() - (self.running.started or time.monotonic())
        self._prepare(SLICE)
        self._start_next()
        self._look_after_engine()
        self.landing.land()
        self.landing.bring(SLICE)

    @property
    def busy(self) -> bool:
        """Whether anything goes on that the panels show."""
        return self.current is not None or self.installing or (self.link is not None and self.link.busy)

    @property
    def installing(self) -> bool:
        """Whether an engine is being installed."""
        return self.installer is not None and self.installer.is_alive()

    @property
    def replacing(self) -> bool:
        """Whether the engine that would be started is removed once the one that is being installed runs."""
        python = machine.engine_python() if self.installing else None
        return python is not None and python.is_relative_to(machine.engine_folder())

    @property
    def sliced(self) -> bool:
        """Whether there is work in Blender that is done in slices."""
        return self.landing.current is not None or any(job.before for job in self.waiting)

    @property
    def undrawn(self) -> bool:
        """Whether the status bar shows another job than the one that runs."""
        return self._status_shown != self._current_id()

    def _prepare(self, seconds: float) -> None:
        """Do what a waiting job needs of Blender, for that long: at once, not when its turn comes."""
        job = next((job for job in self.waiting if job.before is not None), None)
        if job is None or job.before is None:
            return
        if reason := gate.closed():
            job.message = reason
            return
        end = time.perf_counter() + seconds
        try:
            while time.perf_counter() < end:
                job.fraction, job.message = next(job.before)
        except StopIteration:
            job.before, job.fraction, job.message = None, None, ""
        except Exception as error:  # noqa: BLE001 - the job and its report tell it
            self.waiting.remove(job)
            self.finish(job, None, failure(UNREAD, error))

    def _start_next(self) -> None:
        if self.running is not None or not self.waiting or self.waiting[0].before is not None:
            return
        job = self.waiting.pop(0)
        self.running = job
        job.state, job.started = "running", time.monotonic()
        detach = {"detach": True} if machine.preferences().on_close == "continue" else {}
        try:
            self._engine().request(
                job.verb,
                {**job.params, **detach, "job": job.id},
                lambda result, error: self.finish(job, result, error),
                job.take,
            )
        except EngineError as error:
            self.finish(job, None, error)

    def _engine(self) -> Link:
        link = self.link
        if link is not None and not link.alive:
            # It may have died this moment: whoever waits for it is told before another one takes its place.
            while link.process is not None and link.pump(LAST_WORDS):
                continue
            if self.link is link and not link.alive:
                self.link = None
        if self.link is None:
            self.link = open_link(self.engine_python(), machine.engine_log())
        return self.link

    def engine_python(self) -> Path:
        """The Python that runs the engine. Raises EngineError: there is none, or it is about to be removed."""
        python = machine.engine_python()
        if python is None:
            raise EngineError("missing", "The engine is not installed.", "Install it in the preferences of Fieldwork.")
        if self.replacing:
            raise EngineError("missing", "The engine is being installed.", "Wait until that is done.")
        return python

    def finish(self, job: Job, result: dict[str, Any] | None, error: EngineError | None) -> None:
        """A job has ended in the engine: do what it has to do in Blender."""
        if self.running is job:
            self.running = None
        job.result, job.error, job.eta = result, error, None
        if job.started:
            job.seconds = time.monotonic() - job.started
        if job.verb == "doctor" and result:
            self.doctor = result
            if not bpy.app.background:
                computer.remember(result)
        self.landing.add(job)
        self.redraw()

    def brought(self, job: Job) -> None:
        """What a job had to do in Blender is done."""
        self.remember(job)
        self.redraw()

    def tell(self, error: Exception) -> None:
        """Let the panel show what went wrong in Blender itself, once."""
        shown = scene_error("Something went wrong in Fieldwork", error)
        if not any(job.verb == "timer" and job.error.message == shown.message for job in self.finished):
            self.remember(Job("timer", {}, f"timer-{time.strftime('%Y%m%d-%H%M%S')}", state="failed", error=shown))
            self.redraw()

    def remember(self, job: Job) -> None:
        """Keep what became of a job for the panels."""
        self.finished = [*self.finished, job][-KEPT:]

    def _look_after_engine(self) -> None:
        """Ask a living engine for its memory now and then; end one that was idle for long."""
        link = self.link
        if link is None or not link.alive:
            return
        minutes = machine.preferences().idle_minutes
        if minutes and not link.busy and time.monotonic() - link.last_used > 60 * minutes:
            self.stop_engine()
            self.redraw()
        elif self.running and time.monotonic() - self._asked > 2.0:
            self._asked = time.monotonic()
            link.request("status", on_done=self._take_facts)

    def _take_facts(self, result: dict[str, Any] | None, error: EngineError | None) -> None:
        self.facts = result or self.facts

    # Drawing

    def _current_id(self) -> str:
        return self.current.id if self.current else ""

    def redraw(self) -> None:
        """Redraw what shows jobs: sidebars, preferences, the status bar."""
        if bpy.app.background:
            return
        self.drawn = time.monotonic()
        if redraw.panels():
            self._status_shown = self._current_id()


queue = Queue()
