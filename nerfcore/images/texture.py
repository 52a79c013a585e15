"""How much of a texture a picture has, beside light that changes evenly."""

from __future__ import annotations

import numpy as np
import scipy


def left_of_slopes(grey: np.ndarray, size: int) -> np.ndarray:
    """Variance (H, W) of a picture (H, W) in windows of `size` pixels a side, an odd number, less that of the slope of grey
    that fits each best; float64, and where there is nothing left as little below 0 as numbers round."""
    grey = grey.astype(np.float64)
    mean = scipy.ndimage.uniform_filter(grey, size)
    left = scipy.ndimage.uniform_filter(grey * grey, size) - mean * mean
    steps = np.arange(size) - size // 2
    for axis in (0, 1):
        product = scipy.ndimage.correlate1d(grey, steps / size, axis=axis)
        left -= scipy.ndimage.uniform_filter1d(product, size, axis=1 - axis) ** 2 / (steps**2).mean()
    return left
