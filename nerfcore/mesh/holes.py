"""Small holes of a surface, filled.

Where views disagree at single places, as on the top of a step that all cameras see at a flat angle, a surface is full of
small holes. A loop of the border is cut into triangles from its middle, where that sees all of it, else such that they have the
least area, these into such that are hardly longer than the loop's edges, and what lies inside is drawn tight like a membrane: in a
hole of thirty voxels a ball's curvature is hardly seen.
Source: the triangles of least area of Barequet and Sharir, “Filling gaps in the boundary of a polyhedron”, 1995.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from .facelets import facelets
from .triangles import border_edges, cross, edge_ends, summed_around

LONGEST_LOOP = 100  # edges of a hole that is filled
SHEET = 0.5  # cosine, at least, of the angle between a sheet and what its border goes around
LONGER = 1.5  # times as long as the longest edge of the loops an edge inside of them may be
FLAT = 0.01  # share by which triangles of a flattened loop may hold more or less than it does


def fill_holes(
    vertices: np.ndarray, faces: np.ndarray, longest: int = LONGEST_LOOP, check: Callable[[], None] = lambda: None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Close border loops of at most `longest` edges: vertices, new ones at the end, triangles, and which of these (F,) bool
    are new. The borders of small sheets, which would get a back, are left alone. Raises what `check` raises to stop."""
    loops = [loop for loop in border_loops(faces) if 3 <= len(loop) <= longest]
    around, known = (
        summed_around(faces, cross(vertices, faces), len(vertices)),
        _edges_between(faces, loops, len(vertices)),
    )
    places, patches, count = [vertices], [faces], len(vertices)
    for loop in loops:
        check()
        if _bounds_sheet(vertices[loop], around[loop]):
            continue
        ring = loop[::-1]  # the other way around, as triangles beside each other have their common edge
        flat, normal = _flattened(vertices[ring])
        patch = _fan(len(ring))
        if not _covers(flat, np.append(flat, [flat.mean(0)], 0), patch):
            patch = _smallest(vertices[ring], _known_between(ring, known, len(vertices)))
            if patch is None:
                continue
        inside, patch = _membrane(vertices[ring], patch, normal)
        patches.append(np.append(ring, count + np.arange(len(inside)))[patch])
        places.append(inside)
        count += len(inside)
    found = np.concatenate(patches)
    return np.concatenate(places), found, np.arange(len(found)) >= len(faces)


def border_loops(faces: np.ndarray) -> Iterator[np.ndarray]:
    """Vertices (N,) of each loop of the border, in the direction of the triangles' edges. Where two loops meet in a vertex each
    goes on along its own hole; where more do, none goes on."""
    border = border_edges(faces)
    if not len(border):
        return
    after = _next_edges(faces, border)
    visited = np.zeros(len(border), bool)
    for start in range(len(border)):
        loop, here = [], start
        while here >= 0 and not visited[here]:
            visited[here] = True
            loop.append(here)
            here = after[here]
        if loop and here == start:
            yield border[loop, 0]


def _next_edges(faces: np.ndarray, border: np.ndarray) -> np.ndarray:
    """Number (E,) of the border edge that follows each of them (E, 2) around a hole, −1 where that is not clear."""
    order = np.argsort(border[:, 0], kind="stable")
    first = np.searchsorted(border[order, 0], border[:, 1])
    leaving = np.searchsorted(border[order, 0], border[:, 1], "right") - first
    after = np.where(leaving == 1, order[np.minimum(first, len(order) - 1)], -1)
    pinched = np.unique(border[leaving == 2, 1])
    number = {(int(a), int(b)): k for k, (a, b) in enumerate(border)}
    beside: dict[int, dict[int, int]] = {int(v): {} for v in pinched}
    for face in faces[np.isin(faces, pinched).any(1)].tolist():
        for k in range(3):
            if face[k] in beside:
                beside[face[k]][face[k - 2]] = face[k - 1]
    for vertex, turns in beside.items():
        ends = {}  # of the fans of triangles around the vertex: the edge that leaves it at one, to that which comes in at the other
        for begin in turns:
            if (vertex, begin) not in number:
                continue
            end, steps = begin, 0
            while end in turns and steps <= len(turns):
                end, steps = turns[end], steps + 1
            ends[begin] = end
        if len(ends) == 2 and all((end, vertex) in number for end in ends.values()):
            (one, one_end), (other, other_end) = ends.items()
            after[number[one_end, vertex]] = number[vertex, other]
            after[number[other_end, vertex]] = number[vertex, one]
    return after


def _bounds_sheet(loop: np.ndarray, normals: np.ndarray) -> bool:
    """Whether a loop (N, 3) of a border, whose triangles lie to its left and have these normals (N, 3), goes around a sheet, and
    not around a hole."""
    place = loop - loop.mean(0)
    area = np.cross(place, np.roll(place, -1, axis=0)).sum(0)
    within = np.linalg.norm(area) * np.linalg.norm(normals, axis=1).sum()
    return bool(area @ normals.sum(0) > SHEET * within)


def _flattened(ring: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A loop (N, 3) seen from where it is widest, and goes around to the left: (N, 2), and the direction (3,) from there."""
    place = ring - ring.mean(0)
    normal = np.cross(place, np.roll(place, -1, axis=0)).sum(0)
    normal /= max(float(np.linalg.norm(normal)), 1e-30)
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= max(float(np.linalg.norm(first)), 1e-30)
    return place @ np.stack([first, np.cross(normal, first)], 1), normal


def _smallest(ring: np.ndarray, taken: np.ndarray) -> np.ndarray | None:
    """Triangles (N − 2, 3) of the least area between the corners of a loop (N, 3); no edge lies between corners (N, N) bool that
    have one elsewhere. None where there are no such triangles."""
    count = len(ring)
    cost, middle = np.zeros((count, count)), np.zeros((count, count), int)
    for wide in range(2, count):
        first = np.arange(count - wide)
        last, between = first + wide, first[:, None] + np.arange(1, wide)
        sides = ring[between] - ring[first, None], (ring[last] - ring[first])[:, None]
        total = np.linalg.norm(np.cross(*sides), axis=2) / 2
        total += cost[first[:, None], between] + cost[between, last[:, None]]
        best = total.argmin(1)
        forbidden = taken[first, last] & (wide < count - 1)
        cost[first, last] = np.where(forbidden, np.inf, total[first, best])
        middle[first, last] = between[first, best]
    if not np.isfinite(cost[0, -1]):
        return None
    made, left = [], [(0, count - 1)]
    while left:
        first, last = left.pop()
        if last - first > 1:
            k = int(middle[first, last])
            made.append((first, k, last))
            left += [(first, k), (k, last)]
    return np.array(made)


def _fan(count: int) -> np.ndarray:
    """Triangles (N, 3) of a loop of N corners around its middle, the corner N; of three corners the one they have."""
    corner = np.arange(count)
    if count == 3:
        return corner[None]
    return np.stack([corner, np.roll(corner, -1), np.full(count, count)], 1)


def _covers(ring: np.ndarray, corners: np.ndarray, patch: np.ndarray) -> bool:
    """Whether triangles (T, 3) between corners (C, 2), none of them turned over, hold just what a polygon (N, 2) goes around."""
    a, b, c = corners[patch].transpose(1, 0, 2)
    double = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    ahead = np.roll(ring, -1, axis=0)
    whole = float((ring[:, 0] * ahead[:, 1] - ring[:, 1] * ahead[:, 0]).sum())
    return bool(double.min() >= 0 and abs(double.sum() - whole) <= FLAT * abs(whole))


def _edges_between(faces: np.ndarray, loops: list[np.ndarray], count: int) -> np.ndarray:
    """Sorted numbers (E,) of the edges of triangles, with `count` vertices, both ends of which lie on loops."""
    rim = np.zeros(count, bool)
    for loop in loops:
        rim[loop] = True
    ends = edge_ends(faces[rim[faces].sum(1) > 1]).astype(np.int64)
    return np.unique(ends[:, 0] * count + ends[:, 1])


def _known_between(ring: np.ndarray, known: np.ndarray, count: int) -> np.ndarray:
    """Whether there is an edge (N, N) between corners (N,) of a loop, or they are the same; `known`: sorted numbers of edges."""
    low, high = np.minimum(ring[:, None], ring), np.maximum(ring[:, None], ring)
    number = low.astype(np.int64) * count + high
    place = np.minimum(np.searchsorted(known, number), len(known) - 1)
    return (known[place] == number) | (low == high)


def _membrane(ring: np.ndarray, patch: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (M, 3) inside of a loop (N, 3), and triangles (T, 3) between its corners and them, for a patch between its corners
    and their middle, the corner N: cut until edges are hardly longer than the loop's. Heights along `normal` (3,) are the
    means of those around them, weighted with what is near."""
    count, longest = len(ring), np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1).max()
    fine = facelets(np.append(ring, [ring.mean(0)], 0), patch, limit=LONGER * float(longest))
    used, triangles = np.unique(np.append(np.arange(count), fine.faces), return_inverse=True)
    place, triangles = fine.vertices[used], triangles[count:].reshape(-1, 3)
    ends = np.unique(edge_ends(triangles), axis=0)
    pull = np.zeros((len(place), len(place)))
    near = 1 / np.maximum(np.linalg.norm(place[ends[:, 0]] - place[ends[:, 1]], axis=1), 1e-12 * longest)
    pull[ends[:, 0], ends[:, 1]] = pull[ends[:, 1], ends[:, 0]] = -near
    pull[np.diag_indices(len(place))] = -pull.sum(1)
    height = place @ normal
    tight = np.linalg.solve(pull[count:, count:], -pull[count:, :count] @ height[:count])
    return place[count:] + np.outer(tight - height[count:], normal), triangles
