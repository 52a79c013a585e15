"""Bringing the surface of one epoch over that of another: by common points, or by the surfaces themselves.

Source: Chetverikov et al., "The trimmed iterative closest point algorithm", 2002, with the distance to planes of Chen and
Medioni, "Object modelling by registration of multiple range images", 1992. What has changed between the epochs falls
among the pairs that are trimmed away. Which start was right all points say, each by no more than a set distance: of the
pairs that are left the worst may be trimmed because they lie wrongly.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy

from ..errors import InputError
from ..progress import Reporter
from .similarity import fit_similarity, make_similarity, similarity_scale, transform_points

KEPT = 0.7  # of the pairs that a step goes by
KEPT_TRYING = 0.9  # while it is tried how they lie: with fewer, parts that fit by chance hold on to each other
TURNS = 12  # about z that are tried where nothing says how the epochs lie to each other
FEW, MANY = 1000, 10_000  # points for trying, and for the result
BEST, WORST = 4, 1.5  # starts that are refined, and how many times the best score they may have; not tuned
FARTHEST = 0.02  # of the size: what is farther apart tells one start from another no better
TIE = 0.02  # by how much a score may be worse than the best: symmetric things differ by less in their noise
STEPS = 40
STILL = 1e-6  # of the size: a step below this is the last
COLUMNS = ["name", "x", "y", "z", "other_x", "other_y", "other_z"]
HINT = f"Write a table with the columns {','.join(COLUMNS)} and at least three points that are not in a line."


@dataclass(frozen=True)
class Registered:
    """transform (4, 4) from the other epoch to this one; rms: of the distances that were left (kept pairs, or common
    points), in units of this one."""

    transform: np.ndarray
    rms: float


def by_points(path: Path, with_scale: bool) -> Registered:
    """The transform by common points of a .csv file with the columns `COLUMNS`.

    Raises:
        InputError: the file is missing or of another form, or its points are too few.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            rows = [[float(row[name]) for name in COLUMNS[1:]] for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error, KeyError, TypeError, ValueError) as error:
        raise InputError(f"The common points {path} cannot be read: {error}.", HINT) from error
    here, there = np.array(rows, np.float64).reshape(-1, 2, 3).transpose(1, 0, 2)
    usable = len(there) >= 3 and np.isfinite([here, there]).all()
    spread = np.linalg.svd(there - there.mean(0), compute_uv=False) if usable else np.zeros(3)
    if spread[1] <= 1e-6 * spread[0]:
        raise InputError(f"The common points {path} do not say how the epochs lie to each other.", HINT)
    transform = fit_similarity(there, here, with_scale)
    left = transform_points(transform, there) - here
    return Registered(transform, float(np.sqrt((left**2).sum(1).mean())))


def by_surfaces(
    here: tuple[np.ndarray, np.ndarray], there: np.ndarray, with_scale: bool, report: Reporter
) -> Registered:
    """The transform that brings points (M, 3) of the other epoch onto the surface of this one.

    First as they lie, and turned about z by steps with their middles together. Where they fit as they lie about as well as
    after any turn, they are not turned; else the best few are refined, and the best of these is taken.

    Args:
        here: points (N, 3) and unit normals (N, 3) of this epoch. with_scale: the sizes may differ too.
    """
    points, normals = here
    trees = scipy.spatial.KDTree(points), scipy.spatial.KDTree(there)
    few, many = (there[:: max(1, len(there) // count)] for count in (FEW, MANY))
    some = points[:: max(1, len(points) // FEW)]
    sizes = [float(np.sqrt(((p - np.median(p, 0)) ** 2).sum(1).mean())) for p in (points, there)]
    factor = sizes[0] / max(sizes[1], 1e-12) if with_scale else 1.0
    starts = [np.eye(4)]
    for turn in range(TURNS):
        rotation = scipy.spatial.transform.Rotation.from_euler("z", 360 * turn / TURNS, degrees=True).as_matrix()
        middle = np.median(points, 0) - factor * rotation @ np.median(there, 0)
        starts.append(make_similarity(factor, rotation, middle))

    def score(found: Registered) -> float:
        return _apart(trees, (some, few), found.transform)

    tried = []
    for number, start in enumerate(starts):
        report.progress(number / len(starts))
        tried.append(_refined(trees[0], points, normals, few, start, KEPT_TRYING, False, STEPS // 2))
    scores = [score(found) for found in tried]
    best = [n for n in np.argsort(scores, kind="stable")[:BEST].tolist() if scores[n] <= WORST * min(scores)]
    if scores[0] <= (1 + TIE) * min(scores):
        best = [0]
    refined = []
    for start in _distinct([tried[number].transform for number in best], few, _farthest(points)):
        report.check()
        refined.append(_refined(trees[0], points, normals, many, start, KEPT, with_scale, STEPS))
    return min(refined, key=score)


def _apart(
    trees: tuple[scipy.spatial.KDTree, scipy.spatial.KDTree],
    points: tuple[np.ndarray, np.ndarray],
    transform: np.ndarray,
) -> float:
    """Mean distance from points of each epoch, this one and the other one (N, 3), to the other's (of `trees`), each up to
    `FARTHEST`, in units of this one. Both ways, for what has shrunk to a dot is near to everything it lies on."""
    farthest = _farthest(trees[0].data)
    scale, back = similarity_scale(transform), np.linalg.inv(transform)
    # What is farther than that is found to be infinitely far.
    to_this = trees[0].query(transform_points(transform, points[1]), distance_upper_bound=farthest)[0]
    to_other = trees[1].query(transform_points(back, points[0]), distance_upper_bound=farthest / scale)[0]
    return float(np.minimum(to_this, farthest).mean() + np.minimum(scale * to_other, farthest).mean()) / 2


def _farthest(points: np.ndarray) -> float:
    return FARTHEST * float(np.ptp(points, axis=0).max())


def _distinct(transforms: list[np.ndarray], points: np.ndarray, least: float) -> list[np.ndarray]:
    """The first of those transforms (4, 4) that bring points (N, 3) to less than `least` from each other, on average."""
    chosen: list[np.ndarray] = []
    for transform in transforms:
        moved = transform_points(transform, points)
        apart = [np.linalg.norm(transform_points(other, points) - moved, axis=1).mean() for other in chosen]
        if min(apart, default=np.inf) >= least:
            chosen.append(transform)
    return chosen


def _refined(
    tree: scipy.spatial.KDTree,
    points: np.ndarray,
    normals: np.ndarray,
    moving: np.ndarray,
    start: np.ndarray,
    share: float,
    scaled: bool,
    steps: int,
) -> Registered:
    """Steps from a start by a share of the pairs: first to the nearest points, then to the planes through them.

    Only the latter change the size: points that are drawn to their nearest ones would shrink to a dot.
    """
    transform, rms = start, np.inf
    still = STILL * float(np.ptp(points, axis=0).max())
    for planes in (False, True):
        for _ in range(steps // 2):
            moved = transform_points(transform, moving)
            distance, nearest = (np.asarray(part) for part in tree.query(moved))
            kept = np.argsort(distance)[: max(6, int(share * len(moved)))]
            target = nearest[kept]
            if planes:
                change, left = _to_planes(moved[kept], points[target], normals[target], scaled)
            else:
                change, left = fit_similarity(moved[kept], points[target], False), distance[kept]
            transform, rms = change @ transform, float(np.sqrt((left**2).mean()))
            if np.abs(transform_points(change, moved[kept]) - moved[kept]).max() < still:
                break
    return Registered(transform, rms)


def _to_planes(
    moved: np.ndarray, target: np.ndarray, normal: np.ndarray, scaled: bool
) -> tuple[np.ndarray, np.ndarray]:
    """The small similarity (4, 4) that brings points (N, 3) nearest to planes, and their distances (N,) before it."""
    middle = moved.mean(0)
    arm, off = moved - middle, ((moved - target) * normal).sum(1)
    columns = [np.cross(arm, normal), normal, *([(arm * normal).sum(1)[:, None]] if scaled else [])]
    solved = np.linalg.lstsq(np.concatenate(columns, 1), -off, rcond=1e-9)[0]
    rotation, factor = (
        scipy.spatial.transform.Rotation.from_rotvec(solved[:3]).as_matrix(),
        1 + (float(solved[6]) if scaled else 0.0),
    )
    return make_similarity(factor, rotation, middle + solved[3:6] - factor * rotation @ middle), off
