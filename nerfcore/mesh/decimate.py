"""Fewer triangles by quadric collapses, in chunks that keep their borders, so that it can be stopped at any time and
needs little memory (Garland and Heckbert, "Surface simplification using quadric error metrics", 1997)."""

from __future__ import annotations

import fast_simplification
import numpy as np
import scipy

from ..progress import Reporter
from .triangles import compact

CHUNK = 60_000  # faces simplified at once: a fraction of a second
SMALL_CHUNK = 1000  # where edges of more than two triangles undo what was done to a chunk
WHOLE = 1_000_000  # faces simplified as one piece, so that open borders can move and those of chunks need not: seconds
PASSES = 12
STALLED = 0.98  # share of its faces that a pass leaves, from which on the next ones are in vain
STEP = 2.0**-20  # of a mesh's size: what is nearer than that would be one vertex in a file of single precision
SIZE = 10_000.0  # of a mesh's longest side while it is simplified, about: fast-simplification's limits of error are of no unit
AT_ONCE = 0.25  # share of a chunk's faces that at least remain in one pass: its border is kept as it is until the next


def decimate(vertices: np.ndarray, faces: np.ndarray, target: int, report: Reporter) -> tuple[np.ndarray, np.ndarray]:
    """At most about `target` triangles of a mesh. Its open borders keep their place where they leave enough triangles to
    collapse.

    Each pass cuts elsewhere, so that what was the border of a chunk is inside the next time.
    """
    patch = np.zeros(len(faces), np.int64)
    vertices, faces, _ = _passes(vertices, faces, patch, target, True, CHUNK, report)
    return vertices, faces


def decimate_closed(
    vertices: np.ndarray, faces: np.ndarray, target: int, report: Reporter
) -> tuple[np.ndarray, np.ndarray]:
    """As `decimate`, with a closed mesh staying closed, so that more triangles than `target` may remain."""
    vertices, faces, _ = _passes(vertices, faces, np.zeros(len(faces), np.int64), target, False, SMALL_CHUNK, report)
    return vertices, faces


def decimate_patches(
    vertices: np.ndarray, faces: np.ndarray, patch: np.ndarray, target: int, report: Reporter
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `decimate`, with triangles of different patches (F,) never merged: the vertices of all borders between patches,
    and of open ones, stay where they are, and what was manifold remains so, so that more triangles than `target` may
    remain. Returns the patch of each triangle too."""
    return _passes(vertices, faces, patch, target, False, CHUNK, report)


def _passes(
    vertices: np.ndarray,
    faces: np.ndarray,
    patch: np.ndarray,
    target: int,
    move_borders: bool,
    size: int,
    report: Reporter,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if len(faces) <= target:
        return vertices, faces, patch
    total = len(faces) - target
    scale = enlargement(vertices)
    vertices = vertices * scale
    step = STEP * float(np.ptp(vertices, axis=0).max())
    for number in range(PASSES):
        before = len(faces)
        if before <= target:
            break
        report.progress(min(1.0, 1 - (before - target) / total))
        ratio = max(target / before, AT_ONCE)
        vertices, faces, patch = _one_pass(
            vertices, faces, patch, ratio, number, size, True, not move_borders, step, report
        )
        if not move_borders and size > SMALL_CHUNK:
            size = SMALL_CHUNK  # a chunk that simplifying would fold was left as it is
        elif len(faces) > STALLED * before:
            break
    if move_borders and target < len(faces) <= WHOLE:  # nothing but borders is left
        ratio = target / len(faces)
        vertices, faces, patch = _one_pass(vertices, faces, patch, ratio, 0, WHOLE, False, False, step, report)
    return vertices / scale, faces, patch


def enlargement(vertices: np.ndarray) -> float:
    """How many times larger a mesh with vertices (V, 3) is simplified, see `SIZE`: a power of two, so that borders come back to
    their place to the bit."""
    extent = float(np.ptp(vertices, axis=0).max())
    return float(2.0 ** np.round(np.log2(SIZE / extent))) if extent > 0 else 1.0


def _one_pass(
    vertices: np.ndarray,
    faces: np.ndarray,
    patch: np.ndarray,
    ratio: float,
    number: int,
    size: int,
    keep_border: bool,
    keep_manifold: bool,
    step: float,
    report: Reporter,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    centers = vertices[faces].mean(1)
    chunks = [
        own[part]
        for own in (np.flatnonzero(patch == p) for p in np.unique(patch))
        for part in _chunks(centers[own], number, size)
    ]
    whole = [compact(vertices, faces[chunk]) for chunk in chunks]
    made = []
    for points, triangles in whole:
        report.check()
        made.append(_simplified(points, triangles, ratio, keep_border or len(chunks) > 1))
    of_chunk = [int(patch[chunk[0]]) for chunk in chunks]
    folded, kept = _folded(faces), set[int]()
    manifold = np.array([not folded[chunk].any() for chunk in chunks])
    while True:
        joined, corners, chunk = _join(made, step)
        # Collapses on two sides of a border, or in a thin thing, may have made an edge of more than two triangles.
        undone = {i for i in np.unique(chunk[_folded(corners)]).tolist() if manifold[i]} - kept
        if not undone or not keep_manifold:
            return joined, corners, np.array(of_chunk)[chunk]
        for index in undone:
            made[index] = whole[index]
        kept |= undone


def _simplified(points: np.ndarray, triangles: np.ndarray, ratio: float, keep_border: bool) -> tuple:
    wanted = max(4, round(len(triangles) * ratio))
    if wanted >= len(triangles):
        return points, triangles
    points, triangles, *_ = fast_simplification.simplify(
        np.ascontiguousarray(points, np.float64),
        np.ascontiguousarray(triangles, np.int32),
        target_count=wanted,
        preserve_border=keep_border,
    )
    return points, triangles


def _folded(faces: np.ndarray) -> np.ndarray:
    """Which triangles (F,) bool lie at an edge of more than two."""
    edges = np.sort(np.stack([faces, np.roll(faces, -1, 1)], -1), -1).reshape(-1, 2).astype(np.int64)
    keys = edges[:, 0] * (int(faces.max(initial=0)) + 1) + edges[:, 1]
    _, index, count = np.unique(keys, return_inverse=True, return_counts=True)
    return (count[index.reshape(-1)] > 2).reshape(-1, 3).any(1)


def _chunks(centers: np.ndarray, number: int, size: int) -> list[np.ndarray]:
    """Places of triangles (N,) by their centres (N, 3) in chunks of at most `size`: halves of halves, cut across the
    longest side, at another share in each pass."""
    share = (0.5, 0.37, 0.61, 0.44, 0.56)[number % 5]
    waiting, done = [np.arange(len(centers))], []
    while waiting:
        part = waiting.pop()
        if len(part) <= size:
            done.append(part)
            continue
        axis = int(np.argmax(np.ptp(centers[part], axis=0)))
        cut = max(1, round(share * len(part)))
        order = np.argpartition(centers[part, axis], cut)
        waiting += [part[order[:cut]], part[order[cut:]]]
    return done


def _join(parts: list[tuple[np.ndarray, np.ndarray]], step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Chunks as one mesh, with the number of the chunk of each triangle, welded at the borders they kept, whose vertices are
    equal to the last bit, and along edges shorter than `step`, without triangles that lie on one another."""
    first = np.cumsum([0, *(len(points) for points, _ in parts)])
    vertices = np.concatenate([np.asarray(points, np.float64) for points, _ in parts])
    faces = np.concatenate([np.asarray(f, np.int64) + begin for (_, f), begin in zip(parts, first)])
    chunk = np.repeat(np.arange(len(parts)), [len(f) for _, f in parts])
    places, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    one, other = faces, np.roll(faces, -1, axis=1)
    short = np.linalg.norm(places[one] - places[other], axis=2) < step
    linked = scipy.sparse.coo_matrix((np.ones(short.sum(), bool), (one[short], other[short])), (len(places),) * 2)
    _, label = scipy.sparse.csgraph.connected_components(linked, False)
    faces = np.unique(label, return_index=True)[1][label[faces]]
    kept = np.flatnonzero((faces != np.roll(faces, 1, axis=1)).all(1))
    kept = kept[single(faces[kept])]
    return (*compact(places, faces[kept]), chunk[kept])


def single(faces: np.ndarray) -> np.ndarray:
    """Indices of the triangles (F, 3) that are left where some have the same vertices: none of a pair that looks both
    ways, as a flap without thickness does, and one of those that look the same way."""
    order = np.argsort(faces, axis=1)
    turned = np.where((order[:, 1] - order[:, 0]) % 3 == 1, 1, -1)
    _, group = np.unique(np.take_along_axis(faces, order, 1), axis=0, return_inverse=True)
    side = np.sign(np.bincount(group.reshape(-1), turned)).astype(int)[group.reshape(-1)]
    candidates = np.flatnonzero(side == turned)
    return candidates[np.unique(group.reshape(-1)[candidates], return_index=True)[1]]
