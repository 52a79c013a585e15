"""The training region: an empty in the scene, a cube, whose bounds go to the project."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import bpy
from mathutils import Matrix, Vector

from ..scene.frame import root_of, scene_from_capture, world_of
from . import edits, snapshot
from .history import History

VERB = "region"
CORNERS = [Vector((x, y, z)) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
Bounds = list[list[float]]  # [min, max] in the capture's frame, metres


class Look(NamedTuple):
    """What was seen of a scene's box: its bounds, those of the project, whether the box was moved since they agreed, and
    whether by undo."""

    box: Bounds
    project: Bounds | None
    moved: bool = False
    by_undo: bool = False


_seen: dict[str, Look] = {}  # by the names of the scenes of this file
_undone: set[str] = set()  # scenes whose box may be an older one


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
    the file with the box is an old one), the box goes to it. A box that nobody moved changes nothing.
    """
    box, folder, undone = find(scene), snapshot.folder_of(scene.fieldwork), scene.name in _undone
    _undone.discard(scene.name)
    if box is None or folder is None or not snapshot.has_project(folder) or snapshot.absence(scene.fieldwork):
        _seen.pop(scene.name, None)
        return False
    now, wanted = bounds_of(scene, box), bounds(folder)
    last = _seen.get(scene.name)
    if undone:
        # What undo did to a region that came from elsewhere is no edit of the user.
        if not _agree(now, wanted) and _history.go_back(_key(folder), wanted, now):
            _seen[scene.name] = Look(now, wanted, moved=True, by_undo=True)
            return False
        last = None
    if last is not None and not _same(now, last.box):
        _seen[scene.name] = Look(now, wanted, moved=True)
        return False
    if last is None or not _agree(wanted, last.project):
        _seen[scene.name] = Look(now, wanted)
        if wanted is not None and not _same(now, wanted):
            add(scene, wanted)
        return False
    if not last.moved or _flat(now) or _same(now, wanted):
        return False
    edit(folder, now, last.by_undo)
    _seen[scene.name] = Look(now, now)
    return True


def forget() -> None:
    """Another file was loaded: its scenes may be called like those of before."""
    _seen.clear()
    _undone.clear()


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
    world = scene_from_capture(scene, owner) @ Matrix.LocRotScale((low + high) / 2, None, (high - low) / 2)
    if box.parent is not None:  # Blender would take the parent's `matrix_world`
        world = (world_of(box.parent) @ box.matrix_parent_inverse).inverted_safe() @ world
    box.matrix_basis = world
    known = bounds(folder)
    _seen[scene.name] = Look(bounds_of(scene, box), known, moved=known is None)
    return box


def bounds_of(scene: bpy.types.Scene, box: bpy.types.Object, folder: Path | None = None) -> Bounds:
    """Axis-aligned bounds [min, max] of the box in the frame of the capture (None: of the scene's), also of a rotated
    one."""
    folder = folder or snapshot.folder_of(scene.fieldwork)
    capture_from_scene = scene_from_capture(scene, snapshot.owner(folder) if folder else None).inverted_safe()
    matrix = capture_from_scene @ world_of(box)
    corners = [matrix @ (corner * box.empty_display_size) for corner in CORNERS]
    return [[float(pick(c[i] for c in corners)) for i in range(3)] for pick in (min, max)]


def edit(folder: Path, wanted: Bounds | None, by_undo: bool = False) -> None:
    """Set or clear the training region of the project, by way of the engine; `by_undo`: as it was before.

    Raises:
        ValueError: the box is flat.
    """
    if wanted is not None and _flat(wanted):
        raise ValueError("The training region is flat: scale its box.")
    if not by_undo:
        _history.give(_key(folder), bounds(folder), wanted)
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


_history = History(_agree)


def _key(folder: Path) -> tuple[Path, str]:
    return folder, snapshot.owner(folder).uuid


def _flat(bounds: Bounds) -> bool:
    return any(high - low < 1e-6 for low, high in zip(*bounds))
