"""What areas and volumes owe to where exactly a surface lies, and its borders.

A surface that photos were made into may lie anywhere within a pixel's footprint of the truth, and with it the borders of
classes: fields are soft, label maps and photos are as coarse as their pixels, and what is off so is off by as much and
in the same direction on the whole of a thing. Neither photos drawn anew nor cells of another size show it. The standard
uncertainty of a place is that of an even distribution over ± a footprint: footprint / √3 (JCGM 100, “Guide to the
expression of uncertainty in measurement”, 2008, 4.3.7).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..data.pixels import training_size
from ..mesh.surface import vertex_normals
from ..mesh.triangles import areas
from ..mesh.visibility import PosedCamera, within

MOST = 20_000  # pieces that are asked for the footprint
STEP = 1e-3  # of the longest side: how far a surface is moved to see how its area changes


def u_places(
    views: Sequence[PosedCamera], centers: np.ndarray, labels: np.ndarray, count: int, longest: int
) -> np.ndarray:
    """Standard uncertainty (count,) of the place of the surface of each label, along its normals and within it.

    Args:
        views: that the field was trained with, in the frame of the centers (P, 3) of pieces, whose labels (P,) are 0 …
            count − 1. longest: side of the photos in training, in pixels.
    """
    chosen = np.linspace(0, len(centers) - 1, min(len(centers), MOST)).astype(int)
    some, found = centers[chosen], np.full((len(views), len(chosen)), np.nan)
    for row, view in zip(found, views):
        local = view.local(some)
        depth, camera = view.depth(local), view.camera
        with np.errstate(invalid="ignore"):
            seen = (depth > 0) & within(view.pixels(local), camera.width, camera.height)
        coarser = camera.width / training_size(camera, longest)[0]
        row[seen] = view.footprint(depth[seen]) * coarser
    asked = np.isfinite(found).any(0)
    if not asked.any():
        return np.zeros(count)
    each, own = np.nanmedian(found[:, asked], axis=0), labels[chosen][asked]
    pixel = [np.median(each[own == n]) if (own == n).any() else np.median(each) for n in range(count)]
    return np.array(pixel) / np.sqrt(3)


def border_lengths(vertices: np.ndarray, faces: np.ndarray, label: np.ndarray, count: int) -> np.ndarray:
    """Length (count,) of the borders of each label (F,) on triangles (F, 3): where another begins, or the surface ends."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1).astype(np.int64)
    key = (edges[:, 0] * len(vertices) + edges[:, 1]) * count + np.tile(label, 3)
    _, first, many = np.unique(key, return_index=True, return_counts=True)
    border = first[many == 1]
    length = np.linalg.norm(vertices[edges[border, 0]] - vertices[edges[border, 1]], axis=1)
    return np.bincount(np.tile(label, 3)[border], length, count)


def area_rates(vertices: np.ndarray, faces: np.ndarray, label: np.ndarray, count: int) -> np.ndarray:
    """By how much the area of each label (count,) grows with the distance that the surface moves along its normals."""
    step = STEP * max(float(np.ptp(vertices, axis=0).max()), 1e-30)
    normals = vertex_normals(vertices, faces)
    grown, shrunk = (np.bincount(label, areas(vertices + s * normals, faces), count) for s in (step, -step))
    return (grown - shrunk) / (2 * step)


def area_deviations_of_place(
    vertices: np.ndarray, faces: np.ndarray, label: np.ndarray, u_place: np.ndarray
) -> np.ndarray:
    """Standard uncertainty (count,) of the area of each label (F,) from that of its place, u_place (count,)."""
    count = len(u_place)
    rates = area_rates(vertices, faces, label, count)
    return np.hypot(rates, border_lengths(vertices, faces, label, count)) * u_place
