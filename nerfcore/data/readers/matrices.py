"""Data sets that give each photo a matrix: Strecha `.camera`, Middlebury `_par.txt`, DTU `cameras.npz`.

All three put the centre of the first pixel at (0, 0); half a pixel is added to their principal points. Their poses
are read as documented: Strecha gives camera-to-world rotation and centre, the others world-to-camera.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy

from ...errors import InputError
from ...geometry.cameras import Camera


def camera_from_matrix(k: np.ndarray, size: tuple[int, int]) -> Camera:
    """Pinhole camera from a calibration matrix (3, 3) with pixel centres at integers.

    Args:
        k: calibration; a skew is dropped.
        size: width, height of the image that was calibrated.
    """
    width, height = size
    return Camera(width=width, height=height, fx=k[0, 0], fy=k[1, 1], cx=k[0, 2] + 0.5, cy=k[1, 2] + 0.5)


def pose_from_world_to_camera(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Camera-to-world (4, 4) from x_camera = R x_world + t."""
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ translation
    return pose


def decompose_projection(projection: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Calibration (3, 3) and camera-to-world (4, 4) of a projection matrix (3, 4).

    Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed., section 6.2.4.
    """
    k, rotation = (np.asarray(part) for part in scipy.linalg.rq(projection[:, :3]))
    signs = np.diag(np.where(np.diag(k) < 0, -1.0, 1.0))
    k, rotation = k @ signs, signs @ rotation
    if np.linalg.det(rotation) < 0:
        rotation, projection = -1.0 * rotation, -1.0 * projection
    center = -np.linalg.solve(projection[:, :3], projection[:, 3])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, center
    return k / k[2, 2], pose


def read_numbers(path: Path) -> list[list[float]]:
    """The rows of numbers of a text file. Raises InputError naming it."""
    try:
        rows = [line.split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
        return [[float(value) for value in row] for row in rows]
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}.", "Download or export the data set again.") from error
