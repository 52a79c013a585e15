"""Colours of points of the surface, from the photos that see them."""

from __future__ import annotations

import numpy as np
import torch

from ..data.pixels import PixelStore
from ..geometry.cameras import Camera, project
from ..kernels.depth_arrays import MapArrays
from ..kernels.surface import sight
from ..progress import Reporter

CHUNK = 1 << 15  # points at once: their colours in all photos are held together
SHARPNESS = 2.0  # power of a view's weight: the views that see a point best decide
OUTLIER = 0.1  # of the colour range: what differs more from the mean of all views counts less
ROUNDS = 2


class Photos:
    """The chosen photos, and the depth maps that say which points each of them sees.

    Args:
        store: their pixels.
        maps: depth maps; `photo` (M,) says to which photo each belongs.
        tolerance: how far from a map's surface a point may lie, normalised units.
    """

    def __init__(self, store: PixelStore, maps: MapArrays, photo: np.ndarray, tolerance: float) -> None:
        self.cameras: list[Camera] = store.cameras
        self.rotation, self.center = store.rays.rotation.cpu().numpy(), store.rays.center.cpu().numpy()
        rgba, first = store.rgba.cpu().numpy(), store.first.cpu().numpy()
        usable = np.ones(len(rgba), bool)
        if store.usable is not None:
            usable[:] = False
            usable[store.usable.cpu().numpy()] = True
        shape = [(c.height, c.width) for c in self.cameras]
        spans = [slice(first[i], first[i + 1]) for i in range(len(shape))]
        self.rgb = [rgba[span, :3].reshape(*s, 3) for span, s in zip(spans, shape)]
        self.shows = [((rgba[span, 3] > 127) & usable[span]).reshape(s) for span, s in zip(spans, shape)]
        self.maps, self.photo, self.tolerance = maps, photo, tolerance

    def observe(self, points: np.ndarray, normals: np.ndarray, report: Reporter) -> tuple[np.ndarray, np.ndarray]:
        """sRGB colours (N, 3) float32 in [0, 1] of surface points (N, 3) of the normalised frame with normals (N, 3), and
        whether at least one photo shows them: (N,) bool."""
        color, covered = np.zeros((len(points), 3), np.float32), np.zeros(len(points), bool)
        for begin in range(0, len(points), CHUNK):
            report.progress(begin / len(points))
            part = slice(begin, begin + CHUNK)
            color[part], covered[part] = self._observe(
                np.asarray(points[part], np.float32), np.asarray(normals[part], np.float32)
            )
        return color, covered

    def _observe(self, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        device = self.maps.depth.device
        seen = sight(
            torch.from_numpy(points).to(device), torch.from_numpy(normals).to(device), self.maps, self.tolerance
        )
        seen = seen.cpu().numpy()
        count = len(points)
        colors = np.zeros((count, len(self.cameras), 3), np.float32)
        weights = np.zeros((count, len(self.cameras)), np.float32)
        for index, camera in enumerate(self.cameras):
            weight = seen[:, self.photo == index].max(1, initial=0)
            rows = np.flatnonzero(weight)
            pixel = project(camera, (points[rows] - self.center[index]) @ self.rotation[index])
            with np.errstate(invalid="ignore"):
                inside = (pixel >= 0).all(1) & (pixel < [camera.width, camera.height]).all(1)
            rows, pixel = rows[inside], pixel[inside]
            x, y = pixel.astype(int).T
            shown = self.shows[index][y, x]
            rows, pixel = rows[shown], pixel[shown]
            colors[rows, index] = bilinear(self.rgb[index], pixel)
            weights[rows, index] = weight[rows]
        return blend(colors, weights), weights.max(1, initial=0) > 0


def bilinear(image: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Colours (N, 3) float32 in [0, 1] of an image (H, W, 3) uint8 at pixel coordinates (N, 2)."""
    height, width = image.shape[:2]
    place = np.clip(pixel - 0.5, 0, [width - 1, height - 1])
    x, y = np.minimum(place.astype(int), [max(width - 2, 0), max(height - 2, 0)]).T
    u, v = (place - np.stack([x, y], 1)).T[..., None].astype(np.float32)
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    upper = (1 - u) * image[y, x] + u * image[y, right]
    lower = (1 - u) * image[below, x] + u * image[below, right]
    return ((1 - v) * upper + v * lower) / np.float32(255)


def blend(colors: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """One colour (N, 3) from those of V views (N, V, 3) and their weights (N, V): the best views decide, and what
    differs from the others (highlights, something in between) counts little."""
    sharp = (weights / np.maximum(weights.max(1, keepdims=True, initial=0), 1e-20)) ** SHARPNESS
    share = sharp
    mean = np.zeros((len(colors), 3), np.float32)
    for _ in range(1 + ROUNDS):
        mean = (share[..., None] * colors).sum(1) / np.maximum(share.sum(1), 1e-12)[:, None]
        difference = ((colors - mean[:, None]) ** 2).sum(2)
        share = sharp / (1 + difference / OUTLIER**2)
    return mean
