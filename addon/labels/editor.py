"""The photo that is labelled: in which image editor it stands, and where on it the mouse is."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import bpy

from ..project import snapshot
from ..render.slot import load_image

PHOTO = "fieldwork_label_photo"  # on images: the name of the photo in its project
TOOL = "fieldwork.label"


def photos(folder: Path | None) -> dict[str, dict[str, Any]]:
    """The usable photos of a project by name."""
    images = (snapshot.project(folder) or {}).get("images", [])
    return {image["name"]: image for image in images if image.get("status", "ok") != "rejected" and image.get("file")}


def photo_of(image: bpy.types.Image | None, folder: Path | None) -> dict[str, Any] | None:
    """The photo of the project that an image shows; None where it is another picture."""
    if image is None or folder is None or PHOTO not in image:
        return None
    found = photos(folder).get(str(image[PHOTO]))
    if found is None or image.library is not None:
        return None
    # A saved file may have the path relative to itself, by another way.
    same = os.path.realpath(bpy.path.abspath(image.filepath)) == os.path.realpath(folder / found["file"])
    return found if same else None


def spaces() -> Iterator[tuple[bpy.types.Window, bpy.types.Area]]:
    """The open editors that show pictures."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.ui_type == "IMAGE_EDITOR":
                yield window, area


def shown_photo(folder: Path | None) -> str | None:
    """The name of the photo in the first editor that shows one."""
    for _, area in spaces():
        found = photo_of(area.spaces.active.image, folder)
        if found is not None:
            return str(found["name"])
    return None


def show(folder: Path, photo: dict[str, Any]) -> bpy.types.Image:
    """Show a photo in the image editors with the label tool at hand; where none is open, the largest 3D viewport is halved.

    Raises:
        FileNotFoundError: the photo is not in the project's folder.
    """
    image = load_image(folder / photo["file"])
    image[PHOTO] = photo["name"]
    if bpy.app.background:
        return image
    if not any(spaces()):
        _halve()
    for window, area in spaces():
        space = area.spaces.active
        before = space.image
        space.image = image
        if photo_of(before, folder) is None:
            space.mode = "VIEW"
            space.show_region_toolbar = space.show_region_tool_header = True
            with _within(window, area):
                bpy.ops.wm.tool_set_by_id(name=TOOL, space_type="IMAGE_EDITOR")
        with _within(window, area):
            bpy.ops.image.view_all(fit_view=True)
        area.tag_redraw()
    return image


def _halve() -> None:
    """Make the left half of the largest 3D viewport an image editor."""
    window = bpy.context.window or bpy.context.window_manager.windows[0]
    views = [area for area in window.screen.areas if area.type == "VIEW_3D"] or list(window.screen.areas)
    area = max(views, key=lambda area: area.width * area.height)
    before = {other.as_pointer() for other in window.screen.areas}
    with _within(window, area):
        bpy.ops.screen.area_split(direction="VERTICAL", factor=0.5)
    new = next((other for other in window.screen.areas if other.as_pointer() not in before), area)
    left = min((new, area), key=lambda part: part.x)
    left.ui_type = "IMAGE_EDITOR"


def _within(window: bpy.types.Window, area: bpy.types.Area) -> AbstractContextManager[Any]:
    """Let operators work in an editor."""
    region = next(region for region in area.regions if region.type == "WINDOW")
    return bpy.context.temp_override(window=window, screen=window.screen, area=area, region=region)


def pixel_at(region: bpy.types.Region, size: tuple[int, int], x: float, y: float) -> tuple[float, float]:
    """The pixel of a photo, its top-left corner being 0, 0, at a place of the region (from its lower left)."""
    u, v = region.view2d.region_to_view(x, y)
    return u * size[0], (1 - v) * size[1]


def place_of(region: bpy.types.Region, size: tuple[int, int], x: float, y: float) -> tuple[float, float]:
    """Where in the region a pixel of a photo stands."""
    return region.view2d.view_to_region(x / size[0], 1 - y / size[1], clip=False)


def zoom(region: bpy.types.Region, size: tuple[int, int]) -> float:
    """Pixels of the screen to one of the photo."""
    left, right = (region.view2d.view_to_region(u, 0, clip=False)[0] for u in (0.0, 1.0))
    return max(1e-3, (right - left) / size[0])
