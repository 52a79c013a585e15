"""Triangles as arrays: their normals and areas, which hang together, where they end."""

from __future__ import annotations

import numpy as np
import scipy


def cross(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals (F, 3) of triangles, twice their area long."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return np.linalg.norm(cross(vertices, faces), axis=1) / 2


def area_share(vertices: np.ndarray, faces: np.ndarray, chosen: np.ndarray) -> float:
    """Share of the area of triangles (F, 3) that the chosen (F,) bool ones have."""
    area = areas(vertices, faces)
    return float(area[chosen].sum() / max(area.sum(), 1e-30))


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-20)


def mean_around(faces: np.ndarray, values: np.ndarray, count: int, rings: int) -> np.ndarray:
    """Values (F,) of triangles, each the mean of those of its `count` vertices, and these of all their triangles, `rings`
    times."""
    corner = faces.reshape(-1)
    amount = np.maximum(np.bincount(corner, minlength=count), 1)
    for _ in range(rings):
        values = (np.bincount(corner, np.repeat(values, 3), count) / amount)[faces].mean(1)
    return values


def summed_around(faces: np.ndarray, vectors: np.ndarray, count: int) -> np.ndarray:
    """Sum (count, 3) for each vertex of the vectors (F, 3) of its triangles."""
    corner = faces.reshape(-1)
    return np.stack([np.bincount(corner, np.repeat(axis, 3), count) for axis in vectors.T], 1)


def components(faces: np.ndarray, count: int) -> np.ndarray:
    """Number (F,) of the connected part of each triangle; triangles that share a vertex are connected."""
    rows = np.concatenate([faces[:, 0], faces[:, 1]])
    columns = np.concatenate([faces[:, 1], faces[:, 2]])
    linked = scipy.sparse.coo_matrix((np.ones(len(rows), bool), (rows, columns)), (count, count))
    _, label = scipy.sparse.csgraph.connected_components(linked, False)
    _, part = np.unique(label[faces[:, 0]], return_inverse=True)
    return part


def compact(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Only the vertices that are used."""
    used, index = np.unique(faces, return_inverse=True)
    return vertices[used], index.reshape(-1, 3)


def edge_ends(faces: np.ndarray) -> np.ndarray:
    """Vertices (3F, 2) at the ends of triangles' edges, from corner k to k + 1, the smaller number first."""
    return np.sort(np.stack([faces, faces[:, [1, 2, 0]]], -1).reshape(-1, 2), 1)


def border_edges(faces: np.ndarray) -> np.ndarray:
    """Directed edges (E, 2) that have a triangle on one side only."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    stride = int(faces.max(initial=0)) + 1
    forward, back = edges[:, 0] * stride + edges[:, 1], edges[:, 1] * stride + edges[:, 0]
    return edges[~np.isin(forward, back)]
