"""Where the open file has fields, copies of their things, and instances of collections with such.

Views and panels ask that at each redraw, and a file may have hundreds of thousands of objects: it is looked for once, and again
where something was added, removed or made a field.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import bpy

Object, Collection = bpy.types.Object, bpy.types.Collection


class Kind(NamedTuple):
    """What of an empty says whether it counts."""

    is_field: bool = False
    crop: Object | None = None
    thing: str = ""
    field: Object | None = None
    instance: Collection | None = None


class Index(NamedTuple):
    """kinds: of empties that may count. objects: those that do, fields, copies and instances that show some. held: the same by
    the collections that hold them, scenes' own too. placed: these, fields of copies and crop boxes that are in a scene or in a
    collection in use: those that were deleted live on as long as something points to them."""

    kinds: dict[Object, Kind]
    objects: list[Object]
    held: dict[Collection, list[Object]]
    placed: set[Object]

    def in_scene(self, scene: bpy.types.Scene) -> set[Object]:
        """Those of the objects that a scene has."""
        if not self.objects:
            return set()
        return {obj for each in tree(scene.collection) for obj in self.held.get(each, ())}


PLAIN = Kind()
_known: Index | None = None


def current() -> Index:
    """What there is now. Without a window nothing tells when it changes, so it is looked for each time."""
    global _known
    if _known is None or bpy.app.background or not _is_alive(_known):
        _known = look()
    return _known


def look() -> Index:
    """Look for it."""
    kinds = {obj: kind for obj in bpy.data.objects if obj.type == "EMPTY" and (kind := kind_of(obj)) != PLAIN}
    counts = {obj for obj, kind in kinds.items() if kind.is_field or kind.thing}
    if not counts:
        return Index(kinds, [], {}, set())
    pointed = {obj for kind in kinds.values() for obj in (kind.crop, kind.field) if obj is not None}
    sought, held, placed = kinds.keys() | pointed, {}, set()
    scenes = [scene.collection for scene in bpy.data.scenes]
    for collection in (*bpy.data.collections, *scenes):
        held[collection] = [obj for obj in collection.objects if obj in sought]
        if collection in scenes or collection.users > collection.use_fake_user:
            placed.update(held[collection])
    instances: dict[Collection, list[Object]] = {}
    for obj, kind in kinds.items():
        if kind.instance is not None:
            instances.setdefault(kind.instance, []).append(obj)
    more = True
    while more:  # an instance of a collection that holds an instance that shows some
        shown = [c for c in instances if any(obj in counts for each in tree(c) for obj in held.get(each, ()))]
        more = bool(shown)
        for collection in shown:
            counts.update(instances.pop(collection))
    held = {collection: [obj for obj in found if obj in counts] for collection, found in held.items()}
    return Index(kinds, [obj for obj in kinds if obj in counts], held, placed)


def kind_of(obj: Object) -> Kind:
    own, copy = obj.fieldwork, obj.fieldwork_copy
    instance = obj.instance_collection if obj.instance_type == "COLLECTION" else None
    return Kind(own.is_field, own.crop, copy.thing, copy.field, instance)


def tree(collection: Collection) -> list[Collection]:
    """A collection and all below it."""
    return [collection, *collection.children_recursive]


def inside(
    collection: Collection, held: dict[Collection, list[Object]], is_hidden: Callable[[Any], bool]
) -> list[Object]:
    """Those of the held objects that an instance of a collection shows, each once."""
    if is_hidden(collection):
        return []
    own = [obj for obj in held.get(collection, ()) if not is_hidden(obj)]
    below = [obj for child in collection.children for obj in inside(child, held, is_hidden)]
    return list(dict.fromkeys(own + below))


def _is_alive(known: Index) -> bool:
    try:
        return all(obj.name for obj in known.objects)
    except ReferenceError:  # removed by a script
        return False


@bpy.app.handlers.persistent
def forget(*_: Any) -> None:
    """Look for it again the next time."""
    global _known
    _known = None


@bpy.app.handlers.persistent
def _updated(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    # The scene is updated wherever objects or collections come or go.
    if _known is not None and (
        depsgraph.id_type_updated("SCENE")
        or (depsgraph.id_type_updated("OBJECT") and any(_has_changed(each.id.original) for each in depsgraph.updates))
    ):
        forget()


def _has_changed(item: bpy.types.ID) -> bool:
    """Whether an object counts otherwise than before: an empty that only moves does not."""
    return (
        isinstance(item, Object)
        and item.type == "EMPTY"
        and _known is not None
        and kind_of(item) != _known.kinds.get(item, PLAIN)
    )


HANDLERS = (
    ("depsgraph_update_post", _updated),
    ("undo_post", forget),
    ("redo_post", forget),
    ("load_pre", forget),
    ("load_post", forget),
)


def register() -> None:
    for name, handler in _handlers():
        getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    for name, handler in _handlers():
        getattr(bpy.app.handlers, name).remove(handler)
    forget()


def _handlers() -> tuple[tuple[str, Any], ...]:
    return () if bpy.app.background else HANDLERS
