"""The journal of marks as the panels read it: the engine alone writes there (nerfcore/labels/journal.py)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..project.snapshot import cached_json

JOURNAL, SHOWN = "marks/journal.jsonl", "marks/shown.json"

_cache: dict[Path, tuple[tuple[int, int], list[dict[str, Any]]]] = {}


def marks(folder: Path) -> list[dict[str, Any]]:
    """All marks of a project by revision, as the engine wrote them; a line that is not whole, and what follows, is left
    out. Read again only when the file changed; nobody may change it."""
    path = folder / JOURNAL
    try:
        stat = path.stat()
    except OSError:
        return []
    changed = (stat.st_mtime_ns, stat.st_size)
    if path not in _cache or _cache[path][0] != changed:
        try:
            lines = path.read_bytes().split(b"\n")[:-1]
        except OSError:
            return []
        _cache[path] = (changed, _parsed(lines))
    return _cache[path][1]


def _parsed(lines: list[bytes]) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    for number, line in enumerate(lines, 1):
        try:
            mark = json.loads(line)
            if mark["revision"] != number or not 0 <= mark["parent"] < number:
                break
        except (ValueError, KeyError, TypeError):
            break
        found.append(mark)
    return found


def class_ids(folder: Path) -> set[int]:
    """The ids of classes that marks name, also of classes that are gone and of marks that were undone."""
    return {mark["class_id"] for mark in marks(folder) if mark.get("class_id") is not None}


def shown(folder: Path) -> int:
    """The revision of the marks that the project shows; 0 has none."""
    newest = len(marks(folder))
    value = cached_json(folder / SHOWN)
    revision = value.get("revision") if isinstance(value, dict) else None
    return revision if isinstance(revision, int) and 0 <= revision <= newest else newest


def ancestry(folder: Path, revision: int) -> list[int]:
    """A revision, its parent, and so on; without 0."""
    known, found = marks(folder), []
    while 0 < revision <= len(known):
        found.append(revision)
        revision = known[revision - 1]["parent"]
    return found


def marks_at(folder: Path, revision: int) -> list[dict[str, Any]]:
    """The marks of a revision, oldest first."""
    known = marks(folder)
    return [known[number - 1] for number in reversed(ancestry(folder, revision))]
