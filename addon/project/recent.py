"""The projects that were open last on this machine, for the panel's list."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from .. import machine
from .snapshot import cached_json, has_project, read_json

FILE = "recent.json"  # of the machine: folders of projects, newest first
MOST = 10


def recent() -> list[Path]:
    """Folders of projects, newest first; those that are not there now are left out."""
    known = cached_json(machine.user_folder() / FILE)
    return [Path(folder) for folder in known if has_project(Path(folder))] if isinstance(known, list) else []


def remember(folder: Path) -> None:
    """Put a project at the head of the list, where the disk takes it."""
    # Not at the top: enabling the extension must be quick.
    from ...nerfcore.errors import DiskError
    from ...nerfcore.files import write_json

    path = machine.user_folder() / FILE
    known = read_json(path)
    others = [name for name in known if name != str(folder)] if isinstance(known, list) else []
    with suppress(DiskError):
        write_json(path, [str(folder), *others][:MOST])
