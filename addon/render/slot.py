"""Image files in Blender, and the place of a rendered image among the background images of a camera."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..paths import absolute

MARK = "fieldwork_render"
BYTES, MODIFIED = "fieldwork_bytes", "fieldwork_modified"  # of the file, as the image was read from it


def load_image(path: Path) -> bpy.types.Image:
    """The image datablock of a file, as the file is now.

    One the user painted on stays for him, and a new one comes beside it.
    """
    count, file = len(bpy.data.images), path.stat()
    image = bpy.data.images.load(str(path), check_existing=True)
    if len(bpy.data.images) == count:
        if painted(image):
            image.use_fake_user = True
            others = (other for other in bpy.data.images if is_of(other, path) and not painted(other))
            image = next(others, None) or bpy.data.images.load(str(path), check_existing=False)
        # A large texture holds the window up while it is given up.
        if (image.get(BYTES), image.get(MODIFIED)) != (file.st_size, file.st_mtime):
            image.reload()
    image[BYTES], image[MODIFIED] = file.st_size, file.st_mtime
    return image


def painted(image: bpy.types.Image) -> bool:
    """Whether an image is not what its file held: it was painted on, and perhaps packed into the .blend since."""
    if image.is_dirty:
        return True
    return image.packed_file is not None and image.packed_file.size != image.get(BYTES, image.packed_file.size)


def is_of(image: bpy.types.Image | None, path: Path) -> bool:
    """Whether an image was read from this file; its own path may be relative to the .blend."""
    if image is None or image.library is not None or not image.filepath:
        return False
    return absolute(image.filepath) == absolute(str(path))


def load_render(path: Path) -> bpy.types.Image:
    """The image datablock of a rendered file."""
    image = load_image(path)
    image[MARK] = True
    return image


def render_slot(camera: bpy.types.Camera) -> bpy.types.CameraBackgroundImage:
    """The background of a camera that holds a render, or a new one; others stay."""
    slots = camera.background_images
    return next((slot for slot in slots if slot.image and MARK in slot.image), None) or slots.new()
