"""Blender's cameras as the engine's lenses (nerfcore/film/shot.py)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import bpy
from mathutils import Matrix

from ..errors import SceneError
from ..scene.lens import pinhole
from ..text import t

Value = TypeVar("Value")
BLUR_POSES = 9  # poses while the shutter is open
PANORAMAS = {
    "EQUIRECTANGULAR": "equirectangular",
    "FISHEYE_EQUIDISTANT": "equidistant",
    "FISHEYE_EQUISOLID": "equisolid",
}


def lens(
    camera: bpy.types.Object, width: int, height: int, aspect: Sequence[float], shift_x: float | None = None
) -> dict[str, Any]:
    """The lens of a camera for a frame of this size in pixels, without its poses; `shift_x`: that of an eye of stereo,
    None: the camera's own.

    Raises SceneError: it is a camera, or a panorama, of a kind that the engine does not know.
    """
    data = camera.data
    shift_x = data.shift_x if shift_x is None else shift_x
    found = {"width": width, "height": height, "clip": (data.clip_start, data.clip_end)}
    aperture = _aperture(camera)
    if aperture is not None:
        found["aperture"] = aperture
    if data.type == "ORTHO":
        side, tall = _fitted(data, width, height, aspect)
        scale = side / data.ortho_scale
        center = (width / 2 - shift_x * side, height / 2 + data.shift_y * side / tall)
        return {**found, "kind": "orthographic", "scale": (scale, scale / tall), "center": center}
    if data.type == "PANO":
        return {**found, **_panorama(data, width, height)}
    if data.type != "PERSP":  # Blender 5 has some that a shader makes
        raise SceneError(t("“{}” is a camera of a kind that Fieldwork does not render.", data.name))
    hole = pinhole(data, width, height, aspect, shift_x)
    return {**found, "kind": "perspective", "scale": (hole.fx, hole.fy), "center": (hole.cx, hole.cy)}


def _fitted(data: bpy.types.Camera, width: int, height: int, aspect: Sequence[float]) -> tuple[float, float]:
    """The side that the sensor is fitted to, in pixels as wide as those of the frame, and how tall these are."""
    tall = aspect[1] / aspect[0]
    wide = data.sensor_fit == "HORIZONTAL" or (data.sensor_fit == "AUTO" and width >= tall * height)
    return (width if wide else tall * height), tall


def _panorama(data: bpy.types.Camera, width: int, height: int) -> dict[str, Any]:
    own = data if hasattr(data, "panorama_type") else getattr(data, "cycles", None)  # Blender 5 moved it out of Cycles
    if own is None:
        raise SceneError(t("“{}” is a panorama of Cycles: enable that in the preferences.", data.name))
    if own.panorama_type not in PANORAMAS:
        raise SceneError(
            t(
                "“{}” is a panorama of a kind that Fieldwork does not render. Choose Equirectangular or Fisheye.",
                data.name,
            )
        )
    found: dict[str, Any] = {"kind": PANORAMAS[own.panorama_type]}
    if found["kind"] == "equirectangular":
        found["longitudes"] = (own.longitude_min, own.longitude_max)
        found["latitudes"] = (own.latitude_min, own.latitude_max)
        return found
    found["angle"] = own.fisheye_fov
    if found["kind"] == "equisolid":
        found["focal"] = own.fisheye_lens
        # The side that is fitted has the sensor's length, the other follows the proportions of the frame.
        wide = data.sensor_fit == "HORIZONTAL" or (data.sensor_fit == "AUTO" and width >= height)
        side = data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width
        found["sensor"] = (side, side * height / width) if wide else (side * width / height, side)
    return found


def _aperture(camera: bpy.types.Object) -> dict[str, Any] | None:
    data = camera.data
    dof = data.dof
    if not dof.use_dof:
        return None
    # As Cycles: the lens in millimetres, whatever the units of the scene.
    length = 1.0 if data.type == "ORTHO" else data.lens * 1e-3
    focus = dof.focus_distance
    if dof.focus_object is not None:
        target = dof.focus_object.matrix_world
        bone = dof.focus_object.pose.bones.get(dof.focus_subtarget) if dof.focus_object.pose else None
        place = (target @ bone.matrix if bone is not None else target).translation
        axis = camera.matrix_world.col[2].xyz.normalized()
        focus = abs(axis.dot(place - camera.matrix_world.translation))
    radius = length / (2 * dof.aperture_fstop) if dof.aperture_fstop > 0 else 0.0
    if radius <= 0:
        return None
    return {
        "radius": radius,
        "focus": max(focus, 1e-5),
        "blades": dof.aperture_blades,
        "rotation": dof.aperture_rotation,
        "ratio": dof.aperture_ratio,
    }


def pose(world: Matrix) -> list[list[float]]:
    """Scene from camera, without the scale of the camera or its parents; mirrored where the camera is, as Blender has it."""
    return [list(row) for row in world.normalized()]


def shutter_times(render: Any, frame: float) -> list[float]:
    """Frames, with fractions, at which the scene is looked at while the shutter is open; one without motion blur."""
    if not render.use_motion_blur or render.motion_blur_shutter <= 0:
        return [frame]
    length = render.motion_blur_shutter
    first = frame - {"START": 0.0, "CENTER": 0.5, "END": 1.0}[render.motion_blur_position] * length
    return [first + length * number / (BLUR_POSES - 1) for number in range(BLUR_POSES)]


def in_time(
    read: Callable[[], Value], times: Sequence[float], go_to: Callable[[int, float], None], now: float
) -> list[Value]:
    """What is read of the scene at these times, and back to now."""
    if len(times) == 1:
        return [read()]
    found = []
    try:
        for time in times:
            go_to(math.floor(time), time - math.floor(time))
            found.append(read())
    finally:
        go_to(math.floor(now), now - math.floor(now))
    return found


def moving(poses: list[Value]) -> list[Value]:
    """Poses in time of what moves; of what stays, one."""
    return poses if any(other != poses[0] for other in poses[1:]) else poses[:1]
