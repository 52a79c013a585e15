"""Single things of fields: how renders show them, and copies of them, which are objects of their own."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy
from mathutils import Matrix

from ..project import snapshot
from ..roles import is_local


def known(project: Path, run: str) -> list[dict[str, Any]]:
    """The instances of a run's mesh: id, name, class_id, area, center; none where there is no mesh."""
    value = snapshot.cached_json(project / "exports" / run / "instances.json")
    return value if isinstance(value, list) else []


def fill(obj: bpy.types.Object, project: Path) -> None:
    """Let the things of a field object be those of its run's mesh, with what the user set of them."""
    own = obj.fieldwork
    before = {entry.name: (entry.visible, entry.opacity, entry.tint, tuple(entry.color)) for entry in own.things}
    own.things.clear()
    for value in known(project, own.run):
        entry = own.things.add()
        entry.name, entry.center = value["name"], value["center"]
        if value["name"] in before:
            entry.visible, entry.opacity, entry.tint, entry.color = before[value["name"]]


def rename(field: bpy.types.Object, old: str, new: str, objects: Iterable[bpy.types.Object]) -> None:
    """A thing of a field has another name: what the user set of it, and its copies among the objects, stay its own."""
    for copy in copies(field, objects):
        if copy.fieldwork_copy.thing == old:
            copy.fieldwork_copy.thing = new
    entry = field.fieldwork.things.get(old)
    if entry is not None:
        entry.name = new


def looks(obj: bpy.types.Object) -> dict[str, dict[str, Any]]:
    """How the things of a field that are edited look where they stand."""
    return {
        entry.name: {**entry.look, "opacity": entry.opacity if entry.visible else 0.0}
        for entry in obj.fieldwork.things
        if entry.edited
    }


def look_of_copies(obj: bpy.types.Object, thing: str) -> dict[str, dict[str, Any]]:
    """How copies of a thing look."""
    entry = obj.fieldwork.things.get(thing)
    return {thing: entry.look} if entry is not None else {}


def copies(field: bpy.types.Object, objects: Iterable[bpy.types.Object]) -> list[bpy.types.Object]:
    """Those of the objects that are copies of things of a field."""
    original = field.original
    return [obj for obj in objects if field_of(obj) == original]


def field_of(copy: bpy.types.Object) -> bpy.types.Object | None:
    """The field of whose thing an object is a copy; None where it is none."""
    own = copy.fieldwork_copy
    there = own.thing and own.field is not None and own.field.type == "EMPTY" and own.field.fieldwork.is_field
    return own.field.original if there else None


def scene_from_capture(copy: bpy.types.Object) -> Matrix:
    """The matrix from the capture's own frame to the scene that puts the thing where its copy stands."""
    return copy.matrix_world @ Matrix.Translation(-copy.fieldwork_copy.center)


def put_beside(field: bpy.types.Object, made: bpy.types.Object) -> None:
    """Put a new object into the collections of a field, or into the scene where these are another file's."""
    own = [collection for collection in field.users_collection if is_local(collection)]
    for collection in own or [bpy.context.scene.collection]:
        collection.objects.link(made)


def add_copy(field: bpy.types.Object, entry: Any, name: str) -> bpy.types.Object:
    """A copy of a thing of a field, where the thing itself stands."""
    obj = bpy.data.objects.new(name, None)
    obj.empty_display_type, obj.empty_display_size = "ARROWS", 0.25
    put_beside(field, obj)
    obj.parent = field
    obj.location = entry.center
    own = obj.fieldwork_copy
    own.field, own.thing, own.center = field, entry.name, entry.center
    return obj


def edits(field: bpy.types.Object, objects: Iterable[bpy.types.Object]) -> list[dict[str, Any]]:
    """What is edited about a field, as `render --edits` reads it."""
    own, found = field.fieldwork, []
    for entry in own.classes:
        if entry.shown < 1 or entry.tint > 0:
            look = {"opacity": entry.shown, "tint": entry.tint, "color": list(entry.color)}
            found.append({"class": entry.name, **look})
    by_thing: dict[str, list[list[list[float]]]] = {}
    for copy in copies(field, objects):
        if not copy.hide_render:
            matrix = field.matrix_world.inverted_safe() @ scene_from_capture(copy)
            by_thing.setdefault(copy.fieldwork_copy.thing, []).append([list(row) for row in matrix])
    for entry in own.things:
        places = by_thing.get(entry.name, [])
        if entry.edited or places:
            edit = {"instance": entry.name, "opacity": entry.opacity, "tint": entry.tint, "color": list(entry.color)}
            found.append({**edit, "hide": not entry.visible, "copies": places})
    return found
