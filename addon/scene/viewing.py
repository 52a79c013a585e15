"""What the user looks at: a camera in the viewport, a picture in an image editor."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

from ..roles import ROLE, Owner


def photo_camera_of(scene: bpy.types.Scene, owner: Owner, photo: str) -> bpy.types.Object | None:
    """The camera of a photo in the scene; None where it was not brought."""
    role = f"camera:{photo}"
    return next((item for item in scene.objects if item.get(ROLE) == role and owner.owns(item)), None)


def look_through(scene: bpy.types.Scene, camera: bpy.types.Object) -> None:
    """Let the viewports of the scene look through a camera, and open image editors show the photo behind it."""
    scene.camera = camera
    images = [entry.image for entry in camera.data.background_images if entry.image is not None]
    for window in bpy.context.window_manager.windows:
        if window.scene != scene:
            continue
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.spaces.active.region_3d.view_perspective = "CAMERA"
    if images:
        for space in image_editors():
            space.image = images[0]


def image_editors() -> Iterator[bpy.types.SpaceImageEditor]:
    """The open editors that show pictures; those for UVs are left alone."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.ui_type == "IMAGE_EDITOR":
                yield area.spaces.active


def show_image(image: bpy.types.Image) -> bool:
    """Show a picture in the open image editors, or else in one that opens as the preferences say for renders ("Render
    In"); whether it is shown."""
    if bpy.app.background:
        return False
    if not any(image_editors()):
        _open_editor()
    shown = False
    for space in image_editors():
        space.image, shown = image, True
    return shown


def _open_editor() -> None:
    """Open an editor as Blender does for its own renders; with “Keep User Interface” none opens."""
    window = bpy.context.window or bpy.context.window_manager.windows[0]
    area = max(window.screen.areas, key=lambda area: area.width * area.height)
    with bpy.context.temp_override(window=window, screen=window.screen, area=area):
        bpy.ops.render.view_show("INVOKE_DEFAULT")
