"""Paths that begin with "//", the folder of the open file, lead where they led when the file is saved in another folder, and
when something is appended or pasted from one: Blender itself looks after its own paths alone.
"""

from __future__ import annotations

import operator
import os
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import bpy

from ..paths import absolute
from ..props import PATHS
from ..roles import FOLDER, is_local

COPIED = "copybuffer.blend"  # what Blender pastes from: fields say themselves in which folder that was copied

rewriting = False  # a path is written otherwise, and leads to the same place


class Stored(NamedTuple):
    """A path as it is stored, and what stores another one."""

    path: str
    store: Callable[[str], None]


def relative_paths(items: Iterable[Any]) -> Iterator[Stored]:
    """The paths that begin with "//" of those of some scenes and objects that are this file's."""
    for item in items:
        # Of other objects than empties nothing is asked: that alone would make properties of theirs.
        if not is_local(item) or (isinstance(item, bpy.types.Object) and item.type != "EMPTY"):
            continue
        own = item.fieldwork
        texts = [prop for prop in own.bl_rna.properties if prop.type == "STRING"]
        names = [prop.identifier for prop in texts if prop.subtype in PATHS]
        found = [Stored(getattr(own, name), partial(setattr, own, name)) for name in names]
        if isinstance(item.get(FOLDER), str):
            found.append(Stored(item[FOLDER], partial(operator.setitem, item, FOLDER)))
        yield from (stored for stored in found if stored.path.startswith("//"))


def seen_from(folder: str, path: Path) -> str:
    """A path as files in a folder store it; as it is where Windows has it on another drive, or the folder is none."""
    try:
        return bpy.path.relpath(str(path), start=folder) if folder else str(path)
    except ValueError:
        return str(path)


def rewrite(items: Iterable[Any], folder: str, library: Any = None) -> list[Stored]:
    """Store the relative paths of scenes and objects, as they are in a library or else the open file, as files in `folder` do.
    Returns what was stored before."""
    before = list(relative_paths(items))
    _store([Stored(seen_from(folder, absolute(stored.path, library)), stored.store) for stored in before])
    return before


def fields_beside_file(items: Iterable[Any]) -> Iterator[Any]:
    """The settings of those items that are fields of this file with a project beside it."""
    for item in items:
        if isinstance(item, bpy.types.Object) and item.type == "EMPTY" and is_local(item):
            own = item.fieldwork
            if own.is_field and own.project.startswith("//"):
                yield own


def note(items: Iterable[Any]) -> None:
    """Let fields say in which folder their projects are, for files that they are pasted into."""
    if rewriting or not bpy.data.filepath:
        return
    for own in fields_beside_file(items):
        folder = str(absolute(own.project))
        if own.folder != folder:
            own.folder = folder


def _store(values: Iterable[Stored]) -> None:
    global rewriting
    rewriting = True
    try:
        for path, store in values:
            store(path)
    finally:
        rewriting = False


_before: list[Stored] = []  # paths of the open file, while it is saved elsewhere


@bpy.app.handlers.persistent
def _saving(file: str, *_: Any) -> None:
    folder = os.path.dirname(file)
    for obj in bpy.data.objects:
        if obj.type == "EMPTY" and is_local(obj) and obj.fieldwork.folder:
            obj.fieldwork.folder = ""  # files do not tell where they lay
    _before.clear()
    if bpy.data.filepath and folder != os.path.dirname(bpy.data.filepath):
        _before.extend(rewrite([*bpy.data.scenes, *bpy.data.objects], folder))


@bpy.app.handlers.persistent
def _saved(file: str, *_: Any) -> None:
    if file != bpy.data.filepath:  # a copy, or nothing: the open file stays where it is
        _store(_before)
    _before.clear()
    note(bpy.data.objects)


@bpy.app.handlers.persistent
def _loaded(*_: Any) -> None:
    note(bpy.data.objects)


@bpy.app.handlers.persistent
def _appended(imported: Any, *_: Any) -> None:
    here = os.path.dirname(bpy.data.filepath)
    for item in imported.import_items:
        if item.source_library is None or not isinstance(item.id, (bpy.types.Scene, bpy.types.Object)):
            continue
        if os.path.basename(item.source_library.filepath) != COPIED:
            rewrite([item.id], here, item.source_library)
            continue
        for own in fields_beside_file([item.id]):
            if own.folder:  # an older Fieldwork did not note it
                _store([Stored(seen_from(here, Path(own.folder)), partial(setattr, own, "project"))])
    note(bpy.data.objects)


HANDLERS = (
    ("save_pre", _saving),
    ("save_post", _saved),
    ("save_post_fail", _saved),
    ("load_post", _loaded),
    ("blend_import_post", _appended),  # from Blender 4.3 on
)


def register() -> None:
    for name, handler in HANDLERS:
        if hasattr(bpy.app.handlers, name):
            getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    for name, handler in HANDLERS:
        if hasattr(bpy.app.handlers, name):
            getattr(bpy.app.handlers, name).remove(handler)
