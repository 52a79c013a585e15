"""The outline of a mask, as marks have it."""

from __future__ import annotations

import numpy as np

from ...errors import InputError

TOLERANCE = 0.5  # pixels that the outline may differ
LEAST = 3  # corners


def outline_of(mask: np.ndarray) -> list[tuple[float, float]]:
    """Corners x, y in pixels of one outline around all parts of a mask (H, W), holes left out: from each part the way goes
    back to the first corner, so that what is inside is counted by how often the outline is crossed.

    Raises:
        InputError: the mask is empty.
    """
    from skimage.measure import approximate_polygon, find_contours  # half a second

    padded = np.pad(mask.astype(np.float32), 1)
    loops = [approximate_polygon(loop, TOLERANCE) for loop in find_contours(padded, 0.5)]
    loops = [loop for loop in loops if len(loop) > LEAST]  # the last corner is the first one again
    if not loops:
        raise InputError("The model found nothing there.", "Click in the middle of the thing, or draw a box around it.")
    loops.sort(key=lambda loop: -len(loop))
    first = loops[0][:1]
    path = np.concatenate([part for loop in loops for part in (loop, first)])
    return [(round(float(x) - 0.5, 2), round(float(y) - 0.5, 2)) for y, x in path]
