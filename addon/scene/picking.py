"""The point of the capture, or the place of its surface, under the mouse."""

from __future__ import annotations

import bpy
import numpy as np
from bpy_extras import view3d_utils
from mathutils import Vector

from ..roles import ROLE
from .spot import Spot, spot_at

REACH = 14  # pixels


def point_under(context: bpy.types.Context, area: bpy.types.Area, x: float, y: float) -> Vector | None:
    """The nearest sparse point within reach of the mouse, else the surface under it; None where there is neither.

    Args:
        area: a 3D viewport; x, y: of the window, in pixels from its lower left.
    Returns:
        a place in the world.
    """
    region = _region_under(area, x, y)
    if region is None:
        return None
    view = region.data  # each view of Quad View has its own
    mouse = Vector((x - region.x, y - region.y))
    found = _nearest_point(context, region, view, mouse)
    if found is not None:
        return found
    origin = view3d_utils.region_2d_to_origin_3d(region, view, mouse)
    direction = view3d_utils.region_2d_to_vector_3d(region, view, mouse)
    hit, place, *_ = context.scene.ray_cast(context.evaluated_depsgraph_get(), origin, direction)
    return place if hit else None


def spot_under(context: bpy.types.Context, area: bpy.types.Area, x: float, y: float) -> Spot | None:
    """What is known of the surface under the mouse (see `point_under`); None where there is none."""
    region = _region_under(area, x, y)
    if region is None:
        return None
    view, mouse = region.data, Vector((x - region.x, y - region.y))
    origin = view3d_utils.region_2d_to_origin_3d(region, view, mouse)
    direction = view3d_utils.region_2d_to_vector_3d(region, view, mouse)
    return spot_at(context.scene, context.evaluated_depsgraph_get(), origin, direction)


def _region_under(area: bpy.types.Area, x: float, y: float) -> bpy.types.Region | None:
    """The view of a 3D viewport under the mouse; the sidebar lies over it."""
    region = next((r for r in area.regions if r.type == "WINDOW" and _inside(r, x, y)), None)
    if any(_inside(r, x, y) for r in area.regions if r.type in ("UI", "TOOLS", "HEADER")):
        return None
    return region


def _inside(region: bpy.types.Region, x: float, y: float) -> bool:
    return 0 <= x - region.x < region.width and 0 <= y - region.y < region.height


def _nearest_point(context, region, view, mouse: Vector) -> Vector | None:
    """Of the sparse points within reach of the mouse, the one nearest to the viewer."""
    best = None
    for item in context.visible_objects:
        if item.get(ROLE) != "points" or item.type != "MESH":
            continue
        count = len(item.data.vertices)
        places = np.empty((count, 3), np.float32)
        item.data.attributes["position"].data.foreach_get("vector", places.ravel())
        seen = project(places, np.array(view.perspective_matrix @ item.matrix_world), region.width, region.height)
        near = np.linalg.norm(seen[:, :2] - np.array(mouse), axis=1) <= REACH
        near &= seen[:, 2] > 0
        if near.any():
            index = int(np.flatnonzero(near)[np.argmin(seen[near, 2])])
            if best is None or seen[index, 2] < best[0]:
                best = (seen[index, 2], item.matrix_world @ Vector(places[index].tolist()))
    return best[1] if best else None


def project(places: np.ndarray, matrix: np.ndarray, width: int, height: int) -> np.ndarray:
    """Points (N, 3) through a perspective matrix (4, 4): (N, 3), pixels from the lower left and the depth along the view
    (negative behind the viewer)."""
    clip = places @ matrix[:, :3].T + matrix[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = (clip[:, :2] / clip[:, 3:] * 0.5 + 0.5) * [width, height]
    return np.concatenate([np.where(clip[:, 3:] > 0, pixels, np.inf), clip[:, 3:]], 1)
