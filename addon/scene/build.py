"""Builds a package (see package.py) in a scene, or brings what an earlier import built up to date.

Everything hangs under one empty. What was built is recognised by custom properties, not by names, so that objects may
be renamed; transforms given to the parent are kept. What the user edited stays as it is (edited.py).

The work is cut into steps of a few milliseconds, between which Blender's window can draw; what needs no Blender is done
in a thread meanwhile. A step may leave a part unfinished, but nothing that Blender could trip over.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import bpy

from ..render.slot import load_image
from ..roles import Owner
from .cameras import SIZE, animated_camera, clip_range, display_size, photo_camera, use_size_of
from .edited import CAMERA_PATH, Steps
from .frame import units_per_metre
from .look import set_switch, shader_group, viewport_group
from .materials import find_material
from .mesh_data import Part, parts, slot_classes
from .own_look import TEXTURE, remove_unused_textures
from .owned import Owned
from .package import Package, read_package, sketch_package
from .points import sparse_points
from .slices import Held
from .surface import surface

Cameras = Literal["many", "animated", "both"]
PREVIEW = "preview"  # role of the first look at the surface


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
    split: str = "none",
    progress: Callable[[float, str], None] = lambda fraction, message: None,
) -> Imported:
    """Build or update everything of a package in a scene and return it; `split`: see `parts`."""
    steps = import_steps(scene, lambda: (package, parts(package, split)), cameras)
    while True:
        try:
            progress(*next(steps))
        except StopIteration as end:
            return end.value


def load(folder: Path | str, split: str = "none") -> Callable[[], tuple[Package, list[Part]]]:
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
    place = Held(bpy.data.scenes, scene)
    package, pieces = yield from _in_thread(read)
    owned = Owned(place(), Owner(package.name, package.uuid))
    owned.classes = {entry["name"] for entry in package.classes}
    _parent(owned, package)
    owned.release_copies()
    size, clip = display_size(package), clip_range(package)
    roles: list[str] = []
    if cameras in {"many", "both"}:
        for index, entry in enumerate(package.cameras):
            yield 0.1 + 0.5 * index / len(package.cameras), entry["name"]
            photo_camera(owned, entry, package, size, clip)
    if cameras in {"animated", "both"} and package.cameras:
        yield from animated_camera(owned, package, size, clip)
    yield 0.7, "points"
    if len(package.xyz):
        yield from sparse_points(owned, package)
    yield 0.8, "mesh"
    if pieces:
        for entry in slot_classes(package):  # those of the first scenes have no mark yet
            find_material(owned.owner, entry["name"], owned.root, entry["id"] != package.ignore_id)
        yield from owned.leave_edited({part.role for part in pieces})
        texture = _texture(package)
        yield 0.8, "materials"  # the first picture of its kind takes Blender long: it gets ready to read such
        group = shader_group(owned.owner, "mesh", owned.root, texture and texture())
        remove_unused_textures()
        trees = [Held(bpy.data.node_groups, tree) for tree in (group, viewport_group(owned.owner, owned.root))]
        for part in pieces:
            yield from surface(owned, package, part, lambda: (trees[0](), trees[1]()))
            roles.append(part.role)
    yield from owned.remove_unused()
    result = _imported(owned, package, cameras, roles)
    if package.cameras:
        _frame_scene(owned.scene, package, result)
    result.warnings += [
        f"“{name}” was edited: it stays as it is, and what is new stands beside it." for name in owned.kept
    ]
    return result


def preview_steps(scene: bpy.types.Scene, owner: Owner, project: dict[str, Any], path: Path | str) -> Steps:
    """A first look at the surface (preview.npz of the exports) as an object of its own, step by step; what else belongs to
    the project stays, and the next import takes it away. Returns it.

    Args:
        project: what the project file says.

    Raises:
        PackageError: the file cannot be read.
    """
    place = Held(bpy.data.scenes, scene)

    def read() -> tuple[Package, Part]:
        package = sketch_package(Path(path), owner, project)
        return package, replace(parts(package, "none")[0], role=PREVIEW, name="Preview")

    package, part = yield from _in_thread(read)
    owned = Owned(place(), owner)
    _parent(owned, package)
    group = shader_group(owner, "mesh", owned.root)
    trees = [Held(bpy.data.node_groups, tree) for tree in (group, viewport_group(owner, owned.root))]
    return (yield from surface(owned, package, part, lambda: (trees[0](), trees[1]())))


def _parent(owned: Owned, package: Package) -> None:
    """The empty that all of the capture hangs under."""
    new = owned.existing("root") is None
    root = owned.object("root", f"Fieldwork · {package.name}", None)
    if new:
        root.empty_display_size = 0.2
        root.scale = [units_per_metre(owned.scene)] * 3
    set_switch(root)


def _imported(owned: Owned, package: Package, cameras: Cameras, roles: list[str]) -> Imported:
    """What was built, found again."""
    known = owned.known
    names = [f"camera:{entry['name']}" for entry in package.cameras] if cameras != "animated" else []
    return Imported(
        owned.root,
        [known[name] for name in names if name in known],
        known.get(CAMERA_PATH) if cameras != "many" else None,
        known.get("points"),
        [known[role] for role in roles if role in known],
    )


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


def _texture(package: Package) -> Held | None:
    if package.texture is None:
        return None
    texture = load_image(package.texture)
    texture[TEXTURE] = True
    return Held(bpy.data.images, texture)


def _frame_scene(scene: bpy.types.Scene, package: Package, result: Imported) -> None:
    """Give a scene that has no camera yet the first photo's view; warn where one setting cannot suit all cameras."""
    shapes = {(c["width"], c["height"], round(c["fx"] / c["fy"], 4)) for c in package.cameras}
    if len(shapes) > 1:
        result.warnings.append(
            "The photos differ in size or pixel shape: set the render resolution to that of a camera (its custom "
            f"property {SIZE}) before rendering through it."
        )
    if scene.camera is None:
        scene.camera = result.cameras[0] if result.cameras else result.animated
        use_size_of(scene, package.cameras[0])
