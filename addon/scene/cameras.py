"""The photos' cameras in the scene: one for each photo, and one that stands at each photo's place in turn."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ..render.slot import load_render, render_slot
from .owned import Owned, Steps
from .package import SENSOR_MM, Package, blender_camera

SIZE = "fieldwork_size"  # photo size in pixels, on camera objects


def display_size(package: Package) -> float:
    """How large the cameras are drawn: a fortieth of what they span, in metres."""
    centers = np.array([np.array(c["camera_to_world"])[:3, 3] for c in package.cameras])
    extent = float(np.linalg.norm(centers.max(0) - centers.min(0))) if len(centers) else 0.0
    return extent / 40 or 0.1


def use_size_of(scene: bpy.types.Scene, entry: dict[str, Any]) -> None:
    """Set resolution and pixel aspect so that a render through this camera has the pixels of its photo."""
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = entry["width"], entry["height"], 100
    if entry["model"] == "PINHOLE":
        render.pixel_aspect_x, render.pixel_aspect_y = blender_camera(entry).aspect


def photo_camera(
    owned: Owned, entry: dict[str, Any], package: Package, root: bpy.types.Object, size: float
) -> bpy.types.Object:
    """The camera of a photo, with the photo and what was rendered of it behind it."""
    role = f"camera:{entry['name']}"
    found = owned.existing(role)
    data = found.data if found else bpy.data.cameras.new(entry["name"])
    item = owned.object(role, entry["name"], data, root)
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


def animated_camera(owned: Owned, package: Package, root: bpy.types.Object, size: float) -> Steps:
    """One camera that stands at the n-th photo's place in frame n; returns it."""
    role = "camera path"
    found = owned.existing(role)
    data = found.data if found else bpy.data.cameras.new("Photographer")
    item = owned.object(role, "Photographer", data, root)
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
