"""The fields that a scene shows: those of its field objects, or without any that of its project."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import bpy
from mathutils import Matrix, Vector

from ..errors import SceneError
from ..paths import absolute
from ..project import snapshot
from ..roles import is_local
from ..scene.frame import scene_from_capture
from ..text import t
from . import index, things


def field_objects(objects: Iterable[bpy.types.Object]) -> list[bpy.types.Object]:
    """Those of the objects that are fields."""
    return [obj for obj in objects if obj.type == "EMPTY" and obj.fieldwork.is_field]


class Part(NamedTuple):
    """What is shown: a field, or a copy of a thing of it; `instancers`: the empties, the outermost first, by whose instances of
    collections it is there, none where it is in the scene itself."""

    field: bpy.types.Object
    copy: bpy.types.Object | None
    instancers: tuple[bpy.types.Object, ...] = ()

    @property
    def object(self) -> bpy.types.Object:
        """That says where it is."""
        return self.copy or self.field

    @property
    def of_scene(self) -> bpy.types.Object:
        """That is in the scene itself."""
        return (*self.instancers, self.object)[0]

    @property
    def name(self) -> str:
        """One that no other part has: that of the scene's object, and below it those of what is in its instance."""
        return "\n".join(obj.name_full for obj in (*self.instancers, self.object))

    def carried(self, depsgraph: bpy.types.Depsgraph | None = None) -> Matrix:
        """The matrix that carries what is in its collection to the scene."""
        matrix = Matrix.Identity(4)
        for empty in self.instancers:
            placed = empty.evaluated_get(depsgraph) if depsgraph is not None else empty
            offset = placed.instance_collection.instance_offset
            matrix = matrix @ placed.matrix_world @ Matrix.Translation(-Vector(offset))
        return matrix


Inside = dict[bpy.types.Collection, list[Part]]
Is = Callable[[Any], bool]


def parts(found: index.Index, is_shown: Is, is_hidden: Is) -> list[Part]:
    """The fields and the copies of things of the file that are shown, also those in collections of which objects are instances;
    copies are shown wherever their field is, hidden or in no instance too.

    Args:
        is_shown: of the objects of the index. is_hidden: whether an object or a collection that is in an instance is shown by
            none.
    """
    return _parts([obj for obj in found.objects if is_shown(obj)], found, is_hidden, {})


def _parts(objects: Iterable[bpy.types.Object], found: index.Index, is_hidden: Is, known: Inside) -> list[Part]:
    """Those of some objects that are shown. known: of collections that were looked into."""
    shown: list[Part] = []
    for obj in objects:
        if obj.fieldwork.is_field:
            shown.append(Part(obj, None))
        field = things.field_of(obj)
        if field is not None and field in found.placed:
            shown.append(Part(field, obj))
        collection = obj.instance_collection if obj.instance_type == "COLLECTION" else None
        if collection is None:
            continue
        if collection not in known:
            known[collection] = []  # one that holds an instance of itself shows nothing more by it
            known[collection] = _parts(index.inside(collection, found.held, is_hidden), found, is_hidden, known)
        shown += [part._replace(instancers=(obj, *part.instancers)) for part in known[collection]]
    return shown


def seen_parts(layer: bpy.types.ViewLayer, space: bpy.types.SpaceView3D) -> list[Part]:
    """Those that a 3D viewport shows."""
    return parts(
        index.current(),
        lambda obj: obj.visible_get(view_layer=layer, viewport=space),
        lambda item: item.hide_viewport,
    )


def all_parts(scene: bpy.types.Scene) -> list[Part]:
    """Those of a scene, shown or not."""
    found = index.current()
    return parts(found, found.in_scene(scene).__contains__, lambda _: False)


def rendered_parts(depsgraph: bpy.types.Depsgraph) -> list[Part]:
    """Those that a render shows in the frame of the depsgraph."""
    rendered = in_rendered_collections(depsgraph.view_layer.layer_collection)

    def is_hidden(item: bpy.types.Object | bpy.types.Collection) -> bool:
        return item.evaluated_get(depsgraph).hide_render

    return parts(index.current(), lambda obj: obj.name_full in rendered and not is_hidden(obj), is_hidden)


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
    known = all_parts(scene)
    if not known:
        return [project_item(depsgraph.scene_eval, baked)]
    items = [_rendered_item(part, baked, depsgraph) for part in rendered_parts(depsgraph)]
    others = {obj for other in scene.view_layers if other.use and other != layer for obj in other.objects}
    elsewhere = any(part.of_scene in others for part in known)
    animated = any(obj.animation_data for part in known for obj in (part.field, *part.instancers))
    if not items and not elsewhere and not animated:
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
    return item | poses_of_part(part, depsgraph)


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


def poses_of_part(part: Part, depsgraph: bpy.types.Depsgraph | None = None) -> dict[str, Any]:
    """Where what is shown is in the scene, and its crop box, as they are or in a depsgraph."""
    field = part.field.evaluated_get(depsgraph) if depsgraph is not None else part.field
    carried = part.carried(depsgraph)
    return {name: rows(carried @ Matrix(pose)) for name, pose in poses_of(field, depsgraph, part.copy).items()}


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
    if own.crop is None:
        return None
    return own.crop if own.crop.original in index.current().placed else None


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
