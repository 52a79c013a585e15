"""Camera models: pixels to rays and points to pixels.

Conventions, used everywhere in `nerfcore`:
- Pixel coordinates have their origin at the top-left corner of the image; the centre of the first pixel is (0.5, 0.5).
- Camera axes are OpenCV's: x right, y down, z forward. Blender's and OpenGL's cameras look along −z with y up:
  `flip_camera_axes` turns one into the other.
- Poses are camera-to-world 4×4 matrices.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

CameraModel = Literal["PINHOLE", "OPENCV", "OPENCV_FISHEYE", "EQUIRECTANGULAR"]
DIRECTIONS = 72  # around the axis of a perspective lens in which it is asked where its polynomial turns back


class Camera(BaseModel):
    """Intrinsics of one camera. Focal lengths and principal point in pixels.

    `distortion` is (k1, k2, p1, p2) for OPENCV (SIMPLE_RADIAL and RADIAL are its cases with zeros), in OpenCV's order
    optionally followed by k3, k4, k5, k6; (k1, k2, k3, k4) for OPENCV_FISHEYE; empty for PINHOLE and EQUIRECTANGULAR.
    """

    model_config = ConfigDict(frozen=True)

    model: CameraModel = "PINHOLE"
    width: int = Field(gt=0)
    height: int = Field(gt=0)
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    @property
    def pixels_per_radian(self) -> float:
        """Pixels that an angle spans in the middle of the picture."""
        return self.width / (2 * np.pi) if self.model == "EQUIRECTANGULAR" else self.fx

    def resized(self, width: int, height: int) -> Camera:
        """The same lens on an image resampled to width × height."""
        sx, sy = width / self.width, height / self.height
        return self.model_copy(
            update={
                "width": width,
                "height": height,
                "fx": self.fx * sx,
                "fy": self.fy * sy,
                "cx": self.cx * sx,
                "cy": self.cy * sy,
            }
        )

    def reframed(self, width: int, height: int) -> Camera:
        """The same lens on an image width × height, cut at two sides where its proportions differ."""
        scale = max(width / self.width, height / self.height)
        return self.model_copy(
            update={
                "width": width,
                "height": height,
                "fx": self.fx * scale,
                "fy": self.fy * scale,
                "cx": self.cx * scale + (width - self.width * scale) / 2,
                "cy": self.cy * scale + (height - self.height * scale) / 2,
            }
        )

    def undistorted(self) -> Camera:
        """The pinhole camera with the same focal lengths and principal point."""
        return self.model_copy(update={"model": "PINHOLE", "distortion": ()})


def pixel_centers(width: int, height: int) -> np.ndarray:
    """Coordinates (height, width, 2) of all pixel centres, x first."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([x, y], -1)


def _opencv_distort(uv: np.ndarray, k: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Distorted normalised coordinates (N, 2); and r², the radial factor and its denominator (N,).

    `k` is (k1, k2, p1, p2[, k3[, k4, k5, k6]]), the radial factor (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ +
    k6 r⁶). Source: OpenCV calib3d; COLMAP's OPENCV and FULL_OPENCV.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = (*k, *(0.0,) * (8 - len(k)))
    u, v = uv[:, 0], uv[:, 1]
    r2 = u * u + v * v
    top, bottom = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = top / bottom
    out = np.stack(
        [u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u), v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v], -1
    )
    return out, r2, radial, bottom


def _opencv_slopes(uv: np.ndarray, k: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Distorted normalised coordinates (N, 2), see `_opencv_distort`, and their Jacobian (N, 2, 2)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*k, *(0.0,) * (8 - len(k)))
    out, r2, radial, bottom = _opencv_distort(uv, k)
    u, v = uv[:, 0], uv[:, 1]
    # Twice the derivative of the radial factor by r².
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2) - radial * (k4 + r2 * (2 * k5 + 3 * k6 * r2))) / bottom
    jacobian = np.empty((len(uv), 2, 2))
    jacobian[:, 0, 0] = radial + u * u * slope + 2 * p1 * v + 6 * p2 * u
    jacobian[:, 0, 1] = u * v * slope + 2 * p1 * u + 2 * p2 * v
    jacobian[:, 1, 0] = jacobian[:, 0, 1]
    jacobian[:, 1, 1] = radial + v * v * slope + 6 * p1 * v + 2 * p2 * u
    return out, jacobian


def _opencv_undistort(target: np.ndarray, k: tuple[float, ...], steps: int = 25) -> tuple[np.ndarray, np.ndarray]:
    """Newton inverse of `_opencv_distort`: (N, 2) undistorted coordinates and a convergence mask (N,)."""
    uv = target.copy()
    for _ in range(steps):
        value, jacobian = _opencv_slopes(uv, k)
        determinant = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
        determinant = np.where(np.abs(determinant) < 1e-9, 1e-9, determinant)
        error = value - target
        step_u = (jacobian[:, 1, 1] * error[:, 0] - jacobian[:, 0, 1] * error[:, 1]) / determinant
        step_v = (jacobian[:, 0, 0] * error[:, 1] - jacobian[:, 1, 0] * error[:, 0]) / determinant
        # A step longer than half the image plane means the lens polynomial has folded over: keep it damped.
        length = np.maximum(np.hypot(step_u, step_v) / 0.5, 1.0)
        uv = uv - np.stack([step_u / length, step_v / length], -1)
    value, jacobian = _opencv_slopes(uv, k)
    determinant = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
    return uv, (np.abs(value - target).max(-1) < 1e-9) & (determinant > 0)


def _fisheye_theta(radius: np.ndarray, k: tuple[float, ...], steps: int = 25) -> tuple[np.ndarray, np.ndarray]:
    """Invert r = θ(1 + k1θ² + k2θ⁴ + k3θ⁶ + k4θ⁸) by Newton: θ (N,) and a convergence mask (N,)."""
    theta = np.clip(radius, 0, np.pi)
    powers = np.arange(1, 5)

    def value(t: np.ndarray) -> np.ndarray:
        return t * (1 + sum(c * t ** (2 * n) for c, n in zip(k, powers)))

    for _ in range(steps):
        slope = 1 + sum(c * (2 * n + 1) * theta ** (2 * n) for c, n in zip(k, powers))
        theta = np.clip(theta - (value(theta) - radius) / np.where(np.abs(slope) < 1e-9, 1e-9, slope), 0, np.pi)
    slope = 1 + sum(c * (2 * n + 1) * theta ** (2 * n) for c, n in zip(k, powers))
    return theta, (np.abs(value(theta) - radius) < 1e-9) & (slope > 0)


def rays(camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit viewing directions in camera axes for pixel coordinates.

    Args:
        camera: intrinsics.
        pixels: (N, 2) x, y in pixels.
    Returns:
        directions (N, 3) of unit length, and valid (N,) bool: false where the distortion cannot be inverted.
    """
    pixels = np.asarray(pixels, np.float64)
    if camera.model == "EQUIRECTANGULAR":
        longitude = (pixels[:, 0] / camera.width - 0.5) * 2 * np.pi
        latitude = (0.5 - pixels[:, 1] / camera.height) * np.pi
        direction = np.stack(
            [np.cos(latitude) * np.sin(longitude), -np.sin(latitude), np.cos(latitude) * np.cos(longitude)], -1
        )
        return direction, np.ones(len(pixels), bool)
    uv = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    valid = np.ones(len(uv), bool)
    if camera.model == "OPENCV_FISHEYE":
        radius = np.linalg.norm(uv, axis=-1)
        theta, valid = _fisheye_theta(radius, camera.distortion)
        scale = np.where(radius > 1e-12, np.sin(theta) / np.maximum(radius, 1e-12), 1.0)
        return np.concatenate([uv * scale[:, None], np.cos(theta)[:, None]], -1), valid
    if camera.model == "OPENCV" and any(camera.distortion):
        uv, valid = _opencv_undistort(uv, camera.distortion)
    direction = np.concatenate([uv, np.ones((len(uv), 1))], -1)
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True), valid


@lru_cache(maxsize=256)
def widest_angle(distortion: tuple[float, ...]) -> float:
    """Angle to the optical axis, in radians, at which the polynomial of a fisheye lens turns back; infinite where it does not.
    What lies farther out seems to be inside of the picture, and is not: the polynomial was fitted to what the lens shows."""
    angle = np.linspace(0, np.pi, 1000)
    radius = angle * (1 + sum(c * angle ** (2 * n) for n, c in enumerate(distortion, 1)))
    back = np.flatnonzero(np.diff(radius) <= 0)
    return float(angle[back[0]]) if len(back) else np.inf


@lru_cache(maxsize=16384)  # of captures whose every photo has a lens of its own, too
def widest_angles(distortion: tuple[float, ...]) -> np.ndarray | None:
    """The same of a perspective lens in directions (K,) around the axis that are evenly spread from 0 to 2π, both included:
    tangential terms bend the picture back earlier on one side than on the other. None where it nowhere does."""
    if not any(distortion):
        return None
    around = np.linspace(0, 2 * np.pi, DIRECTIONS + 1) if any(distortion[2:4]) else np.zeros(1)
    angle = np.linspace(0, np.pi / 2, 2000)[:-1]
    far = np.tan(angle)
    places = np.stack([np.outer(np.cos(around), far), np.outer(np.sin(around), far)], -1)
    jacobian = _opencv_slopes(places.reshape(-1, 2), distortion)[1]
    determinant = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
    back = (determinant <= 0).reshape(len(around), len(far))
    if not back.any():
        return None
    last = np.where(back.any(1), np.maximum(back.argmax(1) - 1, 0), len(far) - 1)
    return np.broadcast_to(angle[last], DIRECTIONS + 1)


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Pixel coordinates (N, 2) of points (N, 3) in camera axes; NaN behind a perspective camera, and beyond the angle where the
    lens polynomial turns back."""
    points = np.asarray(points, np.float64)
    x, y, z = points.T
    if camera.model == "EQUIRECTANGULAR":
        longitude = np.arctan2(x, z)
        latitude = np.arctan2(-y, np.hypot(x, z))
        return np.stack([(longitude / (2 * np.pi) + 0.5) * camera.width, (0.5 - latitude / np.pi) * camera.height], -1)
    if camera.model == "OPENCV_FISHEYE":
        radius = np.hypot(x, y)
        theta = np.arctan2(radius, z)
        theta = np.where(theta < widest_angle(camera.distortion), theta, np.nan)
        distorted = theta * (1 + sum(c * theta ** (2 * n) for n, c in enumerate(camera.distortion, 1)))
        uv = np.stack([x, y], -1) * np.where(radius > 1e-12, distorted / np.maximum(radius, 1e-12), 1.0)[:, None]
    else:
        uv = np.stack([x, y], -1) / np.where(z > 0, z, np.nan)[:, None]
        if camera.model == "OPENCV" and any(camera.distortion):
            widest = widest_angles(camera.distortion)
            if widest is not None:
                limit = np.tan(widest[0])
                if any(camera.distortion[2:4]):
                    around = np.arctan2(uv[:, 1], uv[:, 0]) % (2 * np.pi) * (DIRECTIONS / (2 * np.pi))
                    limit = np.tan(np.interp(around, np.arange(DIRECTIONS + 1), widest))
                uv = np.where((np.hypot(*uv.T) < limit)[:, None], uv, np.nan)
            uv = _opencv_distort(uv, camera.distortion)[0]
    return uv * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def pose_matrix(value: Any) -> np.ndarray | None:
    """The pose (4, 4) that a file gives as 4×4 or 3×4 numbers; None where it gives something else."""
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError):
        return None
    if matrix.shape == (3, 4):
        return np.vstack([matrix, [0, 0, 0, 1]])
    return matrix if matrix.shape == (4, 4) else None


def flip_camera_axes(camera_to_world: np.ndarray) -> np.ndarray:
    """Turn OpenCV camera axes into OpenGL/Blender ones, or back: (..., 4, 4) → (..., 4, 4)."""
    return camera_to_world * [1.0, -1.0, -1.0, 1.0] + 0.0  # no −0, which files would show
