"""What several files of tests read, made by the first worker of a run that asks for it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], Path]) -> Path:
    """What `make(folder)` returned to the first worker; the others wait for it and get the same. No test changes it."""
    root = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent  # of all workers
    done = root / f"{name}.made"
    with FileLock(root / f"{name}.lock"):
        if not done.exists():
            done.write_text(str(make(factory.mktemp(name))), "utf-8")
    return Path(done.read_text("utf-8"))
