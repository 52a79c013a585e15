"""One installation at a time: a lock that the operating system lets go of when its process ends. Standard library
only, no bpy."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from .tools import InstallError

LOCK_FILE = "install.lock"


@contextmanager
def only_one(folder: Path) -> Iterator[None]:
    """Hold the engine's folder for changing it.

    Raises:
        InstallError: another process holds it, or the folder is not writable.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = open(folder / LOCK_FILE, "a+b")  # noqa: SIM115 - closed below
    except OSError as error:
        raise InstallError(f"{folder} cannot be written: {error.strerror}. Check its permissions.") from error
    with file:
        try:
            _hold(file)
        except OSError as error:
            raise InstallError(
                f"Another Blender is installing or removing the engine in {folder}. Wait until it is done."
            ) from error
        yield


def _hold(file: IO[bytes]) -> None:
    if sys.platform == "win32":
        import msvcrt

        file.seek(0)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)


def forget(folder: Path) -> None:
    """Remove a folder that may be in use: what cannot be removed is left for the next time, under a name of its own."""
    import shutil

    if not folder.exists():
        return
    aside = folder.with_name(f"{folder.name}.old-{os.getpid()}")
    try:
        os.replace(folder, aside)  # Windows refuses where a program in it runs
    except OSError:
        return
    shutil.rmtree(aside, ignore_errors=True)
