"""Views of analytic shapes: depth maps as a perfect field would give them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from fieldwork.nerfcore.data.scene import View
from fieldwork.nerfcore.geometry.cameras import Camera, pixel_centers, rays
from fieldwork.nerfcore.kernels.depth_arrays import FREE
from fieldwork.nerfcore.mesh import depth_maps

# (origins (3,), directions (N, 3) of any length) → distance in units of the directions' length, inf where nothing is.
Hit = Callable[[np.ndarray, np.ndarray], np.ndarray]
CAMERA = Camera(width=120, height=90, fx=110.0, fy=112.0, cx=58.0, cy=46.0)


def look_at(place: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Camera-to-world (4, 4), OpenCV axes, z of the world upwards in the picture."""
    ahead = (target - place) / np.linalg.norm(target - place)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(ahead, right), ahead, place], 1)
    return pose


def sphere(radius: float) -> Hit:
    def hit(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        a, b = (direction**2).sum(1), direction @ origin
        root = b * b - a * (origin @ origin - radius**2)
        t = (-b - np.sqrt(np.maximum(root, 0))) / a
        inside = origin @ origin < radius**2
        t = np.where(inside, (-b + np.sqrt(np.maximum(root, 0))) / a, t)
        return np.where((root > 0) & (t > 0), t, np.inf)

    return hit


def box(low: np.ndarray, high: np.ndarray) -> Hit:
    """A solid box from outside, its walls from inside."""

    def hit(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore"):
            t0, t1 = (low - origin) / direction, (high - origin) / direction
        near, far = np.minimum(t0, t1).max(1), np.maximum(t0, t1).min(1)
        if ((origin > low) & (origin < high)).all():
            return far
        return np.where((near < far) & (near > 0), near, np.inf)

    return hit


def orbit(count: int, radius: float, heights: tuple[float, ...] = (-0.6, 0.2, 0.9)) -> list[np.ndarray]:
    poses = []
    for k in range(count):
        angle, z = 2 * np.pi * k * 0.381966, heights[k % len(heights)] * radius
        flat = np.sqrt(max(radius**2 - z**2, 0.01))
        poses.append(look_at(np.array([flat * np.cos(angle), flat * np.sin(angle), z]), np.zeros(3)))
    return poses


def maps_of(
    hit: Hit, poses: list[np.ndarray], camera: Camera = CAMERA
) -> tuple[list[depth_maps.FlatView], list[depth_maps.DepthMap]]:
    """What depth_maps would read from a perfect field, for photos of a (possibly distorted) camera."""
    views = [View(f"{k}", camera, pose, image=None) for k, pose in enumerate(poses)]  # type: ignore[arg-type]
    flats = depth_maps.flat_views(views, np.eye(4), max(camera.width, camera.height))
    made = []
    for flat in flats:
        c = flat.camera
        local, _ = rays(c, pixel_centers(c.width, c.height).reshape(-1, 2))
        far = hit(flat.pose[:3, 3], local @ flat.pose[:3, :3].T)
        z = np.where(np.isfinite(far), far, 0) * local[:, 2]
        depth = np.where(np.isfinite(far), z, FREE).astype(np.float32).reshape(c.height, c.width)
        depth[~flat.inside] = 0
        made.append(depth_maps.DepthMap(depth, np.full_like(depth, 1e-4), depth_maps.cosines(c, depth)))
    return flats, made
