"""The points A and B of a known distance in the viewport, with the line between them."""

from __future__ import annotations

from typing import Any

import bpy

from .frame import units_per_metre

COLOR = (1.0, 0.75, 0.1, 1.0)
WIDTH, DOT, SIZE = 2.0, 8.0, 15  # of the line and the points in pixels, of the letters in points
UNSET = (0.0, 0.0, 0.0)

_handle: Any = None


def ends(settings: Any) -> dict[str, tuple[float, float, float]]:
    """The points that were picked, by their letters; a point at the origin is one that was not."""
    places = {"A": tuple(settings.point_a), "B": tuple(settings.point_b)}
    return {letter: place for letter, place in places.items() if place != UNSET}


def length(scene: bpy.types.Scene) -> float | None:
    """Metres between the two points as the scene has them now; None before both are picked."""
    from mathutils import Vector

    places = list(ends(scene.fieldwork).values())
    if len(places) < 2:
        return None
    return (Vector(places[0]) - Vector(places[1])).length / units_per_metre(scene)


def _draw() -> None:
    context = bpy.context
    places = ends(context.scene.fieldwork)
    if not places or not context.space_data.overlay.show_overlays:
        return
    import blf
    import gpu
    from bpy_extras.view3d_utils import location_3d_to_region_2d
    from gpu_extras.batch import batch_for_shader

    region, view = context.region, context.region_data
    seen = {letter: location_3d_to_region_2d(region, view, place) for letter, place in places.items()}
    pixels = {letter: tuple(at) for letter, at in seen.items() if at is not None}
    gpu.state.blend_set("ALPHA")
    if len(pixels) == 2:
        line = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
        line.uniform_float("viewportSize", (region.width, region.height))
        line.uniform_float("lineWidth", WIDTH)
        line.uniform_float("color", COLOR)
        batch_for_shader(line, "LINES", {"pos": [(*at, 0.0) for at in pixels.values()]}).draw(line)
    dots = gpu.shader.from_builtin("UNIFORM_COLOR")
    dots.uniform_float("color", COLOR)
    gpu.state.point_size_set(DOT)
    batch_for_shader(dots, "POINTS", {"pos": [(*at, 0.0) for at in pixels.values()]}).draw(dots)
    gpu.state.point_size_set(1.0)
    gpu.state.blend_set("NONE")
    blf.size(0, SIZE * context.preferences.system.ui_scale)
    blf.color(0, *COLOR)
    for letter, (x, y) in pixels.items():
        blf.position(0, x + DOT, y + DOT, 0.0)
        blf.draw(0, letter)


def register() -> None:
    global _handle
    if not bpy.app.background:
        _handle = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL")


def unregister() -> None:
    global _handle
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
        _handle = None
