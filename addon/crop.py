"""The training region: an empty in the scene, a cube, whose bounds go to the project."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
from mathutils import Matrix, Vector

from . import state

CORNERS = [Vector((x, y, z)) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]


_seen: dict[str, list[list[float]]] = {}  # scene → bounds of its box at the last look


def find(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The crop box of the scene."""
    box = scene.fieldwork.region_box
    # A deleted object lives on as long as something points to it.
    return box if box is not None and scene.objects.get(box.name) == box else None


def follow(scene: bpy.types.Scene) -> bool:
    """Take a box that was moved to the project, once it rests; whether the project was written."""
    box, folder = find(scene), state.folder_of(scene.fieldwork)
    if box is None or not state.has_project(folder):
        _seen.pop(scene.name, None)
        return False
    bounds, before = bounds_of(box), _seen.get(scene.name)
    _seen[scene.name] = bounds
    if bounds != before or _flat(bounds) or bounds == _bounds(state.cached_project(folder)):
        return False
    write_bounds(folder, bounds)
    return True


def add(scene: bpy.types.Scene, bounds: list[list[float]]) -> bpy.types.Object:
    """Put a box with the bounds [min, max] (world, metres) into the scene, or move the one that is there."""
    box = find(scene)
    if box is None:
        box = bpy.data.objects.new("Fieldwork Training Region", None)
        box.empty_display_type, box.empty_display_size = "CUBE", 1.0
        scene.collection.objects.link(box)
    low, high = Vector(bounds[0]), Vector(bounds[1])
    scene.fieldwork.region_box = box
    box.matrix_world = Matrix.LocRotScale((low + high) / 2, None, (high - low) / 2)
    return box


def bounds_of(box: bpy.types.Object) -> list[list[float]]:
    """Axis-aligned bounds [min, max] of the box in the world, also of a rotated one."""
    corners = [box.matrix_world @ (corner * box.empty_display_size) for corner in CORNERS]
    return [[float(pick(c[i] for c in corners)) for i in range(3)] for pick in (min, max)]


def _flat(bounds: list[list[float]]) -> bool:
    return any(high - low < 1e-6 for low, high in zip(*bounds))


def _bounds(project: dict[str, Any] | None) -> list[list[float]] | None:
    return ((project or {}).get("frame") or {}).get("bounds")


def read_bounds(folder: Path) -> list[list[float]] | None:
    """The training region of the project, None when everything is trained."""
    return _bounds(state.read_project(folder))


def write_bounds(folder: Path, bounds: list[list[float]] | None) -> None:
    """Set or clear the training region of the project.

    Raises:
        ValueError: there is no project, or the box is flat.
    """
    project: dict[str, Any] | None = state.read_project(folder)
    if project is None:
        raise ValueError(f"There is no project at {folder}.")
    if bounds is not None and _flat(bounds):
        raise ValueError("The training region is flat: scale its box.")
    from ..nerfcore.files import write_json  # not at the top: enabling the extension must be quick

    project.setdefault("frame", {})["bounds"] = bounds
    write_json(folder / state.PROJECT_FILE, project)
