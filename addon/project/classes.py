"""The classes of the project in the scene's list, and edits of the list back to the project."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from . import edits, snapshot
from .history import History

VERB = "classes"
FIELDS = ("name", "color", "priority")
UNKNOWN = {"color": (0.5, 0.5, 0.5), "priority": 1.0}  # of a class that was added, until the engine has said

_quiet = False
_sent: dict[Path, list[dict[str, Any]]] = {}  # lists with added or removed classes that the engine did not answer yet


@contextmanager
def quiet() -> Iterator[None]:
    """Inside, a changed list is no edit of the user."""
    global _quiet
    before, _quiet = _quiet, True
    try:
        yield
    finally:
        _quiet = before


def shown(folder: Path | None) -> list[dict[str, Any]]:
    """The classes of the project, with the edits that are under way."""
    return [UNKNOWN | value for value in _with_changes(folder, edits.pending(folder, VERB) or {})]


def wanted(folder: Path | None) -> list[dict[str, Any]]:
    """As `shown`, but as the engine is told, which has yet to choose the color of a class that was added."""
    return [told(value) for value in _with_changes(folder, edits.pending(folder, VERB) or {})]


def on_its_way(folder: Path, values: list[dict[str, Any]]) -> None:
    """A list with classes added or removed is sent to the engine: it stands over the file until `answered`."""
    _sent[folder] = values


def answered(folder: Path, values: list[dict[str, Any]]) -> None:
    """The engine took or refused this list; a newer one stays on its way."""
    if _sent.get(folder) is values:
        del _sent[folder]


def fill(settings: Any) -> None:
    """Let the scene's list show the classes."""
    folder = snapshot.folder_of(settings)
    areas = snapshot.last_result(folder, "mesh", settings.run).get("classes") or {}
    hidden = {entry.name for entry in settings.classes if not entry.visible}
    values = shown(folder)
    with quiet():
        resize(settings.classes, len(values))
        for entry, value in zip(settings.classes, values):
            entry.id, entry.name, entry.color = value["id"], value["name"], value["color"]
            entry.priority = value["priority"]
            entry.area = (areas.get(value["name"]) or {}).get("area") or 0.0
            entry.visible = value["name"] not in hidden
        settings.class_index = min(settings.class_index, max(0, len(settings.classes) - 1))


def edited(settings: Any) -> None:
    """The user changed the list: the timer takes it to the engine, so that dragging a color is one edit."""
    folder = snapshot.folder_of(settings)
    if _quiet or folder is None:
        return
    changes, known = _changes(settings, folder), _known(folder)
    for key, value in changes.items():
        _history.give(_key(folder, key), known[key], value)
    if changes:
        _put(folder, changes)


def undone(settings: Any) -> None:
    """After an undo or redo the list may be an older one.

    Where undo went along the user's edits, it is an edit itself. Any other difference is old news, and is put right by
    `fill`.
    """
    folder = snapshot.folder_of(settings)
    if folder is None:
        return
    known = _known(folder)
    changes = {
        key: value
        for key, value in _changes(settings, folder).items()
        if _history.go_back(_key(folder, key), known[key], value)
    }
    if changes:
        _put(folder, changes)


def resize(collection: Any, count: int) -> None:
    """Make a list of the scene as long as this. The entries stay where they are: the user may be typing into one."""
    while len(collection) > count:
        collection.remove(len(collection) - 1)
    while len(collection) < count:
        collection.add()


def _known(folder: Path) -> dict[tuple[int, str], Any]:
    """(class id, field) → value, as it is known of the project."""
    return {(value["id"], field): value[field] for value in shown(folder) for field in FIELDS}


def _key(folder: Path, key: tuple[int, str]) -> tuple[Any, ...]:
    return (folder, snapshot.owner(folder).uuid, *key)


def _changes(settings: Any, folder: Path) -> dict[tuple[int, str], Any]:
    """(class id, field) → value in the scene's list, where it is not what is known of the project."""
    known = {value["id"]: value for value in shown(folder)}
    changes: dict[tuple[int, str], Any] = {}
    for entry in settings.classes:
        for field in FIELDS if entry.id in known else ():
            value = getattr(entry, field)
            value = [round(channel, 6) for channel in value] if field == "color" else value
            if not _same(value, known[entry.id][field]):
                changes[entry.id, field] = value
    return changes


def _put(folder: Path, changes: dict[tuple[int, str], Any]) -> None:
    edits.put(folder, VERB, {**(edits.pending(folder, VERB) or {}), **changes}, _params)


def _params(folder: Path, changes: dict[tuple[int, str], Any]) -> dict[str, Any]:
    """All classes as they shall be: those that are known when the edit is sent, changed."""
    return {"classes": [told(value) for value in _with_changes(folder, changes)]}


def told(value: dict[str, Any]) -> dict[str, Any]:
    """What the engine is told of a class."""
    return {name: value[name] for name in ("id", *FIELDS) if name in value}


def _with_changes(folder: Path | None, changes: dict[tuple[int, str], Any]) -> list[dict[str, Any]]:
    project = (snapshot.project(folder) or {}).get("classes", [])
    known = project if folder is None else _sent.get(folder, project)
    changed = {field: {number: value for (number, name), value in changes.items() if name == field} for field in FIELDS}
    return [
        {**value, **{field: changed[field][value["id"]] for field in FIELDS if value["id"] in changed[field]}}
        for value in known
    ]


def _same(a: Any, b: Any) -> bool:
    """Whether values agree, as far as Blender's single precision goes."""
    if isinstance(a, str):
        return a == b
    pairs = zip(a, b) if isinstance(a, (list, tuple)) else [(a, b)]
    return all(abs(x - y) < 1e-5 * max(1.0, abs(x)) for x, y in pairs)


_history = History(_same)


def show(settings: Any) -> None:
    """Show and hide the classes on the meshes of the project in the scene as its list says."""
    folder = snapshot.folder_of(settings)
    if _quiet or folder is None:
        return
    from ..scene import visibility

    hidden = [entry.id for entry in settings.classes if not entry.visible]
    for obj in visibility.meshes(snapshot.owner(folder), settings.id_data.objects):
        visibility.hide_classes(obj, hidden)
