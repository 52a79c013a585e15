"""Fewer triangles by quadric collapses, in chunks that keep their borders, so that it can be stopped at any time and
needs little memory (Garland and Heckbert, "Surface simplification using quadric error metrics", 1997)."""

from __future__ import annotations

import fast_simplification
import numpy as np

from ..progress import Reporter
from .clean import compact

CHUNK = 60_000  # faces simplified at once: a fraction of a second
PASSES = 12
AT_ONCE = 0.25  # share of a chunk's faces that at least remain in one pass: its border is kept as it is until the next


def decimate(vertices: np.ndarray, faces: np.ndarray, target: int, report: Reporter) -> tuple[np.ndarray, np.ndarray]:
    """At most about `target` triangles of a mesh. Its open borders keep their place where they leave enough triangles to
    collapse.

    Each pass cuts elsewhere, so that what was the border of a chunk is inside the next time.
    """
    total = max(len(faces) - target, 1)
    for number in range(PASSES):
        if len(faces) <= target:
            break
        report.progress(min(1.0, 1 - (len(faces) - target) / total))
        before = len(faces)
        ratio = max(target / len(faces), AT_ONCE)
        keep = number < PASSES - 2
        vertices, faces = _one_pass(vertices, faces, ratio, number, keep, report)
        if keep and len(faces) > 0.98 * before:  # nothing but borders is left
            vertices, faces = _one_pass(vertices, faces, ratio, number, False, report)
    return vertices, faces


def _one_pass(
    vertices: np.ndarray, faces: np.ndarray, ratio: float, number: int, keep_border: bool, report: Reporter
) -> tuple[np.ndarray, np.ndarray]:
    chunks = _chunks(vertices[faces].mean(1), number)
    made, corners, first = [], [], 0
    for chunk in chunks:
        report.check()
        points, triangles = compact(vertices, faces[chunk])
        wanted = max(4, round(len(triangles) * ratio))
        if wanted < len(triangles):
            points, triangles, *_ = fast_simplification.simplify(
                np.ascontiguousarray(points, np.float64),
                np.ascontiguousarray(triangles, np.int32),
                target_count=wanted,
                preserve_border=keep_border or len(chunks) > 1,
            )
        made.append(np.asarray(points, np.float64))
        corners.append(np.asarray(triangles, np.int64) + first)
        first += len(points)
    return _join(np.concatenate(made), np.concatenate(corners))


def _chunks(centers: np.ndarray, number: int) -> list[np.ndarray]:
    """Places of triangles (N,) by their centres (N, 3) in chunks of at most `CHUNK`: halves of halves, cut across the
    longest side, at another share in each pass."""
    share = (0.5, 0.37, 0.61, 0.44, 0.56)[number % 5]
    waiting, done = [np.arange(len(centers))], []
    while waiting:
        part = waiting.pop()
        if len(part) <= CHUNK:
            done.append(part)
            continue
        axis = int(np.argmax(np.ptp(centers[part], axis=0)))
        cut = max(1, round(share * len(part)))
        order = np.argpartition(centers[part, axis], cut)
        waiting += [part[order[:cut]], part[order[cut:]]]
    return done


def _join(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weld the borders that chunks kept: their vertices are equal to the last bit."""
    places, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    proper = (faces != np.roll(faces, 1, axis=1)).all(1)
    return compact(places, faces[proper])
