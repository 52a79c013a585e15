"""Files that a verb wrote at the place that the user chose, when it writes there again."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime
from pathlib import Path

from ..files import disk_errors
from .schema import Project


def remove_former(project: Project, verb: str, out: Path, written: Iterable[Path], to: str | None = None) -> None:
    """Remove what earlier steps of the same verb wrote for the same `out` and the files `written` now do not replace: parts and
    levels of detail of a mesh, masks of a class. What was changed since stays, it is the user's, and so does what belongs to
    another file or format (`to` of an export: cameras and masks may share a folder) as well.

    Raises:
        DiskError: one cannot be removed.
    """
    out, kept, noted = out.absolute(), {path.absolute() for path in written}, dict[Path, float]()
    for step in project.provenance:
        files = [Path(name) for name in step.result.get("files", [])]
        if (step.verb, step.settings.get("out"), step.settings.get("to")) != (verb, str(out), to):
            kept.update(files)
            continue
        for path in files:
            if path.is_relative_to(out) or (path.parent == out.parent and path.name.startswith(out.stem)):
                noted[path] = datetime.fromisoformat(step.time).timestamp() + 1  # it is told in whole seconds
    for path, time in noted.items():
        if path not in kept and path.is_file() and path.stat().st_mtime <= time:
            with disk_errors(path):
                path.unlink()
