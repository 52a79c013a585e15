"""The photos' cameras in the scene: one for each photo, and one that stands at each photo's place in turn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ..render.slot import is_of, load_image, load_render, render_slot
from .edited import CAMERA_PATH, WRITTEN, Steps, camera_edited, camera_fingerprint, keys_fingerprint, write_once
from .frame import units_per_metre
from .owned import Owned
from .package import SENSOR_MM, Package, blender_camera

SIZE = "fieldwork_size"  # photo size in pixels, on camera objects
ASPECT = "fieldwork_aspect"  # width and height of the photo's pixels, on camera objects
PHOTO = "fieldwork_photo"  # marks the images that are photos
NEAR, FAR = 0.01, 1000.0  # metres that cameras show at least


def display_size(package: Package) -> float:
    """How large the cameras are drawn: a fortieth of what they span, in metres."""
    return _diagonal(_centers(package)) / 40 or 0.1


def clip_range(package: Package) -> tuple[float, float]:
    """From where to where cameras show something, in metres: all of the capture, however small or large it is."""
    surface = package.mesh["vertices"] if package.mesh is not None else np.zeros((0, 3))
    places = np.concatenate([_centers(package), package.xyz, surface])
    some = places[:: max(1, len(places) // 10_000)]
    size = _diagonal(np.percentile(some, (10, 90), axis=0)) if len(some) else 0.0  # without points far off
    return min(NEAR, size / 100 or NEAR), max(FAR, 2 * _diagonal(places))


def _centers(package: Package) -> np.ndarray:
    return np.array([np.array(c["camera_to_world"])[:3, 3] for c in package.cameras]).reshape(-1, 3)


def _diagonal(places: np.ndarray) -> float:
    """Diagonal of the box around places (N, 3); 0 where there are none."""
    return float(np.linalg.norm(np.ptp(places, axis=0))) if len(places) else 0.0


def use_size_of(scene: bpy.types.Scene, entry: dict[str, Any]) -> None:
    """Set resolution and pixel aspect so that a render through this camera has the pixels of its photo."""
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = entry["width"], entry["height"], 100
    render.pixel_aspect_x, render.pixel_aspect_y = pixel_aspect(entry)


def pixel_aspect(entry: dict[str, Any]) -> tuple[float, float]:
    """Width and height of a photo's pixels, as Blender's render settings have them."""
    return blender_camera(entry).aspect if entry["model"] == "PINHOLE" else (1.0, 1.0)


def photo_camera(
    owned: Owned, entry: dict[str, Any], package: Package, size: float, clip: tuple[float, float]
) -> bpy.types.Object:
    """The camera of a photo, with the photo and what was rendered of it behind it; beside one that the user moved.
    `size`, `clip`: see `display_size`, `clip_range`."""
    role = f"camera:{entry['name']}"
    item = _camera(owned, role, entry["name"], size, clip)
    data = item.data
    _set_lens(data, entry)
    item.matrix_parent_inverse = Matrix.Identity(4)
    item.matrix_basis = Matrix(entry["camera_to_world"])
    item[WRITTEN] = camera_fingerprint(item)
    item[SIZE] = [entry["width"], entry["height"]]
    item[ASPECT] = pixel_aspect(entry)
    _show_photo(data, package.folder / entry["image"])
    if entry.get("render"):
        slot = render_slot(data)
        new = slot.image is None
        slot.image = load_render(package.folder / entry["render"])
        if new:
            slot.frame_method, slot.display_depth, slot.alpha = "STRETCH", "BACK", 1.0
    return item


def _camera(owned: Owned, role: str, name: str, size: float, clip: tuple[float, float]) -> bpy.types.Object:
    """The camera of a role, if need be a new one, drawn in this size, that shows what is in this range."""
    found = owned.existing(role)
    if found is not None and camera_edited(found):
        owned.leave(role)
        found = None
    data = found.data if found else bpy.data.cameras.new(name)
    write_once(data, "display_size", size)
    # Unlike places and sizes these do not follow the scale of the parent.
    metre = units_per_metre(owned.scene)
    for end, distance in zip(("clip_start", "clip_end"), clip):
        if found is None or f"fieldwork_{end}" in data:  # of earlier versions nobody knows who chose it
            write_once(data, end, distance * metre)
    return owned.object(role, name, data)


def _show_photo(data: bpy.types.Camera, path: Path) -> None:
    """Put the photo behind its camera; backgrounds of the user's own stay."""
    slots = data.background_images
    slot = next((slot for slot in slots if slot.image and (PHOTO in slot.image or is_of(slot.image, path))), None)
    if slot is None:
        slot = slots.new()
        slot.frame_method, slot.display_depth, slot.alpha = "STRETCH", "BACK", 1.0
        data.show_background_images = True
    slot.image = load_image(path)
    slot.image[PHOTO] = True


def animated_camera(owned: Owned, package: Package, size: float, clip: tuple[float, float]) -> Steps:
    """One camera that stands at the n-th photo's place in frame n; beside one whose keys the user changed. Returns it."""
    item = _camera(owned, CAMERA_PATH, "Photographer", size, clip)
    item.animation_data_clear()
    item.data.animation_data_clear()
    item.rotation_mode = "QUATERNION"
    item.matrix_parent_inverse = Matrix.Identity(4)
    if WRITTEN in item:
        del item[WRITTEN]  # until all keys are there
    before = None
    for frame, entry in enumerate(package.cameras, 1):
        yield 0.6 + 0.1 * frame / len(package.cameras), entry["name"]
        item = owned.object(CAMERA_PATH, "Photographer", None)
        _set_lens(item.data, entry)
        position, rotation, _ = Matrix(entry["camera_to_world"]).decompose()
        if before is not None:
            rotation.make_compatible(before)
        item.location, item.rotation_quaternion, before = position, rotation, rotation
        item.keyframe_insert("location", frame=frame)
        item.keyframe_insert("rotation_quaternion", frame=frame)
        for path in ("lens", "shift_x", "shift_y"):
            item.data.keyframe_insert(path, frame=frame)
    item[WRITTEN] = keys_fingerprint(item)
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
