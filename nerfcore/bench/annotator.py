"""A simulated annotator: one stroke along the middle of each class that a photo shows, and corrections of what is wrong."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from skimage.measure import label as components
from skimage.morphology import medial_axis

LEAST_PIXELS = 200  # of a class in a photo, for a stroke of it
LONGEST = 0.2  # share of the skeleton that a stroke follows
JITTER = 0.3  # of the distance to the outline, that a hand goes astray
WIDTH = 3.0  # of the brush, pixels
EACH = 4  # pixels of the skeleton between the corners of a stroke


@dataclass(frozen=True)
class Stroke:
    """A stroke on a photo: points (N, 2) x, y in its pixels, and the id of the class."""

    photo: str
    points: np.ndarray
    class_id: int


def largest_component(mask: np.ndarray) -> np.ndarray:
    """The largest connected part (H, W) of a mask."""
    number = np.asarray(components(mask, connectivity=1))
    sizes = np.bincount(number.reshape(-1))
    sizes[0] = 0
    return number == sizes.argmax() if sizes.any() else np.zeros(mask.shape, bool)


def medial_stroke(mask: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Points (N, 2) x, y of a jittered stroke along at most a fifth of the skeleton of a connected mask (H, W)."""
    axis, distance = medial_axis(mask, return_distance=True, rng=0)
    rows, columns = np.nonzero(axis)
    inside = distance[rows, columns]
    # People begin where there is room.
    begin = random.choice(len(rows), p=inside**2 / (inside**2).sum())
    path = _walk(axis, (int(rows[begin]), int(columns[begin])), max(1, int(LONGEST * len(rows))))
    path = path[::EACH] if len(path) > EACH else path[:1]
    room = distance[path[:, 0], path[:, 1]][:, None]
    place = path[:, ::-1] + 0.5 + random.uniform(-1, 1, path.shape) * JITTER * room
    return place


def _walk(axis: np.ndarray, begin: tuple[int, int], most: int) -> np.ndarray:
    """Pixels (N, 2) row, column of a way along a skeleton from a pixel, at most `most` of them."""
    before: dict[tuple[int, int], tuple[int, int] | None] = {begin: None}
    waiting, last = deque([(begin, 1)]), begin
    while waiting:
        last, length = waiting.popleft()
        if length >= most:
            break
        for y in (last[0] - 1, last[0], last[0] + 1):
            for x in (last[1] - 1, last[1], last[1] + 1):
                inside = 0 <= y < axis.shape[0] and 0 <= x < axis.shape[1]
                if inside and axis[y, x] and (y, x) not in before:
                    before[y, x] = last
                    waiting.append(((y, x), length + 1))
    path: list[tuple[int, int]] = []
    step: tuple[int, int] | None = last
    while step is not None:
        path.append(step)
        step = before[step]
    return np.array(path[::-1])


def first_strokes(photo: str, truth: np.ndarray, class_ids: list[int], seed: int) -> list[Stroke]:
    """One stroke for each class that the label map (H, W) of a photo shows on enough pixels."""
    random = np.random.default_rng([seed, *photo.encode()])
    strokes = []
    for class_id in class_ids:
        if np.count_nonzero(truth == class_id) >= LEAST_PIXELS:
            strokes.append(Stroke(photo, medial_stroke(largest_component(truth == class_id), random), class_id))
    return strokes


def correction(maps: dict[str, tuple[np.ndarray, np.ndarray]], class_ids: list[int], seed: int) -> Stroke | None:
    """A stroke on the largest connected area that is wrong in one photo; None where nothing is.

    Args:
        maps: true and shown class ids (H, W) of photos by name.
    """
    amounts = {}
    for photo, (truth, shown) in maps.items():
        count = np.bincount(truth[truth != shown], minlength=max(class_ids) + 1)
        amounts.update({(photo, class_id): int(count[class_id]) for class_id in class_ids if count[class_id]})
    best: tuple[int, str, int, np.ndarray] | None = None
    for (photo, class_id), amount in sorted(amounts.items(), key=lambda item: -item[1]):
        if best is not None and amount <= best[0]:
            break  # no part is larger than the whole
        truth, shown = maps[photo]
        wrong = largest_component((truth == class_id) & (shown != class_id))
        size = int(np.count_nonzero(wrong))
        if best is None or size > best[0]:
            best = size, photo, class_id, wrong
    if best is None:
        return None
    _, photo, class_id, wrong = best
    return Stroke(photo, medial_stroke(wrong, np.random.default_rng([seed, 1])), class_id)
