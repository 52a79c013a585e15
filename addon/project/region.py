"""The training region: an empty in the scene, a cube, whose bounds go to the project."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
from mathutils import Matrix, Vector

from ..scene.frame import root_of, scene_from_capture
from . import edits, snapshot

VERB = "region"
CORNERS = [Vector((x, y, z)) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
Bounds = list[list[float]]  # [min, max] in the capture's frame, metres

# scene → bounds of its box and of its project at the last look, and whether the box was moved since they agreed
_seen: dict[str, tuple[Bounds, Bounds | None, bool]] = {}
_undone: set[str] = set()  # scenes whose box may be an older one
_given: dict[Path, Bounds | None] = {}  # project folder → bounds that the user gave it here last


def find(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The box of the scene."""
    box = scene.fieldwork.region_box
    # A deleted object lives on as long as something points to it.
    return box if box is not None and scene.objects.get(box.name) == box else None


def bounds(folder: Path | None) -> Bounds | None:
    """The training region of the project, with an edit that is under way; None when everything is trained."""
    edited = edits.pending(folder, VERB)
    return edited["bounds"] if edited else snapshot.frame(folder).get("bounds")


def follow(scene: bpy.types.Scene) -> bool:
    """Keep the box and the project alike; whether the project is edited.

    A box that was moved goes to the project once it rests. Where the project has changed by itself (it was aligned, or
    the file with the box is an old one), the box goes to it.
    """
    box, folder = find(scene), snapshot.folder_of(scene.fieldwork)
    if box is None or folder is None or not snapshot.has_project(folder) or snapshot.absence(scene.fieldwork):
        _seen.pop(scene.name, None)
        _undone.discard(scene.name)
        return False
    now, wanted = bounds_of(scene, box), bounds(folder)
    new = scene.name not in _seen
    before, known, moved = _seen.get(scene.name, (now, wanted, wanted is None))
    # What undo did to a region that came from elsewhere is no edit of the user.
    if scene.name in _undone and not (folder in _given and _agree(_given[folder], wanted)):
        before, new, moved = now, True, False
    _undone.discard(scene.name)
    if not _same(now, before):
        _seen[scene.name] = now, wanted, True
        return False
    if new or wanted != known:
        _seen[scene.name] = now, wanted, new and moved
        if wanted is not None and not _same(now, wanted):
            add(scene, wanted)
        return False
    if not moved or _flat(now) or _same(now, wanted):
        return False
    edit(folder, now)
    _seen[scene.name] = now, now, False
    return True


def undone(scene: bpy.types.Scene) -> None:
    """An undo or redo may have brought back an older box."""
    _undone.add(scene.name)


def add(scene: bpy.types.Scene, wanted: Bounds) -> bpy.types.Object:
    """Put a box with the bounds into the scene, or move the one that is there."""
    box = find(scene)
    if box is None:
        box = bpy.data.objects.new("Fieldwork Training Region", None)
        box.empty_display_type, box.empty_display_size = "CUBE", 1.0
        scene.collection.objects.link(box)
    folder = snapshot.folder_of(scene.fieldwork)
    owner = snapshot.owner(folder) if folder else None
    low, high = Vector(wanted[0]), Vector(wanted[1])
    scene.fieldwork.region_box = box
    box.empty_display_size = 1.0
    if box.parent is None:
        box.parent = root_of(scene, owner)  # so that it goes where the capture goes
    box.matrix_world = scene_from_capture(scene, owner) @ Matrix.LocRotScale((low + high) / 2, None, (high - low) / 2)
    known = bounds(folder)
    _seen[scene.name] = bounds_of(scene, box), known, known is None
    return box


def bounds_of(scene: bpy.types.Scene, box: bpy.types.Object, folder: Path | None = None) -> Bounds:
    """Axis-aligned bounds [min, max] of the box in the frame of the capture (None: of the scene's), also of a rotated
    one."""
    folder = folder or snapshot.folder_of(scene.fieldwork)
    capture_from_scene = scene_from_capture(scene, snapshot.owner(folder) if folder else None).inverted_safe()
    matrix = capture_from_scene @ box.matrix_world
    corners = [matrix @ (corner * box.empty_display_size) for corner in CORNERS]
    return [[float(pick(c[i] for c in corners)) for i in range(3)] for pick in (min, max)]


def edit(folder: Path, wanted: Bounds | None) -> None:
    """Set or clear the training region of the project, by way of the engine.

    Raises:
        ValueError: the box is flat.
    """
    if wanted is not None and _flat(wanted):
        raise ValueError("The training region is flat: scale its box.")
    _given[folder] = wanted
    edits.put(folder, VERB, {"bounds": wanted}, _params)


def _params(folder: Path, values: dict[str, Bounds | None]) -> dict[str, Any]:
    return {"clear": True} if values["bounds"] is None else values


def _same(a: Bounds, b: Bounds | None) -> bool:
    """Whether bounds agree as far as Blender's single precision goes."""
    if b is None:
        return False
    size = max(1.0, *(abs(value) for row in a for value in row))
    return all(abs(x - y) < 1e-5 * size for row, other in zip(a, b) for x, y in zip(row, other))


def _agree(a: Bounds | None, b: Bounds | None) -> bool:
    return a is b or (a is not None and _same(a, b))


def _flat(bounds: Bounds) -> bool:
    return any(high - low < 1e-6 for low, high in zip(*bounds))
