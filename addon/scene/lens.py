"""Blender's cameras as pinholes in pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import bpy


class Pinhole(NamedTuple):
    """Focal lengths and principal point in pixels, from the upper left corner."""

    fx: float
    fy: float
    cx: float
    cy: float


def pinhole(
    camera: bpy.types.Camera,
    width: int,
    height: int,
    aspect: Sequence[float] = (1.0, 1.0),
    shift_x: float | None = None,
) -> Pinhole:
    """A perspective camera at a picture size in pixels, which are as wide and as high as `aspect` says; `shift_x`: that of
    an eye of stereo, None: the camera's own.

    Blender measures the angle and the shifts along the side that `sensor_fit` names, or along the longer one
    (BKE_camera_params_compute_viewplane).
    """
    tall = aspect[1] / aspect[0]
    fit = camera.sensor_fit
    if fit == "AUTO":
        fit = "HORIZONTAL" if width >= tall * height else "VERTICAL"
        sensor = camera.sensor_width
    else:
        sensor = camera.sensor_width if fit == "HORIZONTAL" else camera.sensor_height
    side = width if fit == "HORIZONTAL" else tall * height
    focal = camera.lens / sensor * side
    shift_x = camera.shift_x if shift_x is None else shift_x
    return Pinhole(focal, focal / tall, width / 2 - shift_x * side, height / 2 + camera.shift_y * side / tall)


def picture_size(render: bpy.types.RenderSettings) -> tuple[int, int]:
    """Width and height in pixels that Blender renders: 33 % of 1920 are 633, not 634."""
    percent = render.resolution_percentage
    return max(1, render.resolution_x * percent // 100), max(1, render.resolution_y * percent // 100)
