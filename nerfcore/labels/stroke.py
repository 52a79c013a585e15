"""The verbs `label stroke` and `label checkout`: a mark more, and which revision of the marks is shown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..geometry.similarity import similarity_scale, transform_points
from ..params import LabelCheckoutParams, LabelStrokeParams
from ..progress import Reporter
from ..project.schema import Project
from ..project.store import load_poses, load_project, world_from_marks
from .drawing import covered
from .journal import append_mark, marks_at, read_marks, show, shown_revision


def stroke(params: LabelStrokeParams, report: Reporter) -> dict[str, Any]:
    """Append a mark to the project's journal; it is on disk when this returns.

    Returns:
        {"revision", "parent", "marks": number of marks at this revision}
    Raises:
        InputError: there is no such photo or class, the photo has no pose, or the mark lies outside it.
        ProjectError, DiskError.
    """
    folder = Path(params.project)
    project = load_project(folder)
    if params.class_id is not None:
        require_class(project, params.class_id)
    values = params.model_dump(
        include={"photo", "shape", "points", "width", "level", "class_id", "erase", "author", "key"}
    )
    if params.places:
        return _appended(folder, {**values, **on_surface(params, world_from_marks(project))})
    require_photo(project, folder, params.photo)
    size = next((i.width, i.height) for i in project.images if i.name == params.photo)
    points = np.array(params.points, np.float64)
    if not np.isfinite(points).all() or not covered(params.shape, points, params.width, *size).any():
        raise InputError(
            f"The mark lies outside the photo “{params.photo}”, which is {size[0]}×{size[1]}.",
            "Give pixels of the photo, its top-left corner being 0,0.",
        )
    return _appended(folder, {**values, "size": size})


def on_surface(params: LabelStrokeParams, world_from_marks: np.ndarray) -> dict[str, Any]:
    """Places and width of a mark on the surface in the frame of such marks."""
    places = np.array(params.places, np.float64)
    marks_from_world = np.linalg.inv(world_from_marks)
    return {
        "places": transform_points(marks_from_world, places).tolist(),
        "width": params.width * similarity_scale(marks_from_world),
    }


def _appended(folder: Path, values: dict[str, Any]) -> dict[str, Any]:
    mark = append_mark(folder, values)
    marks = marks_at(read_marks(folder), mark.revision)
    return {"revision": mark.revision, "parent": mark.parent, "marks": len(marks)}


def checkout(params: LabelCheckoutParams, report: Reporter) -> dict[str, Any]:
    """Show another revision of the marks, as undo and redo do, or tell which one is shown.

    Returns:
        {"revision", "newest", "parent": None at revision 0, "marks"}
    Raises:
        InputError: there is no such revision. ProjectError, DiskError.
    """
    folder = Path(params.project)
    load_project(folder)
    if params.revision is not None:
        show(folder, params.revision)
    marks = read_marks(folder)
    revision = shown_revision(folder, len(marks))
    parent = marks[revision - 1].parent if revision else None
    return {"revision": revision, "newest": len(marks), "parent": parent, "marks": len(marks_at(marks, revision))}


def require_photo(project: Project, folder: Path, name: str) -> None:
    """Raise InputError unless the project has the photo and knows where it was taken."""
    if not any(image.name == name for image in project.images):
        raise InputError(f"{folder} has no photo “{name}”.", "Photos are named without folder and suffix.")
    if not any(image.name == name for image in load_poses(folder).images):
        raise InputError(f"The photo “{name}” has no pose.", "Mark another one, or run `fieldwork poses`.")


def require_class(project: Project, class_id: int) -> None:
    """Raise InputError unless the project has the class."""
    if not any(c.id == class_id for c in project.classes):
        known = ", ".join(f"{c.id} {c.name}" for c in project.classes)
        raise InputError(
            f"There is no class {class_id}.",
            f"The classes are {known}; `fieldwork classes` adds others."
            if known
            else "Add it with `fieldwork classes`.",
        )
