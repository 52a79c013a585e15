"""What `depth_normals.py` must give."""

from __future__ import annotations

import numpy as np
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.kernels.depth_arrays import FREE
from fieldwork.nerfcore.mesh.depth_maps import EDGE, EDGE_PIXELS, pixel_directions


def normals(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Unit normals (H, W, 3) in camera axes, towards the camera, from depth differences over one or two pixels; 0 where
    there is no surface or an outline."""
    solid = (depth > 0) & (depth < FREE)
    points = pixel_directions(camera) * np.where(solid, depth, 1)[..., None]
    edge = max(EDGE, EDGE_PIXELS / camera.fx)
    normal = np.cross(_slope(points, solid, 1, edge), _slope(points, solid, 0, edge))
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(solid[..., None] & (length > 0), normal / np.maximum(length, 1e-30), 0)
    return -normal * np.sign((normal * points).sum(-1, keepdims=True))


def _slope(points: np.ndarray, solid: np.ndarray, axis: int, jump: float) -> np.ndarray:
    """Difference of points (H, W, 3) to a neighbour along an axis: of the two sides, the one whose depth is nearer; 0
    where neither is solid or continues the surface: depths differ by less than the share `jump`."""
    out, best = np.zeros_like(points), np.full(solid.shape, np.inf, np.float32)
    z = points[..., 2]
    for step in (2, 1):
        for sign in (-1, 1):
            moved = np.roll(points, sign * step, axis)
            change = np.abs(moved[..., 2] - z) / step
            usable = solid & np.roll(solid, sign * step, axis) & (change < jump * z) & (change < 0.999 * best)
            edge = [slice(None)] * 2
            edge[axis] = slice(0, step) if sign > 0 else slice(-step, None)
            usable[tuple(edge)] = False
            out[usable] = (moved - points)[usable] * -sign / step
            best[usable] = change[usable]
    return out
