"""COLMAP's camera models in terms of ours. Its pixel centres are at +0.5, as ours."""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import InputError
from .cameras import Camera

# Number, name and parameter count of COLMAP's models, for binary files. Source: COLMAP, sensor/models.h.
MODELS = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4), 13: ("DIVISION", 5), 14: ("SIMPLE_FISHEYE", 3), 15: ("FISHEYE", 4), 16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}  # fmt: skip


def camera_from_colmap(model: str, width: int, height: int, params: Sequence[float]) -> Camera:
    """Our camera for a COLMAP model name and its parameters.

    Raises:
        InputError: the model has no counterpart.
    """
    p = [float(value) for value in params]
    match model:
        case "EQUIRECTANGULAR":
            # As in transforms.json: no ray depends on the focal length.
            focal, cx, cy = width / 2, width / 2, height / 2
            return Camera(model="EQUIRECTANGULAR", width=width, height=height, fx=focal, fy=focal, cx=cx, cy=cy)
        case (
            "SIMPLE_PINHOLE"
            | "SIMPLE_RADIAL"
            | "RADIAL"
            | "SIMPLE_FISHEYE"
            | "SIMPLE_RADIAL_FISHEYE"
            | "RADIAL_FISHEYE"
        ):
            fx = fy = p[0]
            cx, cy, extra = p[1], p[2], p[3:]
        case "PINHOLE" | "FISHEYE" | "OPENCV" | "OPENCV_FISHEYE" | "FULL_OPENCV":
            fx, fy, cx, cy, extra = p[0], p[1], p[2], p[3], p[4:]
        case _:
            raise InputError(
                f"The COLMAP camera model {model} is not supported.", "Undistort the images with COLMAP first."
            )
    if model.endswith("FISHEYE"):
        distortion = (*extra, *(0.0,) * (4 - len(extra)))
        ours = "OPENCV_FISHEYE"
    elif model in ("SIMPLE_RADIAL", "RADIAL"):
        distortion = (extra[0], extra[1] if len(extra) > 1 else 0.0, 0.0, 0.0)
        ours = "OPENCV"
    else:
        distortion = tuple(extra)
        ours = "OPENCV"
    if ours == "OPENCV" and not any(distortion):
        ours, distortion = "PINHOLE", ()
    return Camera(model=ours, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, distortion=distortion)


def camera_to_colmap(camera: Camera) -> tuple[str, list[float]]:
    """COLMAP's model of a camera and its parameters, in its order.

    Raises:
        InputError: it has none, for panoramas.
    """
    lens = [camera.fx, camera.fy, camera.cx, camera.cy]
    match camera.model:
        case "PINHOLE":
            return "PINHOLE", lens
        case "OPENCV_FISHEYE":
            return "OPENCV_FISHEYE", [*lens, *camera.distortion]
        case "OPENCV":
            model, count = ("OPENCV", 4) if len(camera.distortion) == 4 else ("FULL_OPENCV", 8)
            return model, [*lens, *camera.distortion, *[0.0] * (count - len(camera.distortion))]
        case _:
            raise InputError(
                "COLMAP has no model for panoramas.", "Use a format that knows them, such as transforms.json."
            )
