"""Closed surfaces that touch themselves, cut apart where they do: every edge then joins two triangles."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from .clean import unit

ROUNDS = 12
APART = 0.01  # of the mean edge's length: how far copies of a vertex are drawn into their own part


def unfolded(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A surface (V, 3), (F, 3) with as many triangles on one side of each edge as on the other, whose edges join two each.

    Around an edge of more than two triangles, those are joined between which the inside is; vertices are doubled, and the
    copies drawn slightly apart. Other surfaces come back as they can be joined.
    """
    faces = faces.astype(np.int64)
    pairs = joined(vertices, faces)
    # Corner k of triangle f is number 3 f + k, and half of the edge from it to the next is too.
    one, other = pairs.T
    after = np.arange(3 * len(faces)).reshape(-1, 3)[:, [1, 2, 0]].reshape(-1)
    rows, columns = np.concatenate([one, after[one]]), np.concatenate([after[other], other])
    count = 3 * len(faces)
    parts, label = connected_components(coo_matrix((np.ones(len(rows), bool), (rows, columns)), (count, count)), False)
    place = np.zeros(parts, np.int64)
    place[label] = faces.reshape(-1)
    made, new = vertices[place].astype(np.float64), label.reshape(-1, 3).astype(np.int64)
    copies = np.flatnonzero(np.bincount(place, minlength=len(vertices))[place] > 1)
    middle, weight = np.zeros_like(made), np.bincount(new.reshape(-1), minlength=parts)[:, None]
    np.add.at(middle, new.reshape(-1), np.repeat(made[new].mean(1), 3, 0))
    towards = (middle / np.maximum(weight, 1) - made)[copies]
    edge = float(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1).mean())
    made[copies] += APART * edge * unit(towards)
    return parted(made, new)


def parted(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The surface with edges halved that still join more than two triangles: sheets that touch along an edge and go on
    together around both of its ends. Each sheet gets a middle of its own."""
    for _ in range(ROUNDS):
        pairs = joined(vertices, faces)
        ends = np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2)[pairs[:, 0]]
        key = ends.min(1) * len(vertices) + ends.max(1)
        _, index, many = np.unique(key, return_inverse=True, return_counts=True)
        used, chosen = set[int](), []
        for one, other in pairs[many[index.reshape(-1)] > 1].tolist():
            if not {one // 3, other // 3} & used:
                used |= {one // 3, other // 3}
                chosen.append((one, other))
        if not chosen:
            break
        half = np.array(chosen)
        corner = [faces[half // 3, (half + k) % 3] for k in range(3)]  # its beginning, its end, and beside it: (P, 2)
        apex = vertices[corner[2]].mean(1)
        middle = (vertices[corner[0][:, 0]] + vertices[corner[1][:, 0]]) / 2
        middle += APART * (apex - middle)
        number = np.broadcast_to(len(vertices) + np.arange(len(half))[:, None], half.shape)
        vertices = np.concatenate([vertices, middle])
        faces = faces.copy()
        faces[half // 3] = np.stack([corner[0], number, corner[2]], -1)
        faces = np.concatenate([faces, np.stack([number, corner[1], corner[2]], -1).reshape(-1, 3)])
    return vertices, faces


def joined(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Pairs (P, 2) of half edges that belong together, 3 f + k being the one from corner k of triangle f to the next."""
    ends = np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2)
    ahead = ends[:, 0] < ends[:, 1]
    key = ends.min(1) * (int(faces.max(initial=0)) + 1) + ends.max(1)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.r_[True, np.diff(key[order]) > 0])
    many = np.diff(np.r_[first, len(order)])
    simple = first[many == 2]
    two = np.stack([order[simple], order[simple + 1]], 1)
    pairs = [two[ahead[two[:, 0]] != ahead[two[:, 1]]]]
    for begin, number in zip(first[many > 2], many[many > 2]):
        pairs.append(_around(vertices, faces, order[begin : begin + number], ahead))
    return np.concatenate(pairs)


def _around(vertices: np.ndarray, faces: np.ndarray, halves: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Pairs of half edges of one edge: each triangle with the next one, counter-clockwise, that the inside lies before."""
    face, corner = np.divmod(halves, 3)
    a, b = faces[face[0], corner[0]], faces[face[0], (corner[0] + 1) % 3]
    axis = unit(vertices[[max(a, b)]] - vertices[[min(a, b)]])[0]
    apex = vertices[faces[face, (corner + 2) % 3]] - vertices[min(a, b)]
    right = unit(np.cross(axis, np.eye(3)[[np.abs(axis).argmin()]]))[0]
    angle = np.arctan2(apex @ np.cross(axis, right), apex @ right)
    turn = halves[np.argsort(angle, kind="stable")].tolist()
    waiting, found = [], []
    for half in [*turn, *turn]:  # twice around, as the first inside may begin near the end
        if not ahead[half]:
            if half not in waiting and all(half != pair[0] for pair in found):
                waiting.append(half)
        elif waiting and all(half != pair[1] for pair in found):
            found.append((waiting.pop(), half))
    return np.array(found, np.int64).reshape(-1, 2)
