"""Which photo paints which facelet: what the photos show of each, who disagrees, and a smooth choice among the rest.

All colours are linear light.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ..images.exposure import common_gains
from ..progress import Reporter
from .facelets import Facelets
from .photos import LINEAR, Photo, halvings, sample
from .visibility import Observations, in_parallel

FLAT_GRADIENT = (
    0.02  # what a picture without any texture is worth; else near, frontal views of plain walls would count nothing
)
ENOUGH_VIEWS = 4  # fewer cannot say who is wrong
AGREE = 0.06  # difference of sRGB values at which photos still agree
SMOOTHNESS = 0.25  # cost of an edge between two photos; a photo without any worth costs 1
ROUNDS = 10  # of belief propagation
DARK = 0.01  # linear light that ratios are kept away from


@dataclass(frozen=True)
class Looks:
    """What the best views of F facelets show: color (F, K, 3) mean over the facelet; worth (F, K), 0 where nothing may
    be taken from that view."""

    color: np.ndarray
    worth: np.ndarray


def look(photos: list[Photo], pieces: Facelets, seen: Observations, report: Reporter) -> Looks:
    """Read every photo once: mean colour and gradient of each facelet in its best views. Masked pixels count nothing."""
    color = np.zeros((*seen.view.shape, 3), np.float32)
    worth = np.zeros(seen.view.shape, np.float32)

    def read(number: int) -> Any:
        face, column = seen.of(number)
        if not len(face):
            return face, column, np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
        view, rgba = photos[number].view, photos[number].read()
        local = view.local(pieces.centers[face])
        towards = view.center - pieces.centers[face]
        cosine = np.einsum("ij,ij->i", towards, pieces.normals[face]) / np.linalg.norm(towards, axis=1)
        across = np.sqrt(pieces.areas[face] * cosine) / view.footprint(view.depth(local))
        level = np.log2(np.maximum(across, 1)).astype(int)
        usable = rgba[..., 3] > 0
        grey = torch.from_numpy(rgba[..., :3].astype(np.float32).mean(2) / 255)
        down, right = torch.gradient(grey)
        planes = [*LINEAR[rgba[..., :3]].transpose(2, 0, 1), np.hypot(down.numpy(), right.numpy())]
        stack = torch.from_numpy(np.stack([*(plane * usable for plane in planes), usable]).astype(np.float32))
        values = sample(halvings(stack, 8), view.pixels(local), level).numpy()
        share = np.maximum(values[:, 4:], 1e-6)
        value = seen.weight[face, column] * (values[:, 3] / share[:, 0] + FLAT_GRADIENT) * (values[:, 4] > 0.9)
        return face, column, values[:, :3] / share, value

    for _, (face, column, found, value) in in_parallel(read, range(len(photos)), report, "photos"):
        color[face, column], worth[face, column] = found, value
    return Looks(color, worth)


def weighted_median(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Of values (F, K, C) with weights (F, K) ≥ 0, some of them positive: the medians (F, C)."""
    order = np.argsort(values, axis=1)
    ordered = np.take_along_axis(values, order, 1)
    total = np.cumsum(np.take_along_axis(np.broadcast_to(weights[..., None], values.shape), order, 1), 1)
    place = (total < total[:, -1:] / 2).sum(1)
    return np.take_along_axis(ordered, np.minimum(place, values.shape[1] - 1)[:, None], 1)[:, 0]


def photo_gains(view: np.ndarray, looks: Looks, photos: int, most: int = 60_000) -> np.ndarray:
    """What each photo's colours must be multiplied with to agree with the others where several show a facelet: (photos, 3),
    see `exposure.common_gains`."""
    plain = (looks.worth > 0) & (looks.color.min(2) > 0.004) & (looks.color.max(2) < 0.95)
    shared = np.flatnonzero(plain.sum(1) >= 2)
    if not len(shared):
        return np.ones((photos, 3), np.float32)
    shared = shared[:: -(-len(shared) // most)]
    return common_gains(view[shared], np.maximum(looks.color[shared], 1e-4), plain[shared], photos)


def agreeing(pieces: Facelets, view: np.ndarray, looks: Looks) -> np.ndarray:
    """Which views (F, K) show what most views of a facelet show.

    Of at least `ENOUGH_VIEWS` views one is left out when it is farther from their median than three times the usual
    distance; far off, it is left out on the neighbours too, which a part of what it shows may touch.
    """
    valid = looks.worth > 0
    shown = np.maximum(looks.color, 0) ** (1 / 2.2)
    middle = weighted_median(shown, valid.astype(np.float32))
    off = np.where(valid, np.abs(shown - middle[:, None]).max(2), 0)
    usual = weighted_median(off[..., None].astype(np.float32), valid.astype(np.float32))[:, 0]
    limit = np.maximum(AGREE, 3 * 1.4826 * usual)[:, None]
    judged = (valid.sum(1) >= ENOUGH_VIEWS)[:, None]
    wrong = judged & (off > limit)
    far = np.where(judged & (off > 2 * limit), view, -2)
    for edge in range(3):
        other = pieces.neighbours[:, edge]
        beside = np.where((other >= 0)[:, None], far[other], -2)
        wrong |= judged & (view[:, :, None] == beside[:, None, :]).any(2)
    # Somebody has to be right.
    wrong &= ~(wrong | ~valid).all(1)[:, None]
    return valid & ~wrong


def matches(pieces: Facelets, view: np.ndarray) -> np.ndarray:
    """For the edges of each facelet and its views: the column of the same view at the neighbour, −1 without: (3, K, F)."""
    columns = view.shape[1]
    result = np.full((3, columns, len(view)), -1, np.int8)
    for edge in range(3):
        other = pieces.neighbours[:, edge]
        theirs = np.where((other >= 0)[:, None], view[other], -2)
        for column in range(columns):
            same = (theirs == view[:, column, None]) & (view[:, column, None] >= 0)
            result[edge, column] = np.where(same.any(1), same.argmax(1), -1)
    return result


def choose(pieces: Facelets, same: np.ndarray, worth: np.ndarray, report: Reporter) -> np.ndarray:
    """One view for each facelet: its column (F,) int8, −1 where `worth` (F, K) is 0 for all.

    A Potts model, whose minimum loopy belief propagation approaches: a view costs 1 − worth / its 99.5th percentile,
    neighbours with different views cost `SMOOTHNESS`. `same`: see `matches`.
    """
    top = max(float(np.percentile(worth[worth > 0], 99.5)) if (worth > 0).any() else 1.0, 1e-30)
    cost = np.where(worth > 0, 1 - np.minimum(worth / top, 1), 1e3).T.astype(np.float32)
    message = np.zeros((3, *cost.shape), np.float32)
    belief = cost
    for turn in range(ROUNDS):
        report.progress(turn / ROUNDS)
        fresh = np.empty_like(message)
        for edge in range(3):
            other, slot = pieces.neighbours[:, edge], pieces.opposite[:, edge]
            there = np.maximum(other, 0)
            # What the neighbour believes, but for what it has from here.
            without = belief[:, there] - message[slot, :, there].T
            low = without.min(0)
            column = same[edge].astype(np.int64)
            kept = np.where(column >= 0, np.take_along_axis(without, np.maximum(column, 0), 0), np.inf)
            said = np.minimum(low + SMOOTHNESS, kept) - low
            fresh[edge] = np.where(other >= 0, said, 0)
        message = (message + fresh) / 2
        belief = cost + message.sum(0)
    return np.where((worth > 0).any(1), belief.argmin(0), -1).astype(np.int8)


def towards_common(
    pieces: Facelets, same: np.ndarray, looks: Looks, keep: np.ndarray, weight: np.ndarray, rounds: int = 3
) -> np.ndarray:
    """Logarithm of what brings each view's broad colour to the one all views have in common: (F, K, 3).

    The common colour is the median over views weighted by `weight` (F, K), in which highlights drop out. The factors
    are smoothed over neighbours that the same view sees, so that what is finer stays as the photo has it.
    """
    common = weighted_median(looks.color, np.where(keep, weight, 0))
    ratio = np.log((common[:, None] + DARK) / (looks.color + DARK)).clip(-0.7, 0.7) * keep[..., None]
    ratio = np.ascontiguousarray(ratio.transpose(1, 0, 2))
    mine = keep.T.astype(np.float32)
    for _ in range(rounds):
        total, number = ratio * mine[..., None], mine.copy()
        for edge in range(3):
            column = same[edge].astype(np.int64)
            there = np.maximum(pieces.neighbours[:, edge], 0)
            good = (column >= 0) & (mine[np.maximum(column, 0), there] > 0)
            total += np.where(good[..., None], ratio[np.maximum(column, 0), there], 0)
            number += good
        ratio = total / np.maximum(number, 1)[..., None]
    return ratio.transpose(1, 0, 2)
