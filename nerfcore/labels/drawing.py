"""Which pixels a mark covers."""

from __future__ import annotations

import numpy as np
import skimage

THINNEST = 1.42  # diagonal of a pixel: a thinner line would pass between the centres of pixels


def covered(shape: str, points: np.ndarray, width: float, columns: int, rows: int) -> np.ndarray:
    """Pixels (rows, columns) bool whose centres a mark covers.

    Args:
        shape: "line" (a round brush along the points), "outline" (the area inside them, their places where it is too thin
            for the centre of a pixel), "click" (discs at them) or "part" (the same).
        points: (N, 2) x, y in pixels; width: diameter of the brush in pixels.
    """
    found = np.zeros((rows, columns), bool)
    if shape == "outline" and len(points) >= 3:
        inside = skimage.draw.polygon2mask((rows, columns), points[:, ::-1] - 0.5)
        if inside.any():
            return inside
        shape, width = "click", THINNEST
    ends = zip(points, points) if shape in ("click", "part") or len(points) == 1 else zip(points[:-1], points[1:])
    radius = max(width, THINNEST) / 2
    for begin, end in ends:
        _add_segment(found, begin, end, radius)
    return found


def _add_segment(found: np.ndarray, begin: np.ndarray, end: np.ndarray, radius: float) -> None:
    """Add pixels at most `radius` from the line between two points."""
    rows, columns = found.shape
    low, high = np.minimum(begin, end) - radius - 1, np.maximum(begin, end) + radius + 1
    left, top = np.clip(np.floor(low), 0, [columns, rows]).astype(int)
    right, bottom = np.clip(np.ceil(high), 0, [columns, rows]).astype(int)
    x, y = np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5)
    along = end - begin
    length = float(along @ along)
    share = ((x - begin[0]) * along[0] + (y - begin[1]) * along[1]) / length if length > 0 else 0.0 * x
    share = np.clip(share, 0, 1)
    distance = np.hypot(x - begin[0] - share * along[0], y - begin[1] - share * along[1])
    found[top:bottom, left:right] |= distance <= radius
