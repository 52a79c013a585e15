"""Volumes of closed parts: the loops at which a part is open, flat caps over them, and the volume inside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..mesh.triangles import areas

MOST_CAPPED = 0.1  # of a part's area that may be caps


@dataclass(frozen=True)
class Closed:
    """A part with its openings capped: volume, share of its area that is caps, and how far the volume would move if each
    cap moved by as much as its rim is uneven (all in units of the vertices)."""

    volume: float
    capped: float
    uneven: float


def border_loops(faces: np.ndarray) -> list[np.ndarray]:
    """The openings of triangles (F, 3) as closed loops of vertices (N,), in the direction of the triangles' edges.

    Edges that run once more in one direction than in the other are open; as each triangle is a loop, these are too.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    ahead = edges[:, 0] < edges[:, 1]
    ends, which = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    net = np.bincount(which.reshape(-1), np.where(ahead, 1, -1), len(ends)).astype(np.int64)
    directed = np.where(net[:, None] > 0, ends, ends[:, ::-1])
    onward: dict[int, list[int]] = {}
    for a, b in np.repeat(directed, np.abs(net), 0).tolist():
        onward.setdefault(a, []).append(b)
    loops = []
    for start in list(onward):
        while onward[start]:
            loop, here = [start], onward[start].pop()
            while here != start:
                loop.append(here)
                here = onward[here].pop()
            loops += _simple(loop)
    return loops


def _simple(loop: list[int]) -> list[np.ndarray]:
    """A loop that may pass a vertex more than once, cut there into loops that do not."""
    made, place, path = [], {}, []
    for vertex in loop:
        if vertex in place:
            begin = place[vertex]
            made.append(np.array(path[begin:]))
            for other in path[begin:]:
                del place[other]
            path = path[:begin]
        place[vertex] = len(path)
        path.append(vertex)
    return [*made, np.array(path)]


def closed(vertices: np.ndarray, faces: np.ndarray, most_capped: float = MOST_CAPPED) -> Closed | None:
    """The volume inside triangles (F, 3), openings capped by fans around the middle of their rim; None where there is no
    inside: the caps would be more than `most_capped` of the area, or the triangles face inward.

    Vertices (V, 3). The volume is the sum of the signed tetrahedra between the origin and the triangles.
    """
    vertices = np.asarray(vertices, np.float64)
    if not len(faces):
        return None
    middle = vertices[np.unique(faces)].mean(0)
    volume, uneven, cap_area = _signed(vertices[faces] - middle), 0.0, 0.0
    for loop in border_loops(faces):
        rim = vertices[loop] - middle
        fan = np.stack([np.roll(rim, -1, 0), rim, np.broadcast_to(rim.mean(0), rim.shape)], 1)
        half = np.cross(fan[:, 1] - fan[:, 0], fan[:, 2] - fan[:, 0]) / 2
        # The vector area of a loop is the same for every surface across it, and cancels where two rims are one loop along a
        # slit between them.
        vector = half.sum(0)
        flat = float(np.linalg.norm(vector))
        volume += _signed(fan)
        cap_area += float(np.linalg.norm(half, axis=1).sum())
        height = (rim - rim.mean(0)) @ (vector / max(flat, 1e-30))
        uneven += (flat * float(height.std())) ** 2
    capped = cap_area / max(float(areas(vertices, faces).sum()) + cap_area, 1e-30)
    if volume <= 0 or capped > most_capped:
        return None
    return Closed(volume, capped, float(np.sqrt(uneven)))


def _signed(triangles: np.ndarray) -> float:
    """Sum of the signed volumes of the tetrahedra between the origin and triangles (F, 3, 3)."""
    a, b, c = triangles.transpose(1, 0, 2)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)
