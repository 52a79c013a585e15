"""One writer at a time: the lock on a capture project, taken by the engine and the command line alike."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from ..errors import ProjectError
from ..files import disk_errors
from ..params import Params
from .store import is_project

FOLDER = "jobs"
LOCK_FILE = "engine.lock"
OWNER_FILE = "engine.lock.owner"
HOLDERS_TAKE = 90.0  # seconds: a worker of a cluster whose head is gone may hold the project until it notices


def project_of(params: Params) -> Path | None:
    """The project folder a verb writes to, None for a verb without one."""
    folder = getattr(params, "project", None)
    if folder is None and "photos" in type(params).model_fields:
        folder = getattr(params, "out", None)
    return Path(folder).absolute() if folder is not None else None


def lockable(params: Params) -> Path | None:
    """The project folder to lock for a verb.

    None when it is no project and the verb would not make it one: that is the verb's to tell, and a folder of
    something else is left as it is. None for a part of a render: it only reads the project, and others render the rest.
    """
    if getattr(params, "frame_range", None) is not None:
        return None
    folder = project_of(params)
    makes_it = {"photos", "dataset"} & type(params).model_fields.keys()
    return folder if folder is not None and (makes_it or is_project(folder)) else None


@contextmanager
def project_lock(project: Path | None, owner: str) -> Iterator[None]:
    """Hold the project for writing. The operating system lets go of it when the process dies.

    A verb that fails before it has written anything of a new project leaves no folder behind.

    Args:
        project: None locks nothing.
        owner: what the holder does, for the message others get.
    Raises:
        ProjectError: another process holds it; the message says which.
        DiskError: the folder is not writable.
    """
    if project is None:
        yield
        return
    folder = project / FOLDER
    made = [place for place in (project, *project.parents) if not place.exists()]
    before = set(os.listdir(project)) if project.is_dir() else set()
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    note = folder / OWNER_FILE
    lock = FileLock(folder / LOCK_FILE, thread_local=False)
    try:
        with disk_errors(folder / LOCK_FILE):
            lock.acquire(timeout=0)
    except Timeout as error:
        raise ProjectError(
            f"{project} is being worked on by {_holder(note)}.", "Wait until it is done, or cancel it there."
        ) from error
    nothing_came = False
    try:
        with disk_errors(note):
            note.write_text(f"{owner} (process {os.getpid()})", encoding="utf-8")
        yield
    except BaseException:
        came = set(os.listdir(project)) - before
        nothing_came = came == {FOLDER} and not is_project(project)
        raise
    finally:
        with suppress(OSError):  # a disk that takes no changes any more: what went wrong says so
            note.unlink(missing_ok=True)
        if nothing_came:
            # Windows keeps the lock file until it is let go of.
            shutil.rmtree(folder, ignore_errors=True)
        lock.release()
        if nothing_came:
            with suppress(OSError):  # somebody else has taken the lock, or put something there
                shutil.rmtree(folder, ignore_errors=True)
                for place in made:
                    place.rmdir()


@contextmanager
def awaited_lock(
    project: Path | None, owner: str, check: Callable[[], None], patience: float | None = None
) -> Iterator[None]:
    """`project_lock` that waits for one who holds the project, `HOLDERS_TAKE` seconds unless `patience` says otherwise.

    Raises:
        as project_lock. What `check` raises to stop.
    """
    deadline = time.monotonic() + (HOLDERS_TAKE if patience is None else patience)
    with ExitStack() as stack:
        while True:
            check()
            try:
                stack.enter_context(project_lock(project, owner))
                break
            except ProjectError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.5)
        yield


def _holder(note: Path) -> str:
    try:
        return note.read_text(encoding="utf-8") or "another process"
    except OSError:
        return "another process"
