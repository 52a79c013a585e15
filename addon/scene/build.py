"""Builds a package (see package.py) in a scene, or brings what an earlier import built up to date.

Everything hangs under one empty. What was built is recognised by custom properties, not by names, so that objects may
be renamed; transforms given to the parent are kept.

The work is cut into steps of a few milliseconds, between which Blender's window can draw; what needs no Blender is done
in a thread meanwhile. A step may leave a part unfinished, but nothing that Blender could trip over.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ..render.slot import load_render, render_slot
from ..roles import PROJECT, ROLE
from .frame import units_per_metre
from .materials import SWITCH, make_group, make_material
from .mesh_data import Part, parts, rgba, slot_classes
from .package import SENSOR_MM, Package, blender_camera, read_package
from .points import show_points
from .surface import fill_points, fill_surface

SIZE = "fieldwork_size"  # photo size in pixels, on camera objects
Cameras = Literal["many", "animated", "both"]
Steps = Generator[tuple[float, str], None, Any]  # yields the share that is done and what is next


@dataclass
class Imported:
    """What is in the scene now. `warnings` are sentences for the user; `meshes` is empty when the package
    has none."""

    root: bpy.types.Object
    cameras: list[bpy.types.Object] = field(default_factory=list)
    animated: bpy.types.Object | None = None
    points: bpy.types.Object | None = None
    meshes: list[bpy.types.Object] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def mesh(self) -> bpy.types.Object | None:
        return self.meshes[0] if self.meshes else None

    def objects(self) -> list[bpy.types.Object]:
        single = [item for item in (self.animated, self.points) if item is not None]
        return [self.root, *self.cameras, *single, *self.meshes]


def import_package(
    scene: bpy.types.Scene,
    package: Package,
    cameras: Cameras = "both",
    split: bool = False,
    progress: Callable[[float, str], None] = lambda fraction, message: None,
) -> Imported:
    """Build or update everything of a package in a scene and return it; `split`: one mesh object for each class."""
    steps = import_steps(scene, lambda: (package, parts(package, split)), cameras)
    while True:
        try:
            progress(*next(steps))
        except StopIteration as end:
            return end.value


def load(folder: Path | str, split: bool = False) -> Callable[[], tuple[Package, list[Part]]]:
    """For `import_steps`: reads a package and prepares its surface."""

    def read() -> tuple[Package, list[Part]]:
        package = read_package(folder)
        return package, parts(package, split)

    return read


def import_steps(
    scene: bpy.types.Scene, read: Callable[[], tuple[Package, list[Part]]], cameras: Cameras = "both"
) -> Steps:
    """`import_package` step by step; `read` is called in a thread. Returns Imported.

    Raises:
        PackageError: the package cannot be read.
    """
    package, surface = yield from _in_thread(read)
    place = _Place(scene, package.name)
    root = place.object("root", f"Fieldwork · {package.name}", None)
    root.empty_display_size = 0.2
    if root.scale == Vector((1.0, 1.0, 1.0)):
        root.scale = [units_per_metre(scene)] * 3
    if SWITCH not in root:
        root[SWITCH] = 0.0
        root.id_properties_ui(SWITCH).update(min=0.0, max=1.0, description="0: colours of the photos, 1: class colours")
    result = Imported(root)
    size = _camera_size(package)
    if cameras in {"many", "both"}:
        for index, entry in enumerate(package.cameras):
            yield 0.1 + 0.5 * index / len(package.cameras), entry["name"]
            result.cameras.append(_camera(place, entry, package, root, size))
    if cameras in {"animated", "both"} and package.cameras:
        result.animated = yield from _animated_camera(place, package, root, size)
    yield 0.7, "points"
    if len(package.xyz):
        result.points = _points(place, package, root)
    yield 0.8, "mesh"
    if surface:
        group = make_group(f"Fieldwork · {package.name}", root, _texture(package))
        for part in surface:
            result.meshes.append((yield from _surface(place, package, root, part, group)))
    place.remove_unused()
    if package.cameras:
        _frame_scene(scene, package, result)
    return result


def _in_thread(function: Callable[[], Any]) -> Steps:
    """Call a function that does not touch Blender in a thread; returns its value, raises what it raises."""
    values: list[Any] = []
    errors: list[Exception] = []

    def call() -> None:
        try:
            values.append(function())
        except Exception as error:  # noqa: BLE001 - raised again below, on the thread that asked
            errors.append(error)

    thread = threading.Thread(target=call, name="fieldwork-read", daemon=True)
    thread.start()
    while thread.is_alive():
        yield 0.0, "reading"
        thread.join(0.01)
    if errors:
        raise errors[0]
    return values[0]


def _texture(package: Package) -> bpy.types.Image | None:
    if package.texture is None:
        return None
    texture = bpy.data.images.load(str(package.texture), check_existing=True)
    texture.reload()
    return texture


def _frame_scene(scene: bpy.types.Scene, package: Package, result: Imported) -> None:
    """Give a scene that has no camera yet the first photo's view; warn where one setting cannot suit all cameras."""
    shapes = {(c["width"], c["height"], round(c["fx"] / c["fy"], 4)) for c in package.cameras}
    if len(shapes) > 1:
        result.warnings.append(
            "The photos differ in size or pixel shape: set the render resolution to that of a camera (its custom "
            f"property {SIZE}) before rendering through it."
        )
    own = {item.name for item in result.objects()}
    if scene.camera is None or scene.camera.name in own:
        scene.camera = result.cameras[0] if result.cameras else result.animated
        use_size_of(scene, package.cameras[0])


def use_size_of(scene: bpy.types.Scene, entry: dict[str, Any]) -> None:
    """Set resolution and pixel aspect so that a render through this camera has the pixels of its photo."""
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = entry["width"], entry["height"], 100
    if entry["model"] == "PINHOLE":
        render.pixel_aspect_x, render.pixel_aspect_y = blender_camera(entry).aspect


class _Place:
    """Finds what an earlier import made for this project, by role, and makes what is missing."""

    def __init__(self, scene: bpy.types.Scene, project: str) -> None:
        self.project = project
        self.collection = self._collection(scene.collection, f"Fieldwork · {project}", "all")
        self.camera_collection = self._collection(self.collection, f"Cameras · {project}", "cameras")
        self.known = {o[ROLE]: o for o in self.collection.all_objects if o.get(PROJECT) == project and ROLE in o}
        self.used: set[str] = set()

    def _collection(self, parent: bpy.types.Collection, name: str, role: str) -> bpy.types.Collection:
        for child in parent.children:
            if child.get(PROJECT) == self.project and child.get(ROLE) == role:
                return child
        made = bpy.data.collections.new(name)
        made[PROJECT], made[ROLE] = self.project, role
        parent.children.link(made)
        return made

    def object(self, role: str, name: str, data: Any, parent: bpy.types.Object | None = None) -> bpy.types.Object:
        """The object of a role, with `data` if it is new."""
        self.used.add(role)
        item = self.known.get(role)
        if item is None:
            item = bpy.data.objects.new(name, data)
            item[PROJECT], item[ROLE] = self.project, role
            (self.camera_collection if role.startswith("camera") else self.collection).objects.link(item)
            item.parent = parent
        return item

    def existing(self, role: str) -> bpy.types.Object | None:
        return self.known.get(role)

    def remove_unused(self) -> None:
        """Take away what the package no longer has."""
        for role, item in self.known.items():
            if role not in self.used:
                bpy.data.objects.remove(item)


def _camera_size(package: Package) -> float:
    """Display size of the cameras: a fortieth of what they span, in metres."""
    centers = np.array([np.array(c["camera_to_world"])[:3, 3] for c in package.cameras])
    extent = float(np.linalg.norm(centers.max(0) - centers.min(0))) if len(centers) else 0.0
    return extent / 40 or 0.1


def _set_lens(data: bpy.types.Camera, entry: dict[str, Any]) -> None:
    data.sensor_fit, data.sensor_width = "HORIZONTAL", SENSOR_MM
    if entry["model"] == "EQUIRECTANGULAR":
        data.type = "PANO"
        owner = data if hasattr(data, "panorama_type") else data.cycles  # Blender 5 moved it out of Cycles
        owner.panorama_type = "EQUIRECTANGULAR"
        return
    lens = blender_camera(entry)
    data.type = "PERSP"
    data.lens, data.shift_x, data.shift_y = lens.lens, lens.shift_x, lens.shift_y


def _camera(
    place: _Place, entry: dict[str, Any], package: Package, root: bpy.types.Object, size: float
) -> bpy.types.Object:
    role = f"camera:{entry['name']}"
    found = place.existing(role)
    data = found.data if found else bpy.data.cameras.new(entry["name"])
    item = place.object(role, entry["name"], data, root)
    _set_lens(data, entry)
    data.display_size, data.clip_start, data.clip_end = size, 0.01, 1000.0
    item.matrix_parent_inverse = Matrix.Identity(4)
    item.matrix_basis = Matrix(entry["camera_to_world"])
    item[SIZE] = [entry["width"], entry["height"]]
    path = str(package.folder / entry["image"])
    background = data.background_images[0] if data.background_images else data.background_images.new()
    if background.image is None or background.image.filepath != path:
        background.image = bpy.data.images.load(path, check_existing=True)
    else:
        background.image.reload()
    background.frame_method, background.display_depth, background.alpha = "STRETCH", "BACK", 1.0
    data.show_background_images = True
    if entry.get("render"):
        slot = render_slot(data)
        slot.image, slot.frame_method = load_render(package.folder / entry["render"]), "STRETCH"
        slot.display_depth, slot.alpha = "BACK", 1.0
    return item


def _animated_camera(place: _Place, package: Package, root: bpy.types.Object, size: float) -> Steps:
    """One camera that stands at the n-th photo's place in frame n; returns it."""
    role = "camera path"
    found = place.existing(role)
    data = found.data if found else bpy.data.cameras.new("Photographer")
    item = place.object(role, "Photographer", data, root)
    item.animation_data_clear()
    data.animation_data_clear()
    item.rotation_mode = "QUATERNION"
    item.matrix_parent_inverse = Matrix.Identity(4)
    before = None
    for frame, entry in enumerate(package.cameras, 1):
        yield 0.6 + 0.1 * frame / len(package.cameras), entry["name"]
        _set_lens(data, entry)
        position, rotation, _ = Matrix(entry["camera_to_world"]).decompose()
        if before is not None:
            rotation.make_compatible(before)
        item.location, item.rotation_quaternion, before = position, rotation, rotation
        item.keyframe_insert("location", frame=frame)
        item.keyframe_insert("rotation_quaternion", frame=frame)
        for path in ("lens", "shift_x", "shift_y"):
            data.keyframe_insert(path, frame=frame)
    data.display_size, data.clip_start, data.clip_end = size, 0.01, 1000.0
    return item


def _points(place: _Place, package: Package, root: bpy.types.Object) -> bpy.types.Object:
    # Vertices with a colour attribute work in every version, in every exporter, and stay in the file.
    mesh = bpy.data.meshes.new("Sparse points")
    fill_points(mesh, package.xyz, rgba(package.rgb))
    item = _with_mesh(place, "points", "Sparse points", mesh, root)
    centers = np.array([np.array(c["camera_to_world"])[:3, 3] for c in package.cameras]).reshape(-1, 3)
    group = make_group(f"Fieldwork · {package.name} · points", root)
    material = make_material(f"{package.name} · points", [0.8, 0.8, 0.8], group)
    show_points(item, float(np.ptp(centers, axis=0).max(initial=0.0)) / 600 or 0.005, material)
    return item


def _surface(place: _Place, package: Package, root: bpy.types.Object, part: Part, group: Any) -> Steps:
    """One object of the surface; returns it."""
    mesh = bpy.data.meshes.new(part.name)
    for _ in fill_surface(mesh, part.data):
        yield 0.9, "mesh"
    for entry in slot_classes(package):
        material = make_material(f"{package.name} · {entry['name']}", entry["color"], group)
        mesh.materials.append(material)
    item = _with_mesh(place, part.role, part.name, mesh, root)
    item.matrix_parent_inverse = item.matrix_basis = Matrix.Identity(4)
    return item


def _with_mesh(place: _Place, role: str, name: str, mesh: bpy.types.Mesh, parent: bpy.types.Object) -> bpy.types.Object:
    """The object of a role with this mesh, in place of the one an earlier import made, wherever that is used."""
    item = place.existing(role)
    if item is None:
        return place.object(role, name, mesh, parent)
    place.object(role, name, mesh)
    before, kept = item.data, item.data.name
    before.user_remap(mesh)
    bpy.data.meshes.remove(before)
    mesh.name = kept
    return item
