"""A file system with the manners of Windows, for tests on Linux.

Windows syncs only files that are open for writing, and neither replaces, renames nor deletes what a program has open
(Python opens without the right to delete) or mapped into its memory. Only what this process has counts here.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from fieldwork.nerfcore import files

OPEN_FILES, MAPPED_FILES = Path("/proc/self/fd"), Path("/proc/self/maps")


@pytest.fixture(params=["posix", "windows"])
def each_file_system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Run a test on the file system as it is, and on one that behaves like Windows'."""
    if request.param == "windows":
        if not OPEN_FILES.is_dir():
            pytest.skip("what a process has open is read from /proc")
        behave_like_windows(monkeypatch)
    return request.param


def behave_like_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Until the end of the test, os.fsync, replace, rename, remove and rmdir refuse what Windows refuses."""
    import fcntl  # not on Windows itself

    monkeypatch.setattr(files, "WINDOWS", True)
    fsync = os.fsync

    def sync(file: Any) -> None:
        number = file if isinstance(file, int) else file.fileno()
        if fcntl.fcntl(number, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(9, "Bad file descriptor")
        fsync(number)

    monkeypatch.setattr(os, "fsync", sync)
    for name in ("replace", "rename", "remove", "unlink", "rmdir"):
        monkeypatch.setattr(os, name, _refusing(getattr(os, name)))
    # The fast way of rmtree works on open folders, which Windows has no such functions for.
    monkeypatch.setattr(shutil, "_use_fd_functions", False)


def _refusing(call: Callable[..., None]) -> Callable[..., None]:
    def refuse_what_is_open(*paths: Any, **options: Any) -> None:
        for path in paths:
            if options.get("dir_fd") is None and (held := _open_below(os.fspath(path))):
                raise PermissionError(13, "The process cannot access the file: it is in use", held)
        call(*paths, **options)

    return refuse_what_is_open


def _open_below(path: Any) -> str | None:
    """A file that this process has open at `path` or in it, or mapped."""
    folder, name = os.path.split(os.fsdecode(path))
    wanted = os.path.join(os.path.realpath(folder), name)  # a link itself, not what it leads to
    for held in _open_and_mapped():
        if held == wanted or held.startswith(wanted + os.sep):
            return held
    return None


def _open_and_mapped() -> Iterator[str]:
    for number in os.listdir(OPEN_FILES):
        with suppress(OSError):  # the handle of this very listing
            yield os.readlink(OPEN_FILES / number)
    for line in MAPPED_FILES.read_text(errors="surrogateescape").splitlines():
        yield line.split(maxsplit=5)[-1]


def closes_after(file: Any, seconds: float) -> None:
    """Close an open file a while later, as a reader does."""
    time.sleep(seconds)
    file.close()
