"""Jobs of a project that run in an engine of another process: known by their files."""

from __future__ import annotations

import time
from pathlib import Path

from ..errors import EngineError
from . import refresh
from .job import Job
from .queue import Queue

PERIOD = 0.5  # seconds between two looks at the files


def reattach(queue: Queue, project: Path) -> None:
    """Follow the job that another process runs on the project, or is about to; else tell of one that died."""
    if queue.running and queue.running.project == project:
        return
    from ...nerfcore.engine.status import list_jobs  # not at the top: enabling the extension must be quick

    queue.followed = None
    jobs = list_jobs(project)
    status = next((job for state in ("running", "queued") for job in jobs if job.state == state), None)
    died = [job for job in jobs if job.state == "died" and all(told.id != job.id for told in queue.finished)]
    if status is not None:
        queue.followed = Job(
            status.verb, status.params, status.id, project, state=status.state, followed=True,
            started=time.monotonic() - max(0.0, time.time() - (status.started or time.time())),
            on_done=refresh.refresh_scenes,
        )  # fmt: skip
        follow(queue)
    elif died:
        status = died[-1]
        job = Job(status.verb, status.params, status.id, project, state="failed", stage=status.stage)
        error = status.error or {}
        job.error = EngineError("died", error.get("message", ""), error.get("hint", ""))
        queue.remember(job)
    queue.redraw()


def follow(queue: Queue) -> None:
    """Bring the job of another process up to date from its files."""
    job = queue.followed
    if job is None or job.project is None or time.monotonic() - job.looked < PERIOD:
        return
    job.looked = time.monotonic()
    from ...nerfcore.engine.status import job_path, read_events, read_job

    status = read_job(job_path(job.project, job.id))
    events, job.events_read = read_events(job.project, job.id, job.events_read)
    for event in events:
        job.take_event(event)
    job.seconds = time.monotonic() - (job.started or time.monotonic())
    if status is not None and not status.finished:
        if (job.state, status.state) == ("queued", "running"):
            job.state, job.started = "running", time.monotonic()
        job.stage, job.fraction = status.stage, status.fraction
        job.message, job.eta = status.message, status.eta_s
        return
    queue.followed = None
    if status is None:
        # The next job of its kind takes the place of one that has ended.
        reattach(queue, job.project)
        if queue.followed is not None:
            refresh.refresh_scenes(job)
            return
    if status is not None and status.state == "done":
        queue.finish(job, status.result, None)
    else:
        error = (status.error if status else None) or {"code": "died", "message": "The job is gone."}
        kind = "cancelled" if status and status.state == "cancelled" else error.get("code", "died")
        queue.finish(job, None, EngineError(kind, error.get("message", ""), error.get("hint", "")))
    if status is not None and status.state != "died":
        reattach(queue, job.project)  # the next one of those that were left to the engine
