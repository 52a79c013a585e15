"""What the project's folder says, for Blender to read: the engine alone writes there.

Reads `project.json` itself, as the engine's schema needs libraries Blender does not have. What was read is kept outside
the scene, so that undo does not touch it, until the file changes; nobody may change it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..paths import absolute
from ..roles import Owner
from ..text import t

PROJECT_FILE = "project.json"
POSES_FILE = "poses/poses.json"
POSES_REPORT = "poses/report.json"

_cache: dict[Path, tuple[tuple[int, int, int], Any]] = {}


def folder_of(settings: Any) -> Path | None:
    """The project folder of a scene as an absolute path, None when none is chosen."""
    return absolute(settings.project) if settings.project else None


def read_json(path: Path) -> Any:
    """The JSON in a file, None when there is no readable one."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def cached_json(path: Path) -> Any:
    """`read_json` for drawing: the file is read again only when it changed."""
    try:
        stat = path.stat()
    except OSError:
        return None
    changed = (stat.st_mtime_ns, stat.st_size, stat.st_ino)
    if path not in _cache or _cache[path][0] != changed:
        _cache[path] = (changed, read_json(path))
    return _cache[path][1]


def project(folder: Path | None) -> dict[str, Any] | None:
    """What the project file says; None where there is none, or not one of Fieldwork's."""
    value = cached_json(folder / PROJECT_FILE) if folder else None
    return value if isinstance(value, dict) and value.get("format") == "fieldwork-project" else None


def owner(folder: Path) -> Owner:
    """The project as scenes know it."""
    from ...nerfcore.project.migrate import migrated  # not at the top: enabling the extension must be quick

    known = project(folder)
    return Owner(folder.name, migrated(known)["uuid"] if known else "")


def has_project(folder: Path | None) -> bool:
    return folder is not None and (folder / PROJECT_FILE).is_file()


def has_poses(folder: Path | None) -> bool:
    return folder is not None and (folder / POSES_FILE).is_file()


def frame(folder: Path | None) -> dict[str, Any]:
    """How the capture lies in the world: `bounds` of the training region, `scale_known` and others."""
    return (project(folder) or {}).get("frame") or {}


def last_result(folder: Path | None, verb: str, run: str | None = None) -> dict[str, Any]:
    """What a verb returned the last time (of a training run, where one is named), as the project recorded it."""
    for step in reversed((project(folder) or {}).get("provenance", [])):
        of = (step.get("settings") or {}).get("run", "main")
        if step.get("verb") == verb and run in (None, of):
            return step.get("result") or {}
    return {}


def source(folder: Path | None) -> dict[str, Any]:
    """The parameters with which photos were read into the project; empty where none were, or cameras came with them."""
    for step in (project(folder) or {}).get("provenance", []):
        if step.get("verb") == "new":
            return step.get("settings") or {}
    return {}


def imported(folder: Path | None) -> bool:
    """Whether the project was made of photos whose poses were known."""
    return any(step.get("verb") == "import" for step in (project(folder) or {}).get("provenance", []))


def absence(settings: Any) -> str | None:
    """Why the project that the scene knows cannot be had at its folder, as a sentence; None when it can, or when the
    scene has not seen one there."""
    folder = folder_of(settings)
    if folder is None or not settings.project_uuid:
        return None
    if not has_project(folder):
        return t("The project is not at {}: it was moved, or its disk is not connected.", folder)
    if owner(folder).uuid not in ("", settings.project_uuid):
        return t("{} holds another project than the scene knows.", folder)
    return None
