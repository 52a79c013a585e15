"""Depths of plain places: planes through what is known around them.

Where photos show nothing to compare, the field's depths are noisy, but what has no texture is mostly a wall, a floor or
something smooth. The inverse depth of a plane is linear in the pixel's place, so the plane that fits a window best is a
weighted linear regression, and its sums over all windows are box filters.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy

from ..kernels.depth_arrays import FREE
from .depth_maps import EDGE, EDGE_PIXELS, DepthMap, FlatView, cosines

RADII = (0.05, 0.025, 0.0125)  # of windows, shares of the picture's width: the largest that is a plane is taken
SURE_PIXELS = 0.5  # standard deviation of depths that photos confirm, in footprints of a pixel
SOFT, LEAST_PIXELS = 0.5, 1.0  # of others: share of their spread, but at least so many footprints
MISFIT = 2.0  # mean square of deviations, in standard deviations, up to which a window is a plane
CONTRADICTS = 3.0  # standard deviations by which the field's depth may be off the plane, but no more than at an outline
FITTED_PIXELS = 3.0  # spread of a depth on a plane, in footprints
FILLED = 0.5  # share of a window that must be known
OUTLIER = 2.0  # standard deviations from a first fit, from where on a depth counts less in the second


def with_planes(view: FlatView, map_: DepthMap, sure: np.ndarray) -> DepthMap:
    """A depth map whose depths that are not `sure` (H, W) bool lie on planes, where a window around them is a plane within
    what is known of them."""
    depth, spread = map_.depth.copy(), map_.spread.copy()
    pixel = 1 / view.camera.fx  # footprint over depth
    soft = np.maximum(SOFT * map_.spread / np.where(map_.hit, depth, 1), LEAST_PIXELS * pixel)
    sigma = np.where(sure, SURE_PIXELS * pixel, soft)
    edge = max(EDGE, EDGE_PIXELS * pixel)
    todo = map_.hit & ~sure
    for share in RADII:
        plane, misfit = fitted(map_.depth, sigma, max(2, round(share * view.camera.width)))
        near = np.abs(plane - map_.depth) < np.minimum(CONTRADICTS * sigma, edge) * map_.depth
        found = todo & (plane > 0) & (misfit < MISFIT) & near
        depth[found], spread[found] = plane[found], FITTED_PIXELS * pixel * plane[found]
        todo &= ~found
    return replace(map_, depth=depth, spread=spread, cosine=cosines(view.camera, depth))


def fitted(depth: np.ndarray, sigma: np.ndarray, radius: int) -> tuple[np.ndarray, np.ndarray]:
    """For each pixel the depth there of the plane that fits the window of `radius` around it, and the mean square of the
    deviations from it in standard deviations.

    Args:
        depth: (H, W), 0 or FREE where there is none; sigma: (H, W) relative standard deviation of each.
    Returns:
        (H, W) float64 each; 0 and inf where less than half of the window is known, or no plane is determined.
    """
    height, width = depth.shape
    known = (depth > 0) & (depth < FREE)
    if not known.any():
        return np.zeros(depth.shape), np.full(depth.shape, np.inf)
    inverse = np.where(known, 1 / np.where(known, depth, 1), 0).astype(np.float64)
    inverse /= (scale := inverse[known].mean())
    deviation = np.maximum(sigma * inverse, 1e-9)
    y, x = np.mgrid[:height, :width] / width - 0.5
    base = np.where(known, 1 / deviation**2, 0)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.asarray(scipy.ndimage.uniform_filter(values, 2 * radius + 1, mode="constant"))

    def regression(weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Inverse depth on the plane, weighted sum of squared deviations over the window's area, and whether the window
        holds more than a line of pixels."""
        total = np.maximum(mean(weight), 1e-12)
        mx, my, md = (mean(weight * v) / total for v in (x, y, inverse))
        xx, xy, yy = (mean(weight * a * b) / total for a, b in ((x, x), (x, y), (y, y)))
        xd, yd, dd = (mean(weight * a * inverse) / total for a in (x, y, inverse))
        xx, xy, yy, xd, yd, dd = xx - mx * mx, xy - mx * my, yy - my * my, xd - mx * md, yd - my * md, dd - md * md
        determinant = xx * yy - xy * xy
        solvable = determinant > 1e-3 * (radius / width) ** 4
        divisor = np.where(solvable, determinant, 1)
        across, down = (yy * xd - xy * yd) / divisor, (xx * yd - xy * xd) / divisor
        left = np.maximum(dd - across * xd - down * yd, 0) * total
        return md + across * (x - mx) + down * (y - my), left, solvable

    plane, _, _ = regression(base)
    plane, left, solvable = regression(base / (1 + ((inverse - plane) / (OUTLIER * deviation)) ** 2))
    filled = mean(known.astype(np.float64))
    good = solvable & (plane > 0) & (filled > FILLED)
    misfit = left / np.maximum(filled, 1e-9)
    return np.where(good, 1 / (scale * np.where(good, plane, 1)), 0), np.where(good, misfit, np.inf)
