"""Photos of flat things, computed exactly: a painted wall, what stands before it, and a camera anywhere."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from fieldwork.nerfcore.geometry.cameras import Camera, pixel_centers, rays
from fieldwork.nerfcore.mesh.photos import Photo
from fieldwork.nerfcore.mesh.visibility import PosedCamera

LENS = Camera(model="OPENCV", width=320, height=240, fx=260, fy=260, cx=161.0, cy=118.5, distortion=(-0.08, 0.02, 0, 0))


def pattern(xy: np.ndarray) -> np.ndarray:
    """sRGB (N, 3) in [0, 1] of the wall at (N, 2): waves, and a fine grid of lines."""
    x, y = xy.T
    waves = np.stack([np.sin(3 * x + y), np.cos(4 * y - x), np.sin(2 * x - 3 * y)], 1)
    lines = 0.12 * (np.sin(22 * x) * np.sin(22 * y))[:, None]
    return np.clip(0.5 + 0.25 * waves + lines, 0.02, 0.98)


def looking(at: tuple[float, float, float], center: tuple[float, float, float]) -> np.ndarray:
    """Camera-to-world (4, 4) of a camera at `center` that looks at a point, y of the world up."""
    forward = np.array(at, float) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 1.0, 0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([right, np.cross(forward, right), forward], 1), center
    return pose


def ring(count: int, radius: float = 0.8, distance: float = 2.0) -> list[np.ndarray]:
    """Poses on a circle before the wall z = 0."""
    angles = np.arange(count) / count * 2 * np.pi
    return [looking((0, 0, 0), (radius * np.cos(a), radius * np.sin(a), distance)) for a in angles]


def on_plane(camera: Camera, pose: np.ndarray, height: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Where the rays of all pixels meet the plane z = height: (H·W, 3), and the depth (H·W,) along the optical axis."""
    directions, _ = rays(camera, pixel_centers(camera.width, camera.height).reshape(-1, 2))
    world = directions @ pose[:3, :3].T
    distance = (height - pose[2, 3]) / world[:, 2]
    return pose[:3, 3] + distance[:, None] * world, distance * directions[:, 2]


def wall_picture(
    pose: np.ndarray,
    camera: Camera = LENS,
    color: Callable[[np.ndarray], np.ndarray] = pattern,
    exposure: float = 0.0,
    board: tuple[float, float, float] | None = None,
) -> np.ndarray:
    """An (H, W, 4) uint8 photo of the wall.

    exposure: in stops. board: half side, distance from the wall and grey of a square board before its middle.
    """
    srgb = color(on_plane(camera, pose)[0][:, :2])
    if board is not None:
        half, away, grey = board
        hit = np.abs(on_plane(camera, pose, away)[0][:, :2]).max(1) < half
        srgb = np.where(hit[:, None], grey, srgb)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4) * 2.0**exposure
    linear = linear.clip(0, 1)
    srgb = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    rgb = (srgb * 255 + 0.5).astype(np.uint8).reshape(camera.height, camera.width, 3)
    return np.concatenate([rgb, np.full_like(rgb[..., :1], 255)], 2)


def wall_photo(pose: np.ndarray, camera: Camera = LENS, rgba: np.ndarray | None = None, labels=None, **how) -> Photo:
    pixels = wall_picture(pose, camera, **how) if rgba is None else rgba
    return Photo(PosedCamera(camera, pose), lambda: pixels, labels)


def wall_mesh(cells: int = 12, half: float = 0.6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """vertices (V, 3), faces (F, 3) and UV (F, 3, 2) of the wall, which faces +z."""
    n = cells + 1
    x, y = np.meshgrid(np.linspace(-half, half, n), np.linspace(-half, half, n))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], 1)
    corner = (np.arange(cells)[:, None] * n + np.arange(cells)).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + n + 1], 1),
            np.stack([corner, corner + n + 1, corner + n], 1),
        ]
    )
    return vertices, faces, ((vertices[faces][..., :2] / half + 1) / 2).astype(np.float32)


def box_mesh(half: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """The 8 vertices and 12 outward triangles of a cube."""
    vertices = np.stack(np.meshgrid(*[[-half, half]] * 3, indexing="ij"), -1).reshape(-1, 3)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return vertices, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
