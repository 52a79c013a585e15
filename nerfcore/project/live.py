"""Where a training and whoever watches it meet: files in the project's folder `jobs/live`.

    training.json  there while a run is trained, and touched as it goes on: {"run", "pid"}
    views.json     what a Blender wants to see of it, touched while it looks: {"views": [LiveRequest, …]}
    *.pixels       in the folder of the watcher: pictures, see nerfcore/film/shared_file.py

Standard library only: Blender's side imports this module too.
"""

from __future__ import annotations

import json
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

FOLDER = Path("jobs") / "live"
TRAINING, VIEWS = "training.json", "views.json"
TOUCH = 2.0  # seconds between two signs of life
STALE = 15.0  # seconds without one after which nobody is there


def training_file(project: Path) -> Path:
    """The file that says that a run is trained."""
    return Path(project) / FOLDER / TRAINING


def views_file(project: Path) -> Path:
    """The file that says what is looked at."""
    return Path(project) / FOLDER / VIEWS


def alive(path: Path) -> bool:
    """Whether who writes a file is there still."""
    try:
        return abs(time.time() - path.stat().st_mtime) < STALE
    except OSError:
        return False


def training_run(project: Path) -> str | None:
    """The run that is trained in a project at the moment; None where none is."""
    path = training_file(project)
    if not alive(path):
        return None
    value = read(path)
    return value["run"] if isinstance(value, dict) and isinstance(value.get("run"), str) else None


def read(path: Path) -> Any:
    """The JSON in a file, None when there is no readable one."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def write(path: Path, value: Any) -> bool:
    """Atomically write JSON that is of use for moments only; whether it could be."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps(value), encoding="utf-8")
        os.replace(temporary, path)
    except OSError:  # no room, or it is being read on Windows
        return False
    return True


def touch(path: Path) -> None:
    """Give a sign of life."""
    with suppress(OSError):
        os.utime(path)


def remove(path: Path) -> None:
    """Remove a file, if it is there."""
    with suppress(OSError):
        path.unlink()
