"""Which environments engines run in. Each engine holds a lock on a file of its environment, which the operating system lets go
of when it ends, also where it goes on without the Blender that started it. Standard library only, no bpy."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from .place import COMPLETE, ENVIRONMENTS

LOCK_FILE = "in-use.lock"


@contextmanager
def used(python: Path | str) -> Iterator[dict[str, Any]]:
    """Options of `Popen` with which a process that runs this Python holds its environment, where that is one of ours."""
    environment = Path(python).parent.parent
    ours = environment.name in ENVIRONMENTS and (environment.parent / COMPLETE).is_file()
    if sys.platform == "win32" or not ours:
        yield {}
        return
    import fcntl

    try:
        file = open(environment / LOCK_FILE, "a+b")  # noqa: SIM115 - closed below
    except OSError:
        yield {}
        return
    with file:  # the process has a handle of its own
        with suppress(OSError):  # a file system without locks
            fcntl.flock(file.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)
        yield {"pass_fds": (file.fileno(),)}


def is_used(environment: Path) -> bool:
    """Whether an engine runs in an environment."""
    if sys.platform == "win32":  # which moves no folder in which a program runs
        aside = environment.with_name(f"{environment.name}.look-{os.getpid()}")
        try:
            os.replace(environment, aside)
            os.replace(aside, environment)
        except OSError:
            return environment.exists()
        return False
    import fcntl

    try:
        file = open(environment / LOCK_FILE, "r+b")  # noqa: SIM115 - closed below
    except OSError:
        return False  # none has run there
    with file:
        try:
            fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:  # a file system without locks
            return False
    return False
