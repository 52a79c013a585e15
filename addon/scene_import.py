"""Builds a package (see package.py) in a scene, or brings what an earlier import built up to date.

Everything hangs under one empty. What was built is recognised by custom properties, not by names, so that objects may
be renamed; transforms given to the parent are kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import bpy
import numpy as np
from mathutils import Matrix

from .label_material import COLOR_ATTRIBUTE, SWITCH, make_group, make_material
from .package import SENSOR_MM, Package, blender_camera
from .point_cloud import show_points

ROLE, PROJECT = "fieldwork_role", "fieldwork_project"
SIZE = "fieldwork_size"  # photo size in pixels, on camera objects
CLASS_ATTRIBUTE, VERTEX_CLASS_ATTRIBUTE = "class_id", "vertex_class_id"
VOID_COLOR = [0.15, 0.15, 0.15]
Cameras = Literal["many", "animated", "both"]


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
    place = _Place(scene, package.name)
    root = place.object("root", f"Fieldwork · {package.name}", None)
    root.empty_display_size = 0.2
    if SWITCH not in root:
        root[SWITCH] = 0.0
        root.id_properties_ui(SWITCH).update(min=0.0, max=1.0, description="0: colours of the photos, 1: class colours")
    result = Imported(root)
    if cameras in {"many", "both"}:
        size = _camera_size(package)
        for index, entry in enumerate(package.cameras):
            progress(0.6 * index / len(package.cameras), entry["name"])
            result.cameras.append(_camera(place, entry, package, root, size))
    if cameras in {"animated", "both"} and package.cameras:
        result.animated = _animated_camera(place, package, root)
    progress(0.7, "points")
    if len(package.xyz):
        result.points = _points(place, package, root)
    progress(0.8, "mesh")
    if package.mesh is not None:
        result.meshes = _meshes(place, package, root, split)
    place.remove_unused()
    if package.cameras:
        _frame_scene(scene, package, result)
    return result


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
    return item


def _animated_camera(place: _Place, package: Package, root: bpy.types.Object) -> bpy.types.Object:
    """One camera that stands at the n-th photo's place in frame n."""
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
        _set_lens(data, entry)
        position, rotation, _ = Matrix(entry["camera_to_world"]).decompose()
        if before is not None:
            rotation.make_compatible(before)
        item.location, item.rotation_quaternion, before = position, rotation, rotation
        item.keyframe_insert("location", frame=frame)
        item.keyframe_insert("rotation_quaternion", frame=frame)
        for path in ("lens", "shift_x", "shift_y"):
            data.keyframe_insert(path, frame=frame)
    data.clip_start, data.clip_end = 0.01, 1000.0
    return item


def _mesh_of(found: bpy.types.Object | None, name: str) -> bpy.types.Mesh:
    """The mesh to fill: that of the object an earlier import made, emptied, or a new one."""
    if found is None:
        return bpy.data.meshes.new(name)
    found.data.clear_geometry()
    return found.data


def _points(place: _Place, package: Package, root: bpy.types.Object) -> bpy.types.Object:
    # Vertices with a colour attribute work in every version, in every exporter, and stay in the file.
    mesh = _mesh_of(place.existing("points"), "Sparse points")
    mesh.vertices.add(len(package.xyz))
    mesh.vertices.foreach_set("co", package.xyz.astype(np.float32).ravel())
    set_colors(mesh, package.rgb)
    mesh.update()
    item = place.object("points", "Sparse points", mesh, root)
    item.matrix_parent_inverse = item.matrix_basis = Matrix.Identity(4)
    item.hide_render = True
    centers = np.array([np.array(camera["camera_to_world"])[:3, 3] for camera in package.cameras]).reshape(-1, 3)
    group = make_group(f"Fieldwork · {package.name} · points", root)
    material = make_material(f"{package.name} · points", [0.8, 0.8, 0.8], group)
    show_points(item, float(np.ptp(centers, axis=0).max(initial=0.0)) / 600 or 0.005, material)
    return item


def set_colors(mesh: bpy.types.Mesh, rgb: np.ndarray) -> None:
    """Write vertex colours (V, 3) uint8 sRGB into the mesh's colour attribute."""
    attribute = mesh.color_attributes.new(COLOR_ATTRIBUTE, "BYTE_COLOR", "POINT")
    rgba = np.ones((len(rgb), 4), np.float32)
    rgba[:, :3] = rgb.astype(np.float32) / 255
    attribute.data.foreach_set("color_srgb", rgba.ravel())
    mesh.color_attributes.active_color = attribute
    mesh.color_attributes.render_color_index = mesh.color_attributes.find(COLOR_ATTRIBUTE)


def _meshes(place: _Place, package: Package, root: bpy.types.Object, split: bool) -> list[bpy.types.Object]:
    """The surface as one object, or as one for each class that occurs."""
    arrays = package.mesh
    assert arrays is not None
    texture = None
    if package.texture is not None:
        texture = bpy.data.images.load(str(package.texture), check_existing=True)
        texture.reload()
    group = make_group(f"Fieldwork · {package.name}", root, texture)
    if not split:
        return [_mesh(place, package, root, "mesh", "Surface", arrays, group)]
    names = {entry["id"]: entry["name"] for entry in package.classes}
    made = []
    for number in np.unique(arrays["face_class"]).tolist():
        name = names.get(number, "void" if number == package.ignore_id else f"class {number}")
        part = part_of(arrays, arrays["face_class"] == number)
        made.append(_mesh(place, package, root, f"class:{number}", f"Surface · {name}", part, group))
    return made


def part_of(arrays: dict[str, np.ndarray], chosen: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays of a mesh (see `Package.mesh`) for a mask (F,) of its faces, with the vertices these use."""
    used, corners = np.unique(arrays["faces"][chosen], return_inverse=True)
    per_face = {name: arrays[name][chosen] for name in ("face_class", "uv") if name in arrays}
    per_vertex = {name: arrays[name][used] for name in ("vertices", "colors", "class_id")}
    return {"faces": corners.reshape(-1, 3).astype(np.int32), **per_face, **per_vertex}


def _mesh(
    place: _Place,
    package: Package,
    root: bpy.types.Object,
    role: str,
    name: str,
    arrays: dict[str, np.ndarray],
    group: bpy.types.NodeTree,
) -> bpy.types.Object:
    mesh = _mesh_of(place.existing(role), name)
    fill_triangles(mesh, arrays["vertices"], arrays["faces"])
    set_colors(mesh, arrays["colors"])
    for attribute, domain, values in (
        (CLASS_ATTRIBUTE, "FACE", arrays["face_class"]),
        (VERTEX_CLASS_ATTRIBUTE, "POINT", arrays["class_id"]),
    ):
        mesh.attributes.new(attribute, "INT", domain).data.foreach_set("value", values.astype(np.int32))
    if "uv" in arrays:
        layer = mesh.uv_layers.new(name="UVMap")
        layer.data.foreach_set("uv", np.ascontiguousarray(arrays["uv"], np.float32).ravel())
    classes = [{"id": package.ignore_id, "name": "void", "color": VOID_COLOR}, *package.classes]
    slots: dict[int, int] = {}
    mesh.materials.clear()
    for entry in classes:
        slots.setdefault(entry["id"], len(mesh.materials))
        mesh.materials.append(make_material(f"{package.name} · {entry['name']}", entry["color"], group))
    slot_of = np.zeros(max(int(arrays["face_class"].max(initial=0)), *slots) + 1, np.int32)
    for number, slot in slots.items():
        slot_of[number] = slot
    mesh.polygons.foreach_set("material_index", slot_of[np.maximum(arrays["face_class"], 0)])
    mesh.update()
    item = place.object(role, name, mesh, root)
    item.matrix_parent_inverse = item.matrix_basis = Matrix.Identity(4)
    return item


def fill_triangles(mesh: bpy.types.Mesh, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Fill an empty mesh with vertices (V, 3) and smooth triangles (F, 3)."""
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", np.ascontiguousarray(vertices, np.float32).ravel())
    mesh.loops.add(3 * len(faces))
    mesh.loops.foreach_set("vertex_index", np.ascontiguousarray(faces, np.int32).ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * len(faces), 3, dtype=np.int32))
    mesh.update(calc_edges=True)
    mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), bool))
