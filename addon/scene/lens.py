"""Blender's cameras as pinholes in pixels."""

from __future__ import annotations

from typing import NamedTuple

import bpy


class Pinhole(NamedTuple):
    """Focal length and principal point in pixels, from the upper left corner; square pixels."""

    focal: float
    cx: float
    cy: float


def pinhole(camera: bpy.types.Camera, width: int, height: int) -> Pinhole:
    """A perspective camera at a picture size in pixels.

    Blender measures the angle and the shifts along the side that `sensor_fit` names, or along the longer one.
    """
    fit = camera.sensor_fit
    if fit == "AUTO":
        fit = "HORIZONTAL" if width >= height else "VERTICAL"
        sensor = camera.sensor_width
    else:
        sensor = camera.sensor_width if fit == "HORIZONTAL" else camera.sensor_height
    side = width if fit == "HORIZONTAL" else height
    focal = camera.lens / sensor * side
    return Pinhole(focal, width / 2 - camera.shift_x * side, height / 2 + camera.shift_y * side)
