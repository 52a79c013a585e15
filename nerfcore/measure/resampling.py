"""How much areas depend on which photos there happen to be: the votes for class borders, with photos drawn anew.

Source: Efron and Tibshirani, "An Introduction to the Bootstrap", 1993; whole photos are drawn, as errors within one
photo are not independent of each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

REPLICATES = 200
CHUNK = 20  # replicates at once


@dataclass(frozen=True)
class Votes:
    """What `count` photos say of P pieces of a surface: of M (photo, piece) pairs the number of the photo, the piece, and
    its vote (M, C) for each class."""

    count: int
    photo: np.ndarray
    piece: np.ndarray
    vote: np.ndarray


@dataclass(frozen=True)
class Pieces:
    """P pieces of a surface: centers (P, 3), areas (P,), index of their class (P,), −1 for void, and their instance (P,),
    0 for none."""

    centers: np.ndarray
    areas: np.ndarray
    label: np.ndarray
    instance: np.ndarray


def contested(votes: Votes, count: int) -> np.ndarray:
    """The pieces (of `count`) for which photos vote differently."""
    total = np.zeros((count, votes.vote.shape[1]))
    np.add.at(total, votes.piece, votes.vote)
    return np.flatnonzero((total > 0).sum(1) > 1)


def area_deviations(
    pieces: Pieces, votes: Votes, instances: int, replicates: int = REPLICATES, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviation of the area of each class (C,) and of each instance (I,), numbered from 1, over `replicates`
    draws of as many photos as there are, with replacement.

    A piece takes the class that most of the votes of the drawn photos have, and the instance of it that is nearest;
    where none of the drawn photos shows it, it stays what it is.
    """
    photos, classes = votes.count, votes.vote.shape[1]
    rows = contested(votes, len(pieces.areas))
    if not len(rows) or photos < 2:
        return np.zeros(classes), np.zeros(instances)
    index = np.full(len(pieces.areas), -1)
    index[rows] = np.arange(len(rows))
    of = index[votes.piece]
    used = np.flatnonzero(of >= 0)
    place = (of[used, None] * classes + np.arange(classes)).ravel()
    table = scipy.sparse.coo_matrix(
        (votes.vote[used].ravel(), (place, np.repeat(votes.photo[used], classes))), (len(rows) * classes, photos)
    ).tocsr()
    joins = instances_joined(pieces, rows, classes)
    area, present = pieces.areas[rows], pieces.label[rows]
    random = np.random.default_rng(seed)
    by_class, by_instance = np.zeros((replicates, classes)), np.zeros((replicates, instances + 1))
    for begin in range(0, replicates, CHUNK):
        many = min(CHUNK, replicates - begin)
        drawn = random.multinomial(photos, np.full(photos, 1 / photos), many)
        mass = (table @ drawn.T).reshape(len(rows), classes, many)
        label = np.where(mass.max(1) > 0, mass.argmax(1), present[:, None])
        for k in range(many):
            mine = label[:, k]
            known = mine >= 0
            by_class[begin + k] = np.bincount(mine[known], area[known], classes)
            joined = joins[np.arange(len(rows))[known], mine[known]]
            by_instance[begin + k] = np.bincount(joined, area[known], instances + 1)
    return by_class.std(0, ddof=1), by_instance.std(0, ddof=1)[1:]


def instances_joined(pieces: Pieces, rows: np.ndarray, classes: int) -> np.ndarray:
    """The instance (N, C) that each of the pieces `rows` would belong to if it were of each class: its own, or that of
    the nearest piece of the class."""
    joins = np.zeros((len(rows), classes), np.int64)
    for number in range(classes):
        own = np.flatnonzero(pieces.label == number)
        if not len(own):
            continue
        nearest = own[scipy.spatial.KDTree(pieces.centers[own]).query(pieces.centers[rows])[1]]
        joins[:, number] = pieces.instance[np.where(pieces.label[rows] == number, rows, nearest)]
    return joins
