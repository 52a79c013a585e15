"""What the project folder says, brought into the scene's properties, and edits of the classes taken back to it.

Reads `project.json` itself: the engine's schema needs libraries Blender does not have.
"""

from __future__ import annotations

import json
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy

from .. import machine

PROJECT_FILE = "project.json"
POSES_FILE = "poses/poses.json"
POSES_REPORT = "poses/report.json"
TIMES_FILE = "training_times.json"  # of the machine: seconds by preset

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


def last_result(project: dict[str, Any] | None, verb: str) -> dict[str, Any]:
    """What the last run of a verb returned, as the project recorded it."""
    steps = [step for step in (project or {}).get("provenance", []) if step.get("verb") == verb]
    return steps[-1].get("result") or {} if steps else {}


def can_resume(folder: Path | None, run: str) -> bool:
    """Whether a training of the run stopped before its end and left a checkpoint."""
    if folder is None or not has_run(folder, run):
        return False
    # Training writes its metrics at the end, and removes those of before at the start.
    return "train" not in (cached_json(folder / "runs" / run / "metrics.json") or {})


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
    agreement = (
        {image["name"]: image for image in (read_json(folder / POSES_REPORT) or {}).get("images", [])} if folder else {}
    )
    areas = last_result(project, "mesh").get("classes") or {}
    hidden = {entry.name for entry in settings.classes if not entry.visible}
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
            checked = agreement.get(entry.name, {})
            entry.points = checked.get("points") or 0
            entry.error_px = checked.get("error_px") or 0.0
            entry.labelled, entry.masked = bool(image.get("label")), bool(image.get("mask"))
        for value in (project or {}).get("classes", []):
            entry = settings.classes.add()
            entry.id, entry.name, entry.color = value["id"], value["name"], value["color"]
            entry.priority = value.get("priority", 1.0)
            entry.area = (areas.get(value["name"]) or {}).get("area") or 0.0
            entry.visible = value["name"] not in hidden
        settings.image_index = min(settings.image_index, max(0, len(settings.images) - 1))
        settings.class_index = min(settings.class_index, max(0, len(settings.classes) - 1))


def undone(settings: Any) -> None:
    """After an undo or redo the lists may be those of before a job: bring them up to date.

    An edit of the classes that was undone is undone in the project too.
    """
    folder = folder_of(settings)
    project = cached_project(folder)
    if project is None:
        return
    if [entry.id for entry in settings.classes] == [value["id"] for value in project.get("classes", [])]:
        classes_changed(settings)
        write_classes()
    refresh(settings)


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
        if project is not None and not _agree(project.get("classes", []), classes):
            from ...nerfcore.files import write_json  # not at the top: enabling the extension must be quick

            project["classes"] = classes
            write_json(Path(folder) / PROJECT_FILE, project)


def _agree(old: list[dict[str, Any]], new: list[dict[str, Any]]) -> bool:
    """Whether classes say the same, as far as Blender's single precision goes."""
    exact = [(c["id"], c["name"]) for c in old] == [(c["id"], c["name"]) for c in new]
    pairs = [
        (a, b)
        for o, n in zip(old, new)
        for a, b in zip([*o["color"], o.get("priority", 1.0)], [*n["color"], n["priority"]])
    ]
    return exact and all(abs(a - b) < 1e-5 * max(1.0, abs(a)) for a, b in pairs)


def show_classes(settings: Any) -> None:
    """Show and hide the classes on the meshes of the project as the list says."""
    folder = folder_of(settings)
    if _loading or folder is None:
        return
    from ..scene import visibility

    hidden = [entry.id for entry in settings.classes if not entry.visible]
    for obj in visibility.meshes(folder.name):
        visibility.hide_classes(obj, hidden)


_cache: dict[Path, tuple[float, Any]] = {}


def cached_json(path: Path) -> Any:
    """`read_json` for drawing: the file is read again only when it changed."""
    try:
        changed = path.stat().st_mtime
    except OSError:
        return None
    if path not in _cache or _cache[path][0] != changed:
        _cache[path] = (changed, read_json(path))
    return _cache[path][1]


def cached_project(folder: Path | None) -> dict[str, Any] | None:
    return cached_json(folder / PROJECT_FILE) if folder else None


def quality(folder: Path | None, run: str) -> str:
    """Measured quality of a run in a few words; empty when it was not measured."""
    metrics = cached_json(folder / "runs" / run / "metrics.json") if folder else None
    if not isinstance(metrics, dict):
        return ""
    measured = metrics.get("test") or {}
    psnr, miou = measured.get("psnr"), measured.get("miou")
    words = [f"{psnr:.1f} dB" if psnr is not None else "", f"mIoU {miou:.2f}" if miou is not None else ""]
    return ", ".join(word for word in words if word)


def time_estimate(folder: Path | None, settings: Any) -> float | None:
    """Seconds that training with this preset took the last time, in this project or else on this machine; None when
    that says nothing."""
    if settings.time_limit > 0 or settings.steps > 0:
        return None
    for step in reversed((cached_project(folder) or {}).get("provenance", [])):
        same = step.get("verb") == "train" and step.get("settings", {}).get("preset") == settings.preset
        if same and not step["settings"].get("time_limit") and not step["settings"].get("steps"):
            return step.get("result", {}).get("seconds")
    times = cached_json(machine.user_folder() / TIMES_FILE)
    return times.get(settings.preset) if isinstance(times, dict) else None


def remember_time(preset: str, seconds: float) -> None:
    """Note how long a whole training with a preset took on this machine."""
    from ...nerfcore.files import write_json  # not at the top: enabling the extension must be quick

    path = machine.user_folder() / TIMES_FILE
    write_json(path, {**(read_json(path) or {}), preset: seconds})
