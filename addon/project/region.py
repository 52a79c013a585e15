"""The training region: an empty in the scene, a cube, whose bounds go to the project."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
from mathutils import Matrix, Vector

from ..scene.frame import root_of, scene_from_capture
from . import snapshot as state

CORNERS = [Vector((x, y, z)) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
Bounds = list[list[float]]  # [min, max] in the capture's frame, metres

# scene → bounds of its box and of its project at the last look, and whether the box was moved since they agreed
_seen: dict[str, tuple[Bounds, Bounds | None, bool]] = {}


def find(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The crop box of the scene."""
    box = scene.fieldwork.region_box
    # A deleted object lives on as long as something points to it.
    return box if box is not None and scene.objects.get(box.name) == box else None


def follow(scene: bpy.types.Scene) -> bool:
    """Keep the box and the project alike; whether the project was written.

    A box that was moved goes to the project once it rests. Where the project has changed by itself (it was aligned, or
    the file with the box is an old one), the box goes to it.
    """
    box, folder = find(scene), state.folder_of(scene.fieldwork)
    if box is None or not state.has_project(folder):
        _seen.pop(scene.name, None)
        return False
    bounds, wanted = bounds_of(scene, box), _bounds(state.cached_project(folder))
    new = scene.name not in _seen
    before, known, moved = _seen.get(scene.name, (bounds, wanted, wanted is None))
    if not _same(bounds, before):
        _seen[scene.name] = bounds, wanted, True
        return False
    if new or wanted != known:
        _seen[scene.name] = bounds, wanted, new and moved
        if wanted is not None and not _same(bounds, wanted):
            add(scene, wanted)
        return False
    if not moved or _flat(bounds) or _same(bounds, wanted):
        return False
    write_bounds(folder, bounds)
    _seen[scene.name] = bounds, bounds, False
    return True


def add(scene: bpy.types.Scene, bounds: Bounds) -> bpy.types.Object:
    """Put a box with the bounds into the scene, or move the one that is there."""
    box = find(scene)
    if box is None:
        box = bpy.data.objects.new("Fieldwork Training Region", None)
        box.empty_display_type, box.empty_display_size = "CUBE", 1.0
        scene.collection.objects.link(box)
    folder = state.folder_of(scene.fieldwork)
    low, high = Vector(bounds[0]), Vector(bounds[1])
    scene.fieldwork.region_box = box
    box.empty_display_size = 1.0
    if box.parent is None:
        box.parent = root_of(scene, folder)  # so that it goes where the capture goes
    box.matrix_world = scene_from_capture(scene, folder) @ Matrix.LocRotScale((low + high) / 2, None, (high - low) / 2)
    wanted = _bounds(state.cached_project(folder))
    _seen[scene.name] = bounds_of(scene, box), wanted, wanted is None
    return box


def bounds_of(scene: bpy.types.Scene, box: bpy.types.Object) -> Bounds:
    """Axis-aligned bounds [min, max] of the box in the capture's frame, also of a rotated one."""
    matrix = scene_from_capture(scene, state.folder_of(scene.fieldwork)).inverted_safe() @ box.matrix_world
    corners = [matrix @ (corner * box.empty_display_size) for corner in CORNERS]
    return [[float(pick(c[i] for c in corners)) for i in range(3)] for pick in (min, max)]


def _same(a: Bounds, b: Bounds | None) -> bool:
    """Whether bounds agree as far as Blender's single precision goes."""
    if b is None:
        return False
    size = max(1.0, *(abs(value) for row in a for value in row))
    return all(abs(x - y) < 1e-5 * size for row, other in zip(a, b) for x, y in zip(row, other))


def _flat(bounds: Bounds) -> bool:
    return any(high - low < 1e-6 for low, high in zip(*bounds))


def _bounds(project: dict[str, Any] | None) -> Bounds | None:
    return ((project or {}).get("frame") or {}).get("bounds")


def read_bounds(folder: Path) -> Bounds | None:
    """The training region of the project, None when everything is trained."""
    return _bounds(state.read_project(folder))


def write_bounds(folder: Path, bounds: Bounds | None) -> None:
    """Set or clear the training region of the project.

    Raises:
        ValueError: there is no project, or the box is flat.
    """
    project: dict[str, Any] | None = state.read_project(folder)
    if project is None:
        raise ValueError(f"There is no project at {folder}.")
    if bounds is not None and _flat(bounds):
        raise ValueError("The training region is flat: scale its box.")
    from ...nerfcore.files import write_json  # not at the top: enabling the extension must be quick

    project.setdefault("frame", {})["bounds"] = bounds
    write_json(folder / state.PROJECT_FILE, project)
