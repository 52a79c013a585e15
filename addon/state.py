"""What the project folder says, brought into the scene's properties, and edits of the classes taken back to it.

Reads `project.json` itself: the engine's schema needs libraries Blender does not have.
"""

from __future__ import annotations

import json
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy

from ..nerfcore.files import write_json

PROJECT_FILE = "project.json"
POSES_FILE = "poses/poses.json"

_loading = False
_changed_classes: dict[str, list[dict[str, Any]]] = {}  # project folder → classes to be written


def folder_of(settings: Any) -> Path | None:
    """The project folder of a scene as an absolute path, None when none is chosen."""
    return Path(bpy.path.abspath(settings.project)).absolute() if settings.project else None


def read_json(path: Path) -> Any:
    """The JSON in a file, None when there is no readable one."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def read_project(folder: Path) -> dict[str, Any] | None:
    value = read_json(folder / PROJECT_FILE)
    return value if isinstance(value, dict) and value.get("format") == "fieldwork-project" else None


def has_project(folder: Path | None) -> bool:
    return folder is not None and (folder / PROJECT_FILE).is_file()


def has_poses(folder: Path | None) -> bool:
    return folder is not None and (folder / POSES_FILE).is_file()


def runs(folder: Path | None) -> list[str]:
    """Names of the runs that have a trained field, newest last."""
    if folder is None:
        return []
    found = [path.parent for path in (folder / "runs").glob("*/*.safetensors")]
    return list(dict.fromkeys(run.name for run in sorted(found, key=lambda run: run.stat().st_mtime)))


def has_run(folder: Path | None, run: str) -> bool:
    return folder is not None and any((folder / "runs" / run).glob("*.safetensors"))


@contextmanager
def _quiet():
    global _loading
    _loading = True
    try:
        yield
    finally:
        _loading = False


def refresh(settings: Any) -> None:
    """Bring images and classes of the project into the scene's lists."""
    folder = folder_of(settings)
    project = read_project(folder) if folder else None
    # Areas are known from the mesh, not from the project: keep them.
    areas = {entry.id: (entry.area, entry.visible) for entry in settings.classes}
    with _quiet():
        settings.images.clear()
        settings.classes.clear()
        for image in (project or {}).get("images", []):
            entry = settings.images.add()
            entry.name = image["name"]
            entry.file = image.get("file", "")
            entry.status, entry.reason = image.get("status", "ok"), image.get("reason", "")
            entry.width, entry.height = image.get("width", 0), image.get("height", 0)
            entry.sharpness = image.get("sharpness") or 0.0
        for value in (project or {}).get("classes", []):
            entry = settings.classes.add()
            entry.id, entry.name, entry.color = value["id"], value["name"], value["color"]
            entry.priority = value.get("priority", 1.0)
            entry.area, entry.visible = areas.get(value["id"], (0.0, True))
        settings.image_index = min(settings.image_index, max(0, len(settings.images) - 1))
        settings.class_index = min(settings.class_index, max(0, len(settings.classes) - 1))


def project_changed(settings: Any) -> None:
    """Called when another project folder was chosen."""
    from . import jobs

    refresh(settings)
    folder = folder_of(settings)
    if folder is not None and not bpy.app.background:
        jobs.queue.reattach(folder)


def classes_changed(settings: Any) -> None:
    """Remember edited classes; the timer writes them, so that dragging a color does not write a file each pixel."""
    folder = folder_of(settings)
    if _loading or folder is None:
        return
    _changed_classes[str(folder)] = [
        {"id": c.id, "name": c.name, "color": [round(v, 6) for v in c.color], "priority": c.priority}
        for c in settings.classes
    ]


def write_classes() -> None:
    """Take edited classes to the project files."""
    while _changed_classes:
        folder, classes = _changed_classes.popitem()
        project = read_project(Path(folder))
        if project is not None:
            project["classes"] = classes
            write_json(Path(folder) / PROJECT_FILE, project)


def show_class(name: str, visible: bool) -> None:
    """Show or hide the objects of a class."""
    if _loading:
        return
    for obj in bpy.data.objects:
        if obj.get("fieldwork_class") == name:
            obj.hide_set(not visible)
            obj.hide_render = not visible
