"""Depths of places that label maps leave out. Sky has no depth, but a field puts it somewhere."""

from __future__ import annotations

import numpy as np
import scipy

from ..data.pixels import VOID
from ..kernels.depth_arrays import FREE

NAMED = 0.5  # share of what photos confirm that label maps name, from which on what they leave out is mostly nothing
RIM = 5.0  # pixels around what is named to which comparing photos spreads its depth
WINDOW = 31  # pixels around a place in which what is left out is looked at
FARTHEST, FAR = (
    95,
    1.2,
)  # percentile of the depths that photos confirm in a view, beyond which, times this, things are far
AROUND = 0.125  # of the picture's width: window in which far things need depths that photos confirm
SIMILAR, SUPPORT = 0.12, 0.05  # share by which depths there may differ, and share of them that must be confirmed
CONFIRMED = 0.2  # as much as of what has a name, times this, photos must confirm of a thing, and not of sky
USUAL = 0.3  # share of what has a name that counts as confirmed at least: of an untrained field it is 0.04, by chance


def labels_tell(sure: list[np.ndarray], left_out: list[np.ndarray | None]) -> bool:
    """Whether what label maps leave out may be taken for nothing: they name most of what is surely there.

    Args:
        sure: which pixels (H, W) of each view have a depth that photos confirm; left_out: which its label map leaves out,
            None for a view without one.
    """
    labelled = [(part, out) for part, out in zip(sure, left_out) if out is not None]
    total = sum(int(part.sum()) for part, _ in labelled)
    return total > 0 and sum(int((part & ~out).sum()) for part, out in labelled) >= NAMED * total


def confirmed_share(
    hit: list[np.ndarray], sure: list[np.ndarray], labels: list[np.ndarray | None]
) -> tuple[np.ndarray, float]:
    """Share (256,) that photos confirm of what the field has of each class, and of all that have a name, but at least `USUAL`.

    Args:
        hit, sure: which pixels (H, W) of each view have a depth, and one that photos confirm; labels: class (H, W) uint8 of
            each pixel or VOID, None for views without label maps.
    """
    there, confirmed = np.zeros(256, int), np.zeros(256, int)
    for own, safe, label in zip(hit, sure, labels):
        if label is not None:
            there += np.bincount(label[own], minlength=256)
            confirmed += np.bincount(label[own & safe], minlength=256)
    named = np.arange(256) != VOID
    return confirmed / np.maximum(there, 1), max(float(confirmed[named].sum() / max(there[named].sum(), 1)), USUAL)


def named_things(labels: list[np.ndarray | None], confirmed: np.ndarray, usual: float) -> list[np.ndarray | None]:
    """Label maps (H, W) uint8 of only those classes that are things, and no sky or guess of the field: photos confirm at
    least a fifth as much of them as of all. VOID elsewhere. For the last two see `confirmed_share`."""
    thing = confirmed > CONFIRMED * usual
    return [None if label is None else np.where(thing[label], label, VOID).astype(np.uint8) for label in labels]


def nothing(left_out: np.ndarray, sure: np.ndarray, usual: float) -> np.ndarray:
    """Which pixels (H, W) of those left out by the label map show nothing that has a depth: photos confirm little of what is
    left out around them. One that they do confirm shows something, unless it is beside a named thing: windows of pixels
    that reach over an outline find the thing's depth outside of it.

    Args:
        sure: which pixels photos confirm; usual: share that they confirm of what has a name.
    """
    away = left_out & (np.asarray(scipy.ndimage.distance_transform_edt(left_out)) > RIM)
    rim = ~away & (_around(away) > 1e-4)
    judged = [_around(part & sure) < CONFIRMED * usual * _around(part) for part in (away, left_out)]
    doubted = np.where(away | rim, *judged)
    return left_out & doubted & (rim | ~sure)


def _around(there: np.ndarray) -> np.ndarray:
    """Share (H, W) of the pixels around each."""
    return np.asarray(scipy.ndimage.uniform_filter(there.astype(np.float32), WINDOW))


def farthest(depth: np.ndarray, sure: np.ndarray) -> float:
    """How far the depths (H, W) reach that photos confirm, `sure` (H, W) bool; inf where there are none."""
    known = depth[(depth > 0) & (depth < FREE) & sure]
    return float(np.percentile(known, FARTHEST)) if len(known) else np.inf


def backdrop(depth: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """Which pixels (H, W) of a depth map show a backdrop without a depth of its own, label maps or not: farther than what
    photos confirm in this view, and nothing of about the same depth is confirmed around.

    Args:
        depth: (H, W), 0 or FREE where there is none; sure: which of them photos confirm.
    """
    hit = (depth > 0) & (depth < FREE)
    far = hit & ~sure & (depth > FAR * farthest(depth, sure))
    if not far.any():
        return far
    size = int(AROUND * depth.shape[1]) | 1
    step = np.full(depth.shape, -(1 << 20))
    step[hit] = np.floor(np.log(depth[hit]) / SIMILAR)
    out = np.zeros(depth.shape, bool)
    for number in np.unique(step[far]):
        near = hit & (np.abs(step - number) <= 1)
        there, confirmed = (
            scipy.ndimage.uniform_filter(m.astype(np.float32), size, mode="constant") for m in (near, near & sure)
        )
        out |= far & (step == number) & (confirmed < SUPPORT * there)
    return out
