"""The verbs `classes` and `region`: small edits of a project that also run while a job works on it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from ..errors import SettingError
from ..params import ClassesParams, ClassValues, RegionParams
from ..progress import Reporter
from .classes import MOST_CLASSES, class_color, read_classes
from .schema import Project, SemanticClass
from .store import edit_project, load_project

MOST_ID = 65535  # label maps have at most 16 bits


def classes(params: ClassesParams, report: Reporter) -> dict[str, Any]:
    """List the classes of a project, or replace them by others.

    Returns:
        {"classes": [{"id", "name", "color": sRGB in [0, 1], "priority"}]}
    Raises:
        ProjectError: there is no project. SettingError: the classes contradict each other.
        InputError: the file cannot be read.
    """
    folder, wanted = Path(params.project), params.classes
    if params.file is not None:
        if wanted is not None:
            raise SettingError("Classes are given and a file of classes too.", "Give one of the two.")
        wanted = read_class_values(params.file)
    if wanted is None:
        return _listed(load_project(folder))
    with edit_project(folder) as project:
        project.classes = checked_classes(wanted, project)
    return _listed(project)


def region(params: RegionParams, report: Reporter) -> dict[str, Any]:
    """Show, set or clear the region of interest: an axis-aligned box in the aligned world, metres.

    Returns:
        {"bounds": [[x0, y0, z0], [x1, y1, z1]] or null}
    Raises:
        ProjectError: there is no project. SettingError: the box is flat or not finite.
    """
    folder = Path(params.project)
    if params.bounds is None and not params.clear:
        return {"bounds": load_project(folder).frame.bounds}
    if params.bounds is not None and params.clear:
        raise SettingError("A region is given and to be cleared at once.", "Give one of the two.")
    bounds = None if params.bounds is None else checked_bounds(params.bounds)
    with edit_project(folder) as project:
        project.frame.bounds = bounds
    return {"bounds": bounds}


def checked_classes(wanted: list[ClassValues], project: Project) -> list[SemanticClass]:
    """Classes sorted by id; what a known one does not say stays as it is, a new one gets its fixed colour.

    Raises:
        SettingError: an id or a name occurs twice, is void's, or is no id or name; a colour is outside [0, 1].
    """
    known = {c.id: c for c in project.classes}
    made: dict[int, SemanticClass] = {}
    names: set[str] = set()
    for values in wanted:
        name = values.name.strip()
        if values.id in made:
            raise SettingError(f"Two classes have the id {values.id}.", "Give every class an id of its own.")
        if values.id == project.ignore_id:
            raise SettingError(f"The id {values.id} stands for void and cannot be a class.", "Leave it out.")
        if not 0 <= values.id <= MOST_ID:
            raise SettingError(f"The class “{name}” has the id {values.id}.", f"Ids go from 0 to {MOST_ID}.")
        if not name or name in names:
            what = f"Two classes are called “{name}”." if name else f"The class {values.id} has no name."
            raise SettingError(what, "Give every class a name of its own.")
        if values.color is not None and not all(0 <= part <= 1 for part in values.color):
            raise SettingError(f"The colour of “{name}” is not three numbers from 0 to 1.", "Write for example 0.9.")
        if values.priority is not None and not np.isfinite(values.priority):
            raise SettingError(f"The priority of “{name}” is not a finite number.", "1 is the usual one.")
        names.add(name)
        old = known.get(values.id)
        color = values.color or (old.color if old else class_color(values.id, project.ignore_id))
        priority = values.priority if values.priority is not None else (old.priority if old else 1.0)
        made[values.id] = SemanticClass(id=values.id, name=name, color=color, priority=priority)
    if len(made) > MOST_CLASSES:
        raise SettingError(f"{len(made)} classes are too many.", f"A field tells at most {MOST_CLASSES} apart.")
    return [made[i] for i in sorted(made)]


def checked_bounds(bounds: list[list[float]]) -> list[list[float]]:
    """Raise SettingError unless `bounds` is [min (3), max (3)] of a box with a volume."""
    box = np.array(bounds, np.float64) if [len(row) for row in bounds] == [3, 3] else np.zeros((0, 3))
    if box.shape != (2, 3) or not np.isfinite(box).all():
        raise SettingError("The region is not six finite numbers.", "Give x0 y0 z0 x1 y1 z1.")
    if (box[1] - box[0] < 1e-6).any():
        raise SettingError(
            "The region is flat or inside out.", "Give x0 y0 z0 x1 y1 z1 with x0 < x1, y0 < y1, z0 < z1."
        )
    return box.tolist()


def read_class_values(path: Path) -> list[ClassValues]:
    """Classes of a file: as the verb lists them with --json, or in any form that `new --classes` reads.

    Raises:
        InputError: the file is missing, not JSON or of another form.
    """
    listed = _read_listed(path)
    if listed is not None:
        return listed
    names, _, colors = read_classes(path)
    made = []
    for i, name in sorted(names.items()):
        color = (colors[i][0] / 255, colors[i][1] / 255, colors[i][2] / 255) if i in colors else None
        made.append(ClassValues(id=i, name=name, color=color))
    return made


def _read_listed(path: Path) -> list[ClassValues] | None:
    """Classes as the verb lists them: colours are numbers from 0 to 1, not to 255, at least one of them with a decimal point,
    which some programs leave out of whole numbers. None for a file of another form."""
    try:
        entries = json.loads(Path(path).read_text(encoding="utf-8-sig"))["classes"]
        parts = [part for entry in entries for part in entry["color"]]
        if not all(0 <= part <= 1 for part in parts) or not any(isinstance(part, float) for part in parts):
            return None
        return TypeAdapter(list[ClassValues]).validate_python(entries)
    except (OSError, ValueError, KeyError, TypeError):
        return None  # the reader of the other form says what is wrong with it


def _listed(project: Project) -> dict[str, Any]:
    return {"classes": [c.model_dump(mode="json") for c in project.classes]}
