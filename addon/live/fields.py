"""The fields that a scene shows: those of its field objects, or without any that of its project."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import bpy
from mathutils import Matrix

from ..errors import SceneError
from ..paths import absolute
from ..project import snapshot
from ..roles import is_local
from ..scene.frame import scene_from_capture
from ..text import t
from . import things


def field_objects(objects: Iterable[bpy.types.Object]) -> list[bpy.types.Object]:
    """Those of the objects that are fields."""
    return [obj for obj in objects if obj.type == "EMPTY" and obj.fieldwork.is_field]


class Part(NamedTuple):
    """What is shown: a field, or a copy of a thing of it."""

    field: bpy.types.Object
    copy: bpy.types.Object | None

    @property
    def object(self) -> bpy.types.Object:
        """That says where it is."""
        return self.copy or self.field


def parts(objects: Iterable[bpy.types.Object], is_shown: Callable[[bpy.types.Object], bool]) -> list[Part]:
    """The fields of some objects that are shown, each with the copies of its things; copies of a field that is hidden are shown."""
    empties, found = [obj for obj in objects if obj.type == "EMPTY"], []
    copied = [obj for obj in empties if obj.fieldwork_copy.thing]
    for field in field_objects(empties):
        placed = [None] if is_shown(field) else []
        placed += [copy for copy in things.copies(field, copied) if is_shown(copy)]
        found += [Part(field, copy) for copy in placed]
    return found


def rendered_parts(depsgraph: bpy.types.Depsgraph) -> list[Part]:
    """Those that a render shows in the frame of the depsgraph."""
    inside = in_rendered_collections(depsgraph.view_layer.layer_collection)

    def is_shown(obj: bpy.types.Object) -> bool:
        return obj.name_full in inside and not obj.evaluated_get(depsgraph).hide_render

    return parts(depsgraph.view_layer.objects, is_shown)


def in_rendered_collections(layer: bpy.types.LayerCollection) -> set[str]:
    """Full names of the objects in a collection of a view layer, or in one below it, that renders are not told to leave out."""
    if layer.exclude or layer.collection.hide_render:
        return set()
    below = (in_rendered_collections(child) for child in layer.children)
    return {obj.name_full for obj in layer.collection.objects}.union(*below)


def rendered_items(depsgraph: bpy.types.Depsgraph) -> list[dict[str, Any]]:
    """What a render of a view layer shows, as nerfcore/film/shot.py describes fields; nothing where other frames or view
    layers show the scene's fields.

    Raises SceneError: there is no field to show, or things are edited of one that is not baked.
    """
    scene, layer = depsgraph.scene, depsgraph.view_layer
    baked = depsgraph.scene_eval.fieldwork_live.source == "baked"
    known = field_objects(scene.objects)
    if not known:
        return [project_item(depsgraph.scene_eval, baked)]
    items = [_rendered_item(part, baked, depsgraph) for part in rendered_parts(depsgraph)]
    others = [other for other in scene.view_layers if other.use and other != layer]
    elsewhere = any(field in set(other.objects) for other in others for field in known)
    if not items and not elsewhere and not any(field.animation_data for field in known):
        raise SceneError(t("All fields of the scene are hidden in renders."))
    return items


def _rendered_item(part: Part, baked: bool, depsgraph: bpy.types.Depsgraph) -> dict[str, Any]:
    field = part.field.evaluated_get(depsgraph)
    thing = part.copy.fieldwork_copy.thing if part.copy is not None else ""
    looks = things.look_of_copies(field, thing) if thing else things.looks(field)
    if (thing or looks) and not baked:
        raise SceneError(
            t("Things of “{}” are edited, which only the baked field can show: choose Baked Field.", field.name)
        )
    item = {**item_of(field, baked, depsgraph), "instances": looks, "only": thing}
    if part.copy is not None:
        item.pop("crop", None)
        item |= poses_of(field, depsgraph, part.copy)
    return item


def item_of(obj: bpy.types.Object, baked: bool, depsgraph: bpy.types.Depsgraph | None = None) -> dict[str, Any]:
    """A field object as it is, or in a depsgraph, with all its things as they are. Raises SceneError: it has no project."""
    own = obj.fieldwork
    folder = folder_of(own)
    if folder is None:
        raise SceneError(t("The field “{}” has no project folder.", obj.name))
    return {
        "name": obj.name,
        "project": str(folder),
        "run": own.run,
        "baked": baked,
        **poses_of(obj, depsgraph),
        "look": own.look,
        "classes": {
            entry.id: {"opacity": entry.shown, "tint": entry.tint, "color": tuple(entry.color)} for entry in own.classes
        },
    }


def poses_of(
    obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None, copy: bpy.types.Object | None = None
) -> dict[str, Any]:
    """Where a field object is, and its crop box if it has one; where a copy of a thing of it is, which is not cropped."""
    if copy is not None:
        placed = copy.evaluated_get(depsgraph) if depsgraph is not None else copy
        return {"scene_from_capture": rows(things.scene_from_capture(placed))}
    found, crop = {"scene_from_capture": rows(obj.matrix_world)}, crop_box(obj.fieldwork)
    if crop is not None:
        found["crop"] = rows(crop_matrix(crop.evaluated_get(depsgraph) if depsgraph is not None else crop))
    return found


def project_item(scene: bpy.types.Scene, baked: bool) -> dict[str, Any]:
    """The field of the scene's project, where its capture stands. Raises SceneError: the scene has no project."""
    settings = scene.fieldwork
    folder = snapshot.folder_of(settings)
    if folder is None:
        raise SceneError(t("The scene has no field: choose a project in the Fieldwork tab, or add a field."))
    hidden = {entry.id: entry for entry in settings.classes if not entry.visible}
    return {
        "name": folder.name,
        "project": str(folder),
        "run": settings.run,
        "baked": baked,
        "scene_from_capture": rows(scene_from_capture(scene, snapshot.owner(folder))),
        "classes": {number: {"opacity": 0.0, "color": tuple(entry.color)} for number, entry in hidden.items()},
    }


def crop_box(own: Any) -> bpy.types.Object | None:
    """The box that a field object is cut to; None where it has none."""
    # A deleted object lives on as long as something points to it.
    return own.crop if own.crop is not None and own.crop.original.users_scene else None


def crop_matrix(crop: bpy.types.Object) -> Matrix:
    """From the cube [−1, 1]³ to what an empty shows as a cube."""
    return crop.matrix_world @ Matrix.Scale(crop.empty_display_size, 4)


def folder_of(own: Any) -> Path | None:
    """The project folder that a field object names, as an absolute path; None where it names none."""
    if not own.project:
        return None
    # A linked object means a folder beside its own file, which Blender may call "//../other/file.blend"; so does an override.
    obj = own.id_data.original
    linked = obj.override_library.reference if obj.override_library is not None else obj
    return absolute(own.project, linked.library)


def move(old: Path, new: Path) -> None:
    """Let the fields of a project in one folder be read from another."""
    for obj in bpy.data.objects:
        if is_local(obj) and obj.fieldwork.is_field and folder_of(obj.fieldwork) == old:
            obj.fieldwork.project = str(new)


def rows(matrix: Matrix) -> list[list[float]]:
    """A matrix as lists."""
    return [list(row) for row in matrix]


def refresh(obj: bpy.types.Object) -> bool:
    """Read classes and things of a field object anew; what the user set for them stays. False: its project cannot be read, and
    all stays as it is."""
    folder = folder_of(obj.fieldwork)
    project = snapshot.project(folder)
    if folder is None or project is None:
        return False
    fill_classes(obj, project.get("classes", []))
    things.fill(obj, folder)
    return True


def fill_classes(obj: bpy.types.Object, values: list[dict[str, Any]]) -> None:
    """Let the classes of a field object be those of its project, with what the user set of them."""
    own = obj.fieldwork
    before = {entry.id: (entry.visible, entry.opacity, entry.tint, tuple(entry.color)) for entry in own.classes}
    own.classes.clear()
    for value in values:
        entry = own.classes.add()
        entry.id, entry.name, entry.color = value["id"], value["name"], value["color"]
        if value["id"] in before:
            entry.visible, entry.opacity, entry.tint, entry.color = before[value["id"]]
