"""The zero level of distances on a sparse grid as triangles, open where the grid does not know."""

from __future__ import annotations

import numpy as np
import skimage

from ..progress import Reporter
from .fusion import BRICK, Bricks
from .region import outside

BLOCK = 16  # bricks along each side of what is extracted at once
LEAST = 1e-3  # voxels that a crossing keeps from a corner: vertices of neighbouring cells then never coincide
_WHOLE = 1e-4


def extract(bricks: Bricks, report: Reporter) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) of the normalised frame and triangles (F, 3), normals outward, welded across all blocks.

    Only cells of the region whose eight corners are known are looked at: the surface ends at their border, open.
    """
    places, triangles, first = [], [], 0
    starts = [range(0, n, BLOCK) for n in bricks.index.shape]
    blocks = [(x, y, z) for x in starts[0] for y in starts[1] for z in starts[2]]
    for number, corner in enumerate(blocks):
        report.progress(number / len(blocks))
        part = _block(bricks, np.array(corner))
        if part is None:
            continue
        places.append(part[0])
        triangles.append(part[1] + first)
        first += len(part[0])
    if not places:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    place, faces = weld(np.concatenate(places), np.concatenate(triangles))
    return bricks.origin + bricks.voxel * place, faces


def _block(bricks: Bricks, corner: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices, in voxels from the grid's origin, and triangles of the cells of up to 16³ bricks from `corner` on."""
    low, high = corner, np.minimum(corner + BLOCK + 1, bricks.index.shape)
    index = bricks.index[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
    if not (index[:BLOCK, :BLOCK, :BLOCK] >= 0).any():
        return None
    distance = assemble(index, bricks.distance) / np.float32(bricks.voxel)
    whole = assemble(index, bricks.weight) > 0
    side = tuple(min(n, BLOCK * BRICK + 1) for n in distance.shape)
    distance, whole = distance[: side[0], : side[1], : side[2]], whole[: side[0], : side[1], : side[2]]
    whole = whole & in_region(bricks, corner * BRICK, whole.shape)
    # scikit-image looks at the cell before a corner where the mask of that corner is set.
    for axis in range(3):
        before = np.roll(whole, 1, axis)
        before[(slice(None),) * axis + (0,)] = False
        whole = whole & before
    distance = off_corners(distance)
    inside = distance[whole]
    if min(side) < 2 or not len(inside) or inside.min() > 0 or inside.max() < 0:
        return None
    try:
        vertices, faces, _, _ = skimage.measure.marching_cubes(distance, 0.0, mask=whole, gradient_direction="descent")
    except (RuntimeError, ValueError):  # no cell is crossed
        return None
    return vertices.astype(np.float64) + corner * BRICK, faces.astype(np.int64)


def in_region(bricks: Bricks, first: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Which corners of the grid, of a box of this shape from the corner `first` (3,) on, lie in the region: bool, as large as
    the box."""
    x, y, z = (np.arange(n) + begin < count for n, begin, count in zip(shape, first, bricks.corners))
    inside = x[:, None, None] & y[:, None] & z
    return inside if bricks.sides is None else inside & (outside_of(bricks, first, shape) <= 0.5)


def outside_of(bricks: Bricks, first: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """How far, in voxels, the same corners lie outside of the sides of a region that stands at an angle."""
    assert bricks.sides is not None
    x, y, z = (start + bricks.voxel * (np.arange(n) + begin) for n, begin, start in zip(shape, first, bricks.origin))
    return outside(bricks.sides, x[:, None, None], y[:, None], z) / bricks.voxel


def off_corners(distance: np.ndarray) -> np.ndarray:
    """Distances in voxels that are nowhere zero: a crossing exactly at a corner would belong to several edges."""
    return np.where(np.abs(distance) < 2 * LEAST, np.where(distance < 0, -2 * LEAST, 2 * LEAST), distance)


def assemble(index: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Corners of a box of bricks (X, Y, Z) as one array (8X, 8Y, 8Z); 0 where there is no brick."""
    out = np.zeros((*index.shape, BRICK, BRICK, BRICK), values.dtype)
    present = index >= 0
    out[present] = values[index[present]]
    return out.transpose(0, 3, 1, 4, 2, 5).reshape([n * BRICK for n in index.shape])


def weld(place: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Join vertices (in voxels) that lie on the same edge of the grid; drop triangles that lose a corner by it."""
    rounded = np.round(place)
    whole = np.abs(place - rounded) < _WHOLE
    base = np.where(whole, rounded, np.floor(place)).astype(np.int64)
    kind = (~whole).astype(np.int64) @ np.array([1, 2, 4])
    span = base.max(0) + 2
    key = ((base[:, 0] * span[1] + base[:, 1]) * span[2] + base[:, 2]) * 8 + kind
    _, chosen, inverse = np.unique(key, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[faces]
    proper = (faces != np.roll(faces, 1, axis=1)).all(1)
    return place[chosen], faces[proper]
