"""A surface without openings: space that no view shows counts as inside."""

from __future__ import annotations

import numpy as np
import skimage
import torch

from ..kernels.depth_arrays import MapArrays
from ..kernels.surface import fuse
from ..progress import Reporter
from .clean import FEWEST_VIEWS, drop_scraps, seen_by
from .decimate import decimate_closed
from .denoise import denoised
from .extract import BLOCK, assemble, in_region, off_corners, outside_of, weld
from .fusion import BRICK, FREE_AT, TRUNCATION, Bricks, depth_gap
from .triangles import areas, compact, components, cross, unit

CHUNK = 1 << 16  # bricks asked about at once
SEEN = 0.1  # share of a part's area
MUCH_MORE = 1.1  # times the triangles wanted, of which the user is told


def closed_surface(
    bricks: Bricks, maps: MapArrays, tolerance: float, most: int | None, report: Reporter
) -> tuple[np.ndarray, np.ndarray]:
    """The closed surface of `extract_closed` without what hangs in unseen space, in about `most` triangles where a number is
    given and it can stay closed."""
    vertices, faces = extract_closed(bricks, maps, report)
    if not len(faces):
        return vertices, faces
    report.stage("Cleaning the surface")
    faces = drop_unseen(vertices, faces, maps, tolerance, report)
    vertices, faces = compact(vertices, drop_scraps(vertices, faces))
    if most is not None and len(faces) > most:
        report.stage("Simplifying")
        vertices, faces = decimate_closed(vertices, faces, most, report)
        if len(faces) > MUCH_MORE * most:
            report.warn(f"The surface keeps {len(faces)} triangles: with {most} it would not stay closed.")
    return denoised(vertices, faces, maps.depth.device, report), faces


def extract_closed(bricks: Bricks, maps: MapArrays, report: Reporter) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) of the normalised frame and triangles (F, 3) of the border between what views show to be free and
    everything else, closed at the sides of the region.

    A corner has its fused distance where at least one view says something about it, and is inside where none does; where
    there are no bricks, the middle of eight corners a side speaks for all of them.
    """
    free = _free(bricks, maps, report)
    places, triangles, first = [], [], 0
    starts = [range(0, n, BLOCK) for n in bricks.index.shape]
    blocks = [np.array((x, y, z)) for x in starts[0] for y in starts[1] for z in starts[2]]
    for number, corner in enumerate(blocks):
        report.progress(number / len(blocks))
        distance = _distances(bricks, free, corner)
        if distance.min() > 0 or distance.max() < 0:
            continue
        vertices, faces, _, _ = skimage.measure.marching_cubes(distance, 0.0, gradient_direction="descent")
        places.append(vertices.astype(np.float64) + corner * BRICK - 1)
        triangles.append(faces.astype(np.int64) + first)
        first += len(vertices)
    if not places:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    # Places count from the corner before the grid's first, which is what keeps them positive.
    place, faces = weld(np.concatenate(places) + 1, np.concatenate(triangles))
    return bricks.origin + bricks.voxel * (place - 1), faces


def _free(bricks: Bricks, maps: MapArrays, report: Reporter) -> np.ndarray:
    """Which bricks (X, Y, Z) bool of those that were not fused views show to be free, by their middles."""
    device, h = maps.depth.device, bricks.voxel
    free = np.zeros(bricks.index.shape, bool)
    empty = np.argwhere(bricks.index < 0)
    for begin in range(0, len(empty), CHUNK):
        report.progress(begin / len(empty))
        some = empty[begin : begin + CHUNK]
        middle = torch.from_numpy(bricks.origin + h * (some * BRICK + (BRICK - 1) / 2)).float().to(device)
        distance, weight = fuse(middle, maps, h, TRUNCATION * h, FREE_AT * h, depth_gap(maps))
        free[tuple(some.T)] = ((weight > 0) & (distance > 0)).cpu().numpy()
    return free


def _distances(bricks: Bricks, free: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Distances in voxels at the corners of up to 16³ bricks from `corner` on, and of those that close the gap to the block
    before; outside around the region."""
    shape = np.array(bricks.index.shape)
    low, high = np.maximum(corner - 1, 0), np.minimum(corner + BLOCK, shape)
    part = tuple(slice(a, b) for a, b in zip(low, high))
    index = bricks.index[part]
    known = assemble(index, bricks.weight) > 0
    fused = assemble(index, bricks.distance) / np.float32(bricks.voxel)
    there, clear = (a.repeat(BRICK, 0).repeat(BRICK, 1).repeat(BRICK, 2) for a in (index >= 0, free[part]))
    distance = np.where(there, np.where(known, fused, -1.0), np.where(clear, 1.0, -1.0)).astype(np.float32)
    distance[~in_region(bricks, low * BRICK, distance.shape)] = 1.0
    if bricks.sides is not None:
        distance = np.maximum(distance, outside_of(bricks, low * BRICK, distance.shape).clip(-1, 1).astype(np.float32))
    # From the corner before the block's first to its last, which is where the next block begins.
    begin = corner * BRICK - 1
    end = np.where(corner + BLOCK < shape, (corner + BLOCK) * BRICK, shape * BRICK + 1)
    distance = np.pad(distance, 1, constant_values=1.0)
    offset = low * BRICK - 1
    window = tuple(slice(a, b) for a, b in zip(begin - offset, end - offset))
    return off_corners(distance[window])


def drop_unseen(
    vertices: np.ndarray, faces: np.ndarray, maps: MapArrays, tolerance: float, report: Reporter
) -> np.ndarray:
    """The triangles (F, 3) of connected parts of whose area views see at least `SEEN`: what hangs in space that no view
    shows, between rays of some that do, is nothing."""
    unseen, area = unseen_faces(vertices, faces, maps, tolerance, report), areas(vertices, faces)
    part = components(faces, len(vertices))
    return faces[(np.bincount(part, area * ~unseen) >= SEEN * np.bincount(part, area))[part]]


def unseen_faces(
    vertices: np.ndarray, faces: np.ndarray, maps: MapArrays, tolerance: float, report: Reporter
) -> np.ndarray:
    """Which triangles (F,) bool fewer than two views see."""
    normals = unit(cross(vertices, faces))
    return seen_by(vertices[faces].mean(1), normals, maps, tolerance, report) < FEWEST_VIEWS
