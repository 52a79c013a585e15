"""What `patches.refine` must give, in double precision; a plane's points are found from rays that meet it."""

from __future__ import annotations

import numpy as np
from fieldwork.nerfcore.kernels.depth_arrays import FREE, MapArrays
from scipy.ndimage import map_coordinates

GRID = np.stack(np.meshgrid(np.arange(-2, 3), np.arange(-2, 3)), -1).reshape(25, 2)  # x fastest
FLATTEST = 2e-5


class Views:
    """The maps' cameras and photos as numpy arrays."""

    def __init__(self, maps: MapArrays, grey: np.ndarray) -> None:
        self.lens = maps.lens.cpu().double().numpy()
        self.rotation, self.translation = maps.rotation.cpu().double().numpy(), maps.translation.cpu().double().numpy()
        spans = [(int(b), w, h) for b, (w, h) in zip(maps.first.tolist(), maps.size.tolist())]
        self.grey = [grey[b : b + w * h].reshape(h, w).astype(float) for b, w, h in spans]
        self.depth = [maps.depth.cpu().double().numpy()[b : b + w * h].reshape(h, w) for b, w, h in spans]
        self.spread = [maps.spread.cpu().double().numpy()[b : b + w * h].reshape(h, w) for b, w, h in spans]

    def seen(
        self, view: int, other: int, pixel: np.ndarray, normal: np.ndarray, z: float, at: np.ndarray
    ) -> np.ndarray:
        """Where pixels `at` (N, 2) of a plane appear in another view, and their depth there: (N, 3). The plane goes
        through `pixel` at depth z."""
        fx, fy, cx, cy = self.lens[view]

        def rays(p: np.ndarray) -> np.ndarray:
            return np.stack([(p[..., 0] - cx) / fx, (p[..., 1] - cy) / fy, np.ones(p.shape[:-1])], -1)

        through, directions = rays(pixel) * z, rays(at)
        points = directions * ((normal @ through) / np.minimum(directions @ normal, -1e-3))[:, None]
        world = (points - self.translation[view]) @ self.rotation[view]
        q = world @ self.rotation[other].T + self.translation[other]
        fx, fy, cx, cy = self.lens[other]
        return np.stack([fx * q[:, 0] / q[:, 2] + cx, fy * q[:, 1] / q[:, 2] + cy, q[:, 2]], 1)

    def correlation(self, view: int, other: int, pixel: np.ndarray, normal: np.ndarray, z: float) -> float:
        """Pearson's correlation of the patch around a pixel with where it lies in another view; −1 where it does not."""
        middle, right, below = self.seen(
            view, other, pixel, normal, z, pixel + np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]])
        )
        a, b = (right - middle)[:2] / 2, (below - middle)[:2] / 2
        reach = 2 * (np.abs(a) + np.abs(b)) + 1
        height, width = self.grey[other].shape
        if middle[2] <= 1e-4 or (middle[:2] <= reach).any() or (middle[:2] >= [width, height] - reach).any():
            return -1.0
        if (reach >= 24).any():
            return -1.0
        place = middle[:2] + GRID[:, :1] * a + GRID[:, 1:] * b - 0.5
        theirs = map_coordinates(self.grey[other], place[:, ::-1].T, order=1)
        row, column = int(pixel[1]), int(pixel[0])
        mine = self.grey[view][row + 2 * GRID[:, 1], column + 2 * GRID[:, 0]]
        return float(np.corrcoef(mine, theirs)[0, 1]) if theirs.std() > 1e-3 else 0.0


def refined(
    views: Views, view: int, neighbours: list[int], row: int, column: int, normal: np.ndarray, least: float, gain: float
) -> tuple[float, float]:
    """Depth and score of one pixel, as `patches.refine` gives them."""
    z, (height, width) = views.depth[view][row, column], views.grey[view].shape
    inside = 4 <= row < height - 4 and 4 <= column < width - 4
    if not (0 < z < FREE) or not inside:
        return z, -1.0
    pixel = np.array([column + 0.5, row + 0.5])
    if views.grey[view][row - 4 : row + 5 : 2, column - 4 : column + 5 : 2].var() < FLATTEST:
        return z, -1.0
    fx, fy, cx, cy = views.lens[view]
    if normal @ [(pixel[0] - cx) / fx, (pixel[1] - cy) / fy, 1] > -1e-2:
        return z, -1.0
    rates = []
    for other in neighbours:
        near, far = (views.seen(view, other, pixel, normal, d, pixel[None])[0] for d in (z, 1.01 * z))
        if near[2] > 1e-4:
            rates.append(np.hypot(*(far - near)[:2]) / (0.01 * z))
    if not rates or sum(rates) < 1e-6:
        return z, -1.0
    rate = np.mean(rates)
    step = np.clip(views.spread[view][row, column] / 3, 0.4 / rate, 1.2 / rate)
    found = np.full(13, -1.0)

    def rate_tries(numbers: list[int]) -> None:
        for number in numbers:
            depth = z + (number - 6) * step
            agreed = [views.correlation(view, v, pixel, normal, depth) if depth > 1e-4 else -1 for v in neighbours]
            showing = sorted((c for c in agreed if c > -1), reverse=True)
            found[number] = np.mean(showing[:3]) if showing else -1

    rate_tries([*range(0, 13, 2)])
    coarse = int(np.argmax(found))
    rate_tries([number for number in (coarse - 1, coarse + 1) if 0 <= number <= 12])
    # The middle one where several are equal.
    best = int(np.argmax(found)) if max(found) > found[6] else 6
    if found[best] < least or best in (0, 12) or (abs(best - 6) > 1 and found[best] - found[6] < gain):
        return z, found[best]
    before, at, after = found[best - 1 : best + 2]
    curve = before - 2 * at + after
    fine = np.clip((before - after) / curve / 2, -0.5, 0.5) if curve < -1e-6 else 0.0
    return z + (best - 6 + fine) * step, found[best]
