"""The state of a job on disk, so that any process can see how it stands.

    PROJECT/jobs/<id>.json    state of one job (`JobStatus`); the newest job of each verb is kept
    PROJECT/jobs/<id>.jsonl   its events (training curve, previews), one JSON object a line
    PROJECT/jobs/<id>.cancel  put there by anybody who wants the job to stop
    PROJECT/jobs/<verb>.log   what the engine logged while it ran

Standard library only: Blender's side imports this module too.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from ..files import json_lines, write_text

FOLDER = "jobs"
FINISHED = ("done", "failed", "cancelled")
HEARTBEAT = 5.0  # seconds between writes of a running job that has nothing new to say
STALE = 30.0  # a job not written for so long is dead where its process, or when that started, cannot be seen


@dataclass
class JobStatus:
    """`state`: queued, running, done, failed, cancelled; `read_job` adds died. Times are seconds since the epoch, but for
    `pid_started`: see `process_start`. `host`: the computer that runs it."""

    id: str
    verb: str
    params: dict[str, Any]
    state: str = "queued"
    pid: int = 0
    pid_started: float = 0.0
    host: str = field(default_factory=socket.gethostname)
    stage: str = ""
    fraction: float | None = None
    message: str = ""
    eta_s: float | None = None
    created: float = field(default_factory=time.time)
    started: float | None = None
    updated: float = field(default_factory=time.time)
    result: dict[str, Any] | None = None
    error: dict[str, Any] | None = None
    warnings: list[str] = field(default_factory=list)
    log: str = ""

    @property
    def finished(self) -> bool:
        return self.state in (*FINISHED, "died")


def job_path(project: Path, job: str) -> Path:
    return Path(project) / FOLDER / f"{job}.json"


def events_path(project: Path, job: str) -> Path:
    return Path(project) / FOLDER / f"{job}.jsonl"


def cancel_path(project: Path, job: str) -> Path:
    return Path(project) / FOLDER / f"{job}.cancel"


def write_job(project: Path, status: JobStatus) -> None:
    """Atomically write the state. Raises DiskError."""
    status.updated = time.time()
    write_text(job_path(project, status.id), json.dumps(asdict(status), indent=1, ensure_ascii=False) + "\n")


def read_job(path: Path) -> JobStatus | None:
    """The job of one file; None when the file is gone or is not a job.

    A job that says it is queued or running while its process is gone has state "died" and an error that says so.
    """
    status = _stored_job(path)
    if status is not None and not status.finished and not engine_alive(status):
        status = _stored_job(path)  # its last words may have been written since
        if status is None or status.finished:
            return status
        doing = status.stage or status.verb
        status.state = "died"
        status.error = {
            "code": "died",
            "message": f"The engine stopped unexpectedly while at “{doing}”.",
            "hint": f"Run {status.verb} again; it goes on from what is on disk.",
            "log": status.log,
        }
    return status


def _stored_job(path: Path) -> JobStatus | None:
    """What is written in the file of a job; None when it is gone or is not a job."""
    try:
        value = json.loads(Path(path).read_text(encoding="utf-8"))
        return JobStatus(**{f.name: value[f.name] for f in fields(JobStatus) if f.name in value})
    except (OSError, ValueError, TypeError, AttributeError):
        return None


def list_jobs(project: Path) -> list[JobStatus]:
    """All jobs of a project, oldest first."""
    jobs = [read_job(path) for path in (Path(project) / FOLDER).glob("*.json")]
    return sorted((job for job in jobs if job is not None), key=lambda job: job.created)


def read_events(project: Path, job: str, offset: int = 0) -> tuple[list[dict[str, Any]], int]:
    """Events of a job from byte `offset` on, and the offset for the next call."""
    try:
        with open(events_path(project, job), "rb") as file:
            file.seek(offset)
            block = file.read()
    except FileNotFoundError:
        return [], offset
    whole = block[: block.rfind(b"\n") + 1]
    return json_lines(whole), offset + len(whole)


def request_cancel(project: Path, job: str) -> None:
    """Ask whatever engine runs the job to stop; it looks twice a second."""
    write_text(cancel_path(project, job), "")


def prune_jobs(project: Path, keep: JobStatus) -> None:
    """Remove older finished jobs of the same verb; what another program reads (Windows) is removed with the next job."""
    for job in list_jobs(project):
        if job.verb == keep.verb and job.id != keep.id and job.finished:
            for path in (job_path(project, job.id), events_path(project, job.id), cancel_path(project, job.id)):
                with suppress(OSError):
                    path.unlink(missing_ok=True)


def engine_alive(status: JobStatus) -> bool:
    """Whether the process that runs the job still lives (and its number was not given to another); of another computer, which
    shares the folder, whether it has given a sign of life."""
    if status.host != socket.gethostname():
        return abs(time.time() - status.updated) < STALE
    if status.pid <= 0 or not process_exists(status.pid):
        return False
    started = process_start(status.pid)
    if started is not None and status.pid_started:
        return abs(started - status.pid_started) < 2.0
    return time.time() - status.updated < STALE


def process_start(pid: int) -> float | None:
    """When a process started, in seconds since the system did, which no clock that is set changes; None where that cannot be
    read."""
    if sys.platform != "linux":
        return None
    try:
        # The name of the program stands in parentheses and may hold blanks.
        after_name = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2]
    except OSError:
        return None
    return int(after_name.split()[19]) / os.sysconf("SC_CLK_TCK")


def process_exists(pid: int) -> bool:
    """Whether there is a process with this number; a zombie does not count."""
    if sys.platform == "win32":
        import ctypes

        kernel = ctypes.windll.kernel32
        handle = kernel.OpenProcess(0x1000, False, pid)  # PROCESS_QUERY_LIMITED_INFORMATION
        if not handle:
            return False
        code = ctypes.c_ulong()
        kernel.GetExitCodeProcess(handle, ctypes.byref(code))
        kernel.CloseHandle(handle)
        return code.value == 259  # STILL_ACTIVE
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    if sys.platform.startswith("linux"):
        try:
            stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
        except OSError:
            return False
        return stat.rpartition(")")[2].split()[0] != "Z"
    return True
