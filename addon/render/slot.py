"""The place of a rendered image among the background images of a camera."""

from __future__ import annotations

from pathlib import Path

import bpy

MARK = "fieldwork_render"


def load_render(path: Path) -> bpy.types.Image:
    """The image datablock of a rendered file; one that is loaded already is read again."""
    count = len(bpy.data.images)
    image = bpy.data.images.load(str(path), check_existing=True)
    if len(bpy.data.images) == count:
        image.reload()
    image[MARK] = True
    return image


def render_slot(camera: bpy.types.Camera) -> bpy.types.CameraBackgroundImage:
    """The background of a camera that holds a render, or a new one; the photo behind it stays."""
    slots = camera.background_images
    return next((slot for slot in slots if slot.image and MARK in slot.image), None) or slots.new()
