"""How far the outlines of classes painted on a surface are from the true ones."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from ..mesh.facelets import facelets
from ..mesh.painted import Painted
from ..mesh.painting import texels_of
from ..mesh.triangles import cross, edge_ends, unit

TILE = 2048  # texels a side that are looked at at once
SPACING = 0.25  # texels between points of a true outline


def outline_texels(
    vertices: np.ndarray, faces: np.ndarray, painted: Painted, outline: np.ndarray, close: float
) -> float | None:
    """Median distance, in texels, from true outlines to where the class map of a mesh (V, 3), (F, 3) changes its class.

    Args:
        outline: ends (E, 2, 3) of the edges at which the true class changes. close: distance from which on an edge is one of
            a place that the mesh lacks; such are left out.
    Returns:
        None where there is no class map or no outline.
    """
    if painted.maps is None or painted.uv is None or not len(outline):
        return None
    found, width = painted_outline(vertices, faces, painted.uv.corners, painted.maps.ids)
    if not len(found):
        return None
    far = np.asarray(KDTree(found).query(spread(outline, SPACING * width))[0])
    near = far[far < close]
    return float(np.median(near) / width) if len(near) else None


def true_outline(vertices: np.ndarray, faces: np.ndarray, face_class: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends (E, 2, 3) of the edges of a mesh whose two triangles have different classes, and the normals (E, 3) of one of
    these."""
    ends = edge_ends(faces).astype(np.int64)
    key, kind = ends[:, 0] * len(vertices) + ends[:, 1], np.repeat(face_class, 3)
    order = np.argsort(key, kind="stable")
    pair = key[order[1:]] == key[order[:-1]]
    change = order[1:][pair & (kind[order[1:]] != kind[order[:-1]])]
    return vertices[ends[change]], unit(cross(vertices, faces[change // 3]))


def spread(edges: np.ndarray, spacing: float) -> np.ndarray:
    """Points (N, 3) along edges (E, 2, 3), at most `spacing` apart, each for about the same length."""
    length = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    count = np.maximum(np.ceil(length / spacing).astype(int), 1)
    row = np.repeat(np.arange(len(edges)), count)
    step = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    share = ((step + 0.5) / count[row])[:, None]
    return edges[row, 0] * (1 - share) + edges[row, 1] * share


def painted_outline(
    vertices: np.ndarray, faces: np.ndarray, corners: np.ndarray, ids: np.ndarray
) -> tuple[np.ndarray, float]:
    """Where on the mesh (N, 3) a class map `ids` (S, S) changes from one texel to the one beside or below it, both of the
    same triangle or its neighbour, and the median width of a texel there. corners: UV (F, 3, 2)."""
    pieces, size = facelets(vertices, faces, corners), len(ids)
    places, widths = [], []
    for top in range(0, size, TILE):
        for left in range(0, size, TILE):
            tile = left, top, min(TILE, size - left), min(TILE, size - top)
            texels = texels_of(pieces, size, tile)
            owner = np.full(tile[2] * tile[3], -1, np.int64)
            texel = np.zeros(tile[2] * tile[3], np.int64)
            rows = np.repeat(np.arange(len(pieces)), np.diff(texels.first))
            owner[texels.place], texel[texels.place] = rows, np.arange(len(rows))
            owner, texel = owner.reshape(tile[3], tile[2]), texel.reshape(tile[3], tile[2])
            part = ids[top : top + tile[3], left : left + tile[2]]
            for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
                a, b = owner[one], owner[other]
                change = (part[one] != part[other]) & (a >= 0) & (b >= 0)
                change[change] = _together(pieces.neighbours, a[change], b[change])
                ends = [texels.points(pieces, o[change], t[change]) for o, t in ((a, texel[one]), (b, texel[other]))]
                places.append((ends[0] + ends[1]) / 2)
                widths.append(texels.width[a[change]])
    found, width = np.concatenate(places), np.concatenate(widths)
    return found, float(np.median(width)) if len(width) else 0.0


def _together(neighbours: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Whether triangles (N,) are the same or share an edge: charts may lie side by side."""
    return (a == b) | (neighbours[a] == b[:, None]).any(1)
