"""UV coordinates (xatlas) and a colour texture baked from the field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xatlas
from scipy import ndimage

from ..progress import Reporter

BLOCK = 1 << 18  # texels shaded at once


@dataclass(frozen=True)
class Unwrapped:
    """A mesh whose vertices were split at UV seams: `source` (V,) original vertex, faces (F, 3), uv (V, 2) in [0, 1],
    v upwards."""

    source: np.ndarray
    faces: np.ndarray
    uv: np.ndarray


def unwrap(vertices: np.ndarray, faces: np.ndarray, size: int) -> Unwrapped:
    """Cut a mesh into charts and pack them into a square of `size` texels. Face order is kept."""
    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32))
    pack = xatlas.PackOptions()
    pack.resolution = size
    pack.padding = 2
    chart = xatlas.ChartOptions()
    chart.max_iterations = 1
    atlas.generate(chart, pack)
    source, new_faces, uv = atlas[0]
    return Unwrapped(source.astype(np.int64), new_faces.astype(np.int32), uv.astype(np.float32))


def rasterize(uv: np.ndarray, faces: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Which triangle covers each texel, and where in it.

    Triangles are taken in groups whose bounding boxes have the same size, each group at once.

    Args:
        uv: (V, 2) in [0, 1], v upwards.
    Returns:
        face (size, size) int, −1 where there is none; barycentric (size, size, 2): weights of corners 1 and 2. Row 0
        is the top of the picture (v = 1).
    """
    corner = np.stack([uv[:, 0] * size, (1 - uv[:, 1]) * size], 1)[faces].astype(np.float64)
    low = np.floor(corner.min(1) - 0.5).astype(int)
    extent = (np.ceil(corner.max(1) - 0.5).astype(int) - low + 1).max(1)
    face = np.full((size, size), -1)
    weights = np.zeros((size, size, 2), np.float32)
    a, ab, ac = corner[:, 0], corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    group = np.where(extent <= 4, extent, 2 ** np.ceil(np.log2(np.maximum(extent, 1))).astype(int))
    for side in np.unique(group):
        members = np.flatnonzero((group == side) & (np.abs(area) > 1e-12))
        step = max(1, (1 << 22) // int(side * side))
        grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)
        for part in np.split(members, range(step, len(members), step)):
            texel = low[part][:, None] + grid
            p = texel + 0.5 - a[part][:, None]
            v = (p[..., 0] * ac[part, None, 1] - p[..., 1] * ac[part, None, 0]) / area[part, None]
            w = (ab[part, None, 0] * p[..., 1] - ab[part, None, 1] * p[..., 0]) / area[part, None]
            inside = (v >= -1e-6) & (w >= -1e-6) & (v + w <= 1 + 1e-6)
            inside &= (texel >= 0).all(-1) & (texel < size).all(-1)
            row, column = np.nonzero(inside)
            x, y = texel[row, column].T
            face[y, x] = part[row]
            weights[y, x] = np.stack([v[row, column], w[row, column]], -1)
    return face, weights


def bake(
    vertices: np.ndarray,
    normals: np.ndarray,
    unwrapped: Unwrapped,
    size: int,
    color: Callable[[np.ndarray, np.ndarray], np.ndarray],
    report: Reporter,
) -> np.ndarray:
    """A (size, size, 3) uint8 texture.

    Args:
        vertices, normals: (V, 3) of the original mesh.
        color: points (N, 3) and normals (N, 3) → (N, 3) uint8.
    """
    face, weights = rasterize(unwrapped.uv, unwrapped.faces, size)
    rows, columns = np.nonzero(face >= 0)
    corners = unwrapped.source[unwrapped.faces[face[rows, columns]]]
    second, third = weights[rows, columns].T[..., None]
    first = 1 - second - third

    def interpolate(values: np.ndarray, part: slice) -> np.ndarray:
        a, b, c = (values[corners[part, k]] for k in range(3))
        return first[part] * a + second[part] * b + third[part] * c

    texture = np.zeros((size, size, 3), np.uint8)
    for begin in range(0, len(rows), BLOCK):
        report.progress(begin / max(len(rows), 1))
        part = slice(begin, begin + BLOCK)
        normal = interpolate(normals, part)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        texture[rows[part], columns[part]] = color(interpolate(vertices, part), normal)
    # Spread the border colours into the gaps, so that filtering at seams does not pick up black.
    nearest = np.asarray(ndimage.distance_transform_edt(face < 0, return_distances=False, return_indices=True))
    return texture[nearest[0], nearest[1]]
