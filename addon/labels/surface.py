"""Marks on the surface in 3D viewports: what is under the mouse, and the marks that are there."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy
from mathutils import Matrix, Vector

from ..project import snapshot
from ..roles import Owner
from ..scene.frame import scene_from_capture
from . import draw, journal, pending

PASSES = 32  # things in front of the surface that a ray goes through
STEP = 1e-4  # behind each of them, in units of the way to it
LIFT = 0.002  # of the way to the eye, by which marks are drawn in front of the surface

_handle: Any = None


def is_shown(objects: Iterable[bpy.types.Object], owner: Owner) -> bool:
    """Whether the project's surface is among some objects."""
    from ..scene.visibility import is_surface

    return any(is_surface(item) and owner.owns(item) for item in objects)


def under(
    scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, owner: Owner, origin: Vector, direction: Vector
) -> Vector | None:
    """The first place of the project's surface along a ray in the scene; other things do not hide it."""
    from ..scene.visibility import (
        is_surface,
    )  # not at the top: it needs numpy, and enabling the extension must be quick

    for _ in range(PASSES):
        hit, place, _normal, _index, item, _matrix = scene.ray_cast(depsgraph, origin, direction)
        if not hit:
            return None
        source = item.original if item is not None else None
        if source is not None and is_surface(source) and owner.owns(source):
            return place
        origin = place + direction * max(1e-6, STEP * (place - origin).length)
    return None


def under_mouse(context: bpy.types.Context, owner: Owner, x: float, y: float) -> Vector | None:
    """The place of the surface at x, y of the region; None beside it."""
    from bpy_extras import view3d_utils

    region, view = context.region, context.region_data
    origin = view3d_utils.region_2d_to_origin_3d(region, view, (x, y))
    direction = view3d_utils.region_2d_to_vector_3d(region, view, (x, y))
    return under(context.scene, context.evaluated_depsgraph_get(), owner, origin, direction)


def width_at(context: bpy.types.Context, place: Vector, pixels: float) -> float:
    """How wide so many pixels of the screen are at a place of the scene."""
    from bpy_extras import view3d_utils

    region, view = context.region, context.region_data
    middle = view3d_utils.location_3d_to_region_2d(region, view, place)
    if middle is None:
        return 0.0
    beside = view3d_utils.region_2d_to_location_3d(region, view, (middle.x + pixels, middle.y), place)
    return (beside - place).length


def parameters(scene: bpy.types.Scene, owner: Owner, places: Iterable[Vector], width: float) -> dict[str, Any]:
    """Places and width of a mark in the scene, as `label stroke` takes them: in the aligned world."""
    way = scene_from_capture(scene, owner).inverted()
    return {"places": [tuple(way @ place) for place in places], "width": width * way.median_scale}


def marks(folder: Path) -> list[tuple[dict[str, Any], list[Vector]]]:
    """The marks on the surface that are shown, each with its places in the aligned world."""
    frame, none = snapshot.frame(folder), Matrix()
    world = Matrix(frame.get("world_from_sfm", none)) @ Matrix(frame.get("marks_from_sfm", none)).inverted()
    stored = [
        (m, [world @ Vector(p) for p in m["places"]])
        for m in journal.marks_at(folder, pending.shown(folder))
        if m.get("places")
    ]
    waiting = [(m, [Vector(p) for p in m["places"]]) for m in pending.marks_of(folder) if m.get("places")]
    return [*stored, *waiting]


def _draw() -> None:
    context = bpy.context
    settings = context.scene.fieldwork
    folder = snapshot.folder_of(settings)
    if folder is None or not settings.label_strokes or not snapshot.has_project(folder):
        return
    shown = marks(folder)
    live = draw.live if draw.live is not None and draw.live.pieces else None
    if not shown and live is None:
        return
    import gpu

    colors, way = draw.colors_of(folder), scene_from_capture(context.scene, snapshot.owner(folder))
    eye = context.region_data.view_matrix.inverted().translation
    gpu.state.depth_test_set("LESS_EQUAL")
    for mark, places in shown:
        if not mark.get("erase"):
            _draw_line([way @ place for place in places], eye, draw.mark_color(mark, colors), context.region)
    for piece in live.pieces if live is not None else ():
        _draw_line(piece, eye, draw.mark_color(live.params, colors), context.region)
    gpu.state.depth_test_set("NONE")


def _draw_line(places: list[Vector], eye: Vector, color: tuple[float, float, float], region: bpy.types.Region) -> None:
    import gpu
    from gpu_extras.batch import batch_for_shader

    lifted = [place.lerp(eye, LIFT) for place in places]
    if len(lifted) == 1:
        lifted *= 2
        lifted[1] = lifted[1].lerp(eye, LIFT)
    shader = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
    for width, tint in ((8.0, draw.RIM), (5.0, (*color, 1.0))):
        shader.uniform_float("viewportSize", (region.width, region.height))
        shader.uniform_float("lineWidth", width)
        shader.uniform_float("color", tint)
        batch_for_shader(shader, "LINE_STRIP", {"pos": lifted}).draw(shader)


def register() -> None:
    global _handle
    if not bpy.app.background:
        _handle = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")


def unregister() -> None:
    global _handle
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
        _handle = None
