"""A mesh cut into pieces small enough that one photo can be chosen for each, and who stands beside whom."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .triangles import edge_ends

PIECES = 60  # for depth buffers, along the longest side of a mesh


@dataclass(frozen=True)
class Facelets:
    """Triangles no longer than some limit, which cover a mesh.

    vertices (V, 3) float64; faces (F, 3) int32; parent (F,) face of the mesh each lies in; corners (F, 3, 2) its UV in
    [0, 1], v upwards, or None; normals (F, 3) unit; areas (F,); centers (F, 3); neighbours (F, 3) the facelet across the
    edge from corner k to k + 1, −1 where there is none or more than one; opposite (F, 3) which edge of the neighbour it is.
    """

    vertices: np.ndarray
    faces: np.ndarray
    parent: np.ndarray
    corners: np.ndarray | None
    normals: np.ndarray
    areas: np.ndarray
    centers: np.ndarray
    neighbours: np.ndarray
    opposite: np.ndarray

    def __len__(self) -> int:
        return len(self.faces)

    @cached_property
    def spans(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The first corner of each, and from there to the second and to the third: (F, 3) float32 each."""
        a, b, c = self.vertices[self.faces].transpose(1, 0, 2)
        return a.astype(np.float32), (b - a).astype(np.float32), (c - a).astype(np.float32)


def facelets(
    vertices: np.ndarray, faces: np.ndarray, corners: np.ndarray | None = None, limit: float = np.inf
) -> Facelets:
    """Halve the edges of a mesh until none is longer than `limit`; faces that share an edge share its new vertex.

    Args:
        vertices: (V, 3); faces: (F, 3); corners: (F, 3, 2) UV or None.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int32)
    uv = np.zeros((len(faces), 3, 0)) if corners is None else np.asarray(corners, np.float64)
    parent = np.arange(len(faces))
    while True:
        ends = edge_ends(faces)
        _, first, which = np.unique(
            ends[:, 0].astype(np.int64) * len(vertices) + ends[:, 1], return_index=True, return_inverse=True
        )
        a, b = vertices[ends[first]].transpose(1, 0, 2)
        long = np.linalg.norm(a - b, axis=1) > limit
        if not long.any():
            break
        number = np.where(long, len(vertices) + np.cumsum(long) - 1, -1)
        vertices = np.concatenate([vertices, ((a + b) / 2)[long]])
        faces, uv, parent = _halved(faces, uv, parent, number[which].reshape(-1, 3))
    cross = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    length = np.linalg.norm(cross, axis=1)
    neighbours, opposite = _neighbours(which.reshape(-1))
    return Facelets(
        vertices,
        faces,
        parent,
        None if corners is None else uv,
        cross / np.maximum(length, 1e-30)[:, None],
        length / 2,
        vertices[faces].mean(1),
        neighbours,
        opposite,
    )


def small_pieces(vertices: np.ndarray, faces: np.ndarray, corners: np.ndarray | None = None) -> Facelets:
    """A mesh in pieces for a depth buffer, which leaves out triangles that reach behind the camera; see `facelets`."""
    return facelets(vertices, faces, corners, float(np.ptp(vertices, axis=0).max()) / PIECES)


def _halved(
    faces: np.ndarray, uv: np.ndarray, parent: np.ndarray, middle: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Faces cut at the vertices `middle` (F, 3) of their edges k → k + 1; −1 where an edge stays whole."""
    count = (middle >= 0).sum(1)
    # Turned so that with one edge to halve it is the first, and with two the last one stays whole.
    turn = np.where(count == 1, (middle >= 0).argmax(1), np.where(count == 2, (middle < 0).argmax(1) + 1, 0)) % 3
    order = (np.arange(3) + turn[:, None]) % 3
    faces, middle = np.take_along_axis(faces, order, 1), np.take_along_axis(middle, order, 1)
    uv = np.take_along_axis(uv, order[..., None], 1)
    # Corners 0, 1, 2 and the middles 3 (of 0–1), 4 (of 1–2), 5 (of 2–0).
    points = np.concatenate([faces, middle], 1)
    places = np.concatenate([uv, (uv + uv[:, [1, 2, 0]]) / 2], 1)
    patterns = {
        0: [(0, 1, 2)],
        1: [(0, 3, 2), (3, 1, 2)],
        2: [(3, 1, 4), (0, 3, 4), (0, 4, 2)],
        3: [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)],
    }
    made = [
        (points[rows][:, corners], places[rows][:, corners], parent[rows])
        for n, triangles in patterns.items()
        if len(rows := np.flatnonzero(count == n))
        for corners in triangles
    ]
    return (
        np.concatenate([m[0] for m in made]).astype(np.int32),
        np.concatenate([m[1] for m in made]),
        np.concatenate([m[2] for m in made]),
    )


def _neighbours(edge: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Across each of the edges (3F,), given by number: the other face (F, 3) and its edge (F, 3); −1 unless two meet."""
    order = np.argsort(edge, kind="stable")
    ordered = edge[order]
    starts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]])) if len(edge) else np.zeros(0, int)
    pairs = starts[np.diff(np.append(starts, len(edge))) == 2]
    one, two = order[pairs], order[pairs + 1]
    other = np.full(len(edge), -1, np.int64)
    other[one], other[two] = two, one
    face = np.where(other >= 0, other // 3, -1).astype(np.int32)
    return face.reshape(-1, 3), np.where(other >= 0, other % 3, 0).astype(np.int8).reshape(-1, 3)
