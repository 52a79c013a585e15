"""Depths of the field beside depths that are known better: moved as the known ones around were.

A soft field is off by much the same over a whole wall, and in each view by something else, so that where photos say nothing
its views do not confirm each other. What photos and planes made of its depths beside such a place says by how much.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch.nn.functional import avg_pool2d, interpolate

from ..kernels.depth_arrays import FREE
from .depth_maps import DepthMap, FlatView, cosines

MOST_MOVED = 0.15  # logarithm of the ratio of two depths, above which they are of different things
PRIOR = 0.2  # weight, in pixels that are known, of what is known farther around


def moved_as_around(view: FlatView, field: DepthMap, known: np.ndarray) -> DepthMap:
    """The field's depth map with all depths multiplied as the known ones around are.

    Args:
        known: depths (H, W) that are known, 0 or FREE where none is.
    """
    both = (known > 0) & (known < FREE) & field.hit
    ratio = np.log(np.where(both, known, 1) / np.where(both, field.depth, 1))
    both &= np.abs(ratio) < MOST_MOVED
    around = push_pull(ratio, both)
    depth = np.where(field.hit, field.depth * np.exp(around), field.depth).astype(np.float32)
    return replace(field, depth=depth, cosine=cosines(view.camera, depth))


def push_pull(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Values (H, W) everywhere, smoothly, from those that are `known` (H, W) bool: means over ever larger squares, of which
    each place takes the smaller where they know something. 0 where nothing is known.

    Source: Gortler, Grzeszczuk, Szeliski and Cohen, "The lumigraph", 1996, section 3.3.
    """
    sums, weights = ([torch.from_numpy(a.astype(np.float32))[None, None]] for a in (np.where(known, values, 0), known))
    while max(sums[-1].shape[2:]) > 1:
        sums.append(avg_pool2d(sums[-1], 2, ceil_mode=True))
        weights.append(avg_pool2d(weights[-1], 2, ceil_mode=True))
    found = sums[-1] / weights[-1].clamp(min=1e-9)
    for own, amount in zip(sums[-2::-1], weights[-2::-1]):
        larger = interpolate(found, own.shape[2:], mode="bilinear", align_corners=False)
        found = (own + PRIOR * larger) / (amount + PRIOR)
    return found[0, 0].numpy()
