"""Rendered images in Blender: as image datablocks, behind the cameras they were rendered from, or on planes."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import bpy

from ..roles import ROLE, Owner
from .slot import MARK, load_render, render_slot

OTHER_PASSES = ("_depth", "_labels", "_confidence", "_normal", "_unknown")  # file names of all but the color


def show_steps(
    scene: bpy.types.Scene, files: list[Path], show_as: str, photos: bool, owner: Owner
) -> Generator[tuple[float, str], None, list[tuple[bpy.types.Object, bpy.types.Image]]]:
    """Load the rendered files, and put the colored ones where the user wants them, a step for each file.

    Args:
        files: what the engine wrote.
        show_as: "none", "background" or "plane".
        photos: whether they were rendered from the photos' cameras rather than the scene's.
        owner: the project whose cameras are meant.
    Returns:
        the cameras that got an image, with it.
    """
    images = {}
    for number, path in enumerate(files):
        yield number / len(files), path.name
        images[path] = load_render(path)
    colored = [path for path in files if path.suffix == ".png" and not path.stem.endswith(OTHER_PASSES)]
    if show_as == "none" or not colored:
        return []
    if photos:
        cameras = {
            obj[ROLE].removeprefix("camera:"): obj
            for obj in scene.objects
            if obj.type == "CAMERA" and str(obj.get(ROLE)).startswith("camera:") and owner.owns(obj)
        }
        pairs = [(cameras[path.stem], images[path]) for path in colored if path.stem in cameras]
    else:
        image = images[colored[0]]
        if len(colored) > 1:
            image.source = "SEQUENCE"
        pairs = [(scene.camera, image)] if scene.camera else []
    for camera, image in pairs:
        yield 1.0, camera.name
        if show_as == "background":
            background(scene, camera, image, len(colored))
        else:
            plane(scene, camera, image, len(colored))
    return pairs


def background(scene: bpy.types.Scene, camera: bpy.types.Object, image: bpy.types.Image, frames: int) -> None:
    """Put the image over the camera's view, in place of an earlier one; photos behind it stay."""
    slot = render_slot(camera.data)
    slot.image, slot.alpha, slot.display_depth, slot.frame_method = image, 1.0, "FRONT", "STRETCH"
    _play(scene, slot.image_user, image, frames)
    camera.data.show_background_images = True


def plane(scene: bpy.types.Scene, camera: bpy.types.Object, image: bpy.types.Image, frames: int) -> None:
    """An image that fills the camera's view at the distance at which the camera itself is drawn; one for a camera."""
    empty = next((child for child in camera.children if MARK in child), None)
    if empty is None:
        empty = bpy.data.objects.new(f"Render · {camera.name}", None)
        empty[MARK] = True
        scene.collection.objects.link(empty)
        empty.parent = camera
    empty.empty_display_type, empty.data = "IMAGE", image
    _play(scene, empty.image_user, image, frames)
    corners = camera.data.view_frame(scene=scene)
    depth = -corners[0].z
    # An image empty's longer side has the display size.
    size = max(abs(corners[0].x - corners[2].x), abs(corners[0].y - corners[2].y))
    middle = (corners[0] + corners[2]) / 2
    distance = max(camera.data.display_size, 2 * camera.data.clip_start)
    empty.empty_display_size = size / depth * distance
    empty.location = (middle.x / depth * distance, middle.y / depth * distance, -distance)
    empty.rotation_euler = (0.0, 0.0, 0.0)


def _play(scene: bpy.types.Scene, user: bpy.types.ImageUser, image: bpy.types.Image, frames: int) -> None:
    if image.source == "SEQUENCE":
        user.frame_start, user.frame_duration = scene.frame_start, frames
        user.frame_offset = scene.frame_start - 1
        user.use_auto_refresh = True
