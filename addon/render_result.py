"""Rendered images in Blender: as image datablocks, behind cameras, or on planes."""

from __future__ import annotations

from pathlib import Path

import bpy

SUFFIXES = (".png", ".jpg", ".exr")


def load_images(folder: Path) -> list[bpy.types.Image]:
    """Image datablocks of all pictures of a folder; those that are loaded already are read again."""
    images = []
    for path in sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES):
        image = bpy.data.images.load(str(path), check_existing=True)
        image.reload()
        image["fieldwork_render"] = str(folder)
        images.append(image)
    return images


def show(scene: bpy.types.Scene, folder: Path, show_as: str) -> list[bpy.types.Image]:
    """Load the images of a render and show the colored ones as the user chose."""
    images = load_images(folder)
    camera = scene.camera
    if not images or camera is None or show_as == "none":
        return images
    picture = next((image for image in images if "rgb" in Path(image.filepath).stem), images[0])
    if show_as == "background":
        background(camera, picture)
    elif show_as == "plane":
        plane(scene, camera, picture)
    return images


def background(camera: bpy.types.Object, image: bpy.types.Image) -> None:
    """Put the image in front of the camera's view, in place of an earlier one."""
    slots = camera.data.background_images
    slot = next((s for s in slots if s.image and "fieldwork_render" in s.image), None) or slots.new()
    slot.image, slot.alpha, slot.display_depth = image, 1.0, "FRONT"
    camera.data.show_background_images = True


def plane(scene: bpy.types.Scene, camera: bpy.types.Object, image: bpy.types.Image, distance: float = 1.0) -> None:
    """An image empty that fills the camera's view at a distance in metres; an earlier one is moved."""
    name = f"Fieldwork {Path(image.filepath).stem}"
    empty = bpy.data.objects.get(name) or bpy.data.objects.new(name, None)
    if empty.name not in scene.objects:
        scene.collection.objects.link(empty)
    empty.empty_display_type = "IMAGE"
    empty.data = image
    corners = camera.data.view_frame(scene=scene)
    width = abs(corners[0].x - corners[2].x) * distance / -corners[0].z
    height = abs(corners[0].y - corners[2].y) * distance / -corners[0].z
    # An image empty's longer side has the display size.
    empty.empty_display_size = max(width, height)
    empty.parent = camera
    empty.location = (0.0, 0.0, -distance)
    empty.rotation_euler = (0.0, 0.0, 0.0)
