"""What `raycast` and `triangles` must give, every triangle against every ray or pixel, in double precision."""

from __future__ import annotations

import numpy as np


def cast(
    vertices: np.ndarray, faces: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `raycast.FrontFaces.cast`, and by how much (N,) of a triangle's barycentric coordinates each ray passes the
    nearest edge of what it may hit. Source: Möller and Trumbore, "Fast, minimum storage ray/triangle intersection", 1997.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    e1, e2 = b - a, c - a
    p = np.cross(directions[:, None], e2[None])  # (N, F, 3)
    determinant = (e1 * p).sum(-1)
    s = origins[:, None] - a
    q = np.cross(s, e1)
    with np.errstate(divide="ignore", invalid="ignore"):
        v = (s * p).sum(-1) / determinant
        w = (directions[:, None] * q).sum(-1) / determinant
        t = (e2 * q).sum(-1) / determinant
    inside = np.minimum(np.minimum(v, w), 1 - v - w)
    front = (determinant > 0) & (t > 0)  # the normal e1 × e2 faces the origin
    distance = np.where(front & (inside >= 0), t, np.inf)
    face = distance.argmin(1)
    rows = np.arange(len(origins))
    missed = ~np.isfinite(distance[rows, face])
    u = 1 - v - w
    corner = np.stack([u[rows, face], v[rows, face]], 1)
    margin = np.where(front, np.abs(inside), np.inf).min(1)
    return np.where(missed, -1, face), np.where(missed[:, None], 0, corner), margin


def nearest(
    pixels: np.ndarray, depth: np.ndarray, faces: np.ndarray, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """As `triangles.nearest_triangle`, one triangle after the other."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    found, inverse = np.full((height, width), -1), np.zeros((height, width))
    for index, face in enumerate(faces):
        if (depth[face] <= 0).any():
            continue
        matrix = np.concatenate([pixels[face].T, np.ones((1, 3))])
        weights = np.linalg.solve(matrix, np.stack([x.ravel(), y.ravel(), np.ones(x.size)]))
        value = (weights / depth[face][:, None]).sum(0).reshape(height, width)
        here = (weights >= 0).all(0).reshape(height, width) & (value > inverse)
        found[here], inverse[here] = index, value[here]
    with np.errstate(divide="ignore"):
        return found, np.where(found >= 0, 1 / inverse, np.inf)
