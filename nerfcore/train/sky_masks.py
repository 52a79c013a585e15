"""Which pixels of the training photos may show the sky: those with no texture that other cameras miss in their direction.

An environment, a colour for each direction, explains what is far away, but also meadows and plain walls, whose colours differ
little: captures lost their ground to it. Where it does that (`sky_stage.py`), it is behind these pixels only while surfaces form. What
is infinitely far looks the same in the same direction from everywhere; what is near moves against it from camera to camera.
Measured: docs/experiments.md, “Meadows that became a sky”.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy
import torch

from ..data.photo import photo_of
from ..data.pixels import training_size
from ..data.scene import View
from ..geometry.cameras import Camera, pixel_centers, project, rays
from ..images.picture import resized
from ..images.texture import left_of_slopes
from .infinity import SIDE, between_points

PATCH = 5  # pixels: side of the patches that are compared
TEXTURE = 1.0  # of 255: standard deviation, less an even slope, from which a patch has a texture
SAME = 0.9  # correlation from which patches of two photos are the same
STILL = 1  # pixel by which the same patch may be elsewhere: poses err, and what moves by so little is as good as infinitely far
MAJORITY = 5  # pixels: side of the neighbourhood that decides
RIM = 3  # pixels beside what is near, whose patches show it too
CLOSE = 0.2  # of a photo's width: points no farther from each other have something between them, not sky
# Not tuned: the next four.
CAMERAS = 6  # the nearest that look there: they see the sky beside the same things
APART = 0.1  # of the typical distance of cameras from their middle, at least: what is near must have moved
PROBES = 144  # places of a photo by which it is told who looks where it does
LOOKING = 0.3  # of these must be seen


@dataclass(frozen=True)
class SkyMasks:
    """Small masks of the views of a `PixelStore`: values (N,) bool of all of them; of each view (V,) int64 the first of
    its values, the width and the height of its mask, and those of its photo."""

    values: torch.Tensor
    first: torch.Tensor
    size: tuple[torch.Tensor, torch.Tensor]
    photo: tuple[torch.Tensor, torch.Tensor]

    def at(self, image: torch.Tensor, pixel: torch.Tensor) -> torch.Tensor:
        """Which pixels (R,) int64 of the photos `image` (R,) int64 may show the sky, (R,) bool."""
        width = self.photo[0][image]
        row, column = torch.div(pixel, width, rounding_mode="floor"), pixel % width
        small = self.size[0][image]
        row = torch.div(row * self.size[1][image], self.photo[1][image], rounding_mode="floor")
        column = torch.div(column * small, width, rounding_mode="floor")
        return self.values[self.first[image] + row * small + column]


def sky_masks(
    views: list[View],
    cameras: list[Camera],
    points: np.ndarray,
    device: torch.device,
    check: Callable[[], None] = lambda: None,
) -> SkyMasks:
    """The masks of training `views`, whose pictures have the sizes of `cameras`; points (P, 3): of the poses. `check` is
    called for each photo and may raise to stop."""
    photos = []
    for view in views:
        check()
        photos.append(Small.of(view))
    centers = np.stack([view.camera_to_world[:3, 3] for view in views])
    apart = APART * np.median(np.linalg.norm(centers - np.median(centers, 0), axis=1))
    found = []
    for i, photo in enumerate(photos):
        check()
        away = np.linalg.norm(centers - centers[i], axis=1)
        nearest = [photos[j] for j in np.argsort(away, kind="stable") if away[j] > apart]
        between = between_points(photo.view, points, CLOSE).reshape(photo.grey.shape)
        found.append(_sky_of(photo, nearest) & ~between)

    def column(numbers: list[int]) -> torch.Tensor:
        return torch.tensor(numbers, device=device)

    first = np.cumsum([0, *(mask.size for mask in found)])[:-1]
    return SkyMasks(
        torch.from_numpy(np.concatenate([mask.ravel() for mask in found])).to(device),
        column(first.tolist()),
        (column([mask.shape[1] for mask in found]), column([mask.shape[0] for mask in found])),
        (column([camera.width for camera in cameras]), column([camera.height for camera in cameras])),
    )


@dataclass(frozen=True)
class Small:
    """A small version of a photo: its view, its camera and its grey values (H, W) in [0, 255]."""

    view: View
    camera: Camera
    grey: np.ndarray

    @classmethod
    def of(cls, view: View) -> Small:
        camera = view.camera.resized(*training_size(view.camera, SIDE))
        small = resized(photo_of(view), camera.width, camera.height).pixels[..., :3]
        return cls(view, camera, small.mean(2, dtype=np.float32))

    def directions(self) -> np.ndarray:
        """Of its pixels (H · W, 3) in the world, NaN where the lens does not see."""
        local, _ = rays(self.camera, pixel_centers(self.camera.width, self.camera.height).reshape(-1, 2))
        return local @ self.view.camera_to_world[:3, :3].T

    def places(self, directions: np.ndarray) -> np.ndarray:
        """Where directions (N, 3) of the world are in its picture (N, 2), NaN where they are not."""
        local = directions @ self.view.camera_to_world[:3, :3]
        ahead = np.isfinite(local).all(1)
        if self.camera.model not in ("EQUIRECTANGULAR", "OPENCV_FISHEYE"):
            ahead &= local[:, 2] > 0
        with np.errstate(invalid="ignore"):
            place = project(self.camera, np.where(ahead[:, None], local, [0, 0, 1]))
            ahead &= ((place >= 0) & (place < [self.camera.width, self.camera.height])).all(1)
        return np.where(ahead[:, None], place, np.nan)


def _sky_of(photo: Small, nearest: list[Small]) -> np.ndarray:
    """Which pixels (H, W) bool of a small photo may show the sky, by the nearest of others that look where it does."""
    grey = photo.grey
    directions = photo.directions()
    probes = directions[np.linspace(0, len(directions) - 1, PROBES).astype(int)]
    mean, deviation = _moments(grey)
    compared, same = np.zeros(grey.shape, bool), np.zeros(grey.shape, bool)
    looking = (other for other in nearest if np.isfinite(other.places(probes)).all(1).mean() >= LOOKING)
    for other in itertools.islice(looking, CAMERAS):
        place = other.places(directions).reshape(*grey.shape, 2)
        seen = scipy.ndimage.minimum_filter(np.isfinite(place).all(2), PATCH)
        at = np.nan_to_num(place[..., ::-1] - 0.5).transpose(2, 0, 1)
        there = scipy.ndimage.map_coordinates(other.grey, at, order=1, mode="nearest")
        compared |= seen
        for moved in _moved(there):
            others, scattered = _moments(moved)
            covariance = scipy.ndimage.uniform_filter(grey * moved, PATCH) - mean * others
            same |= seen & (covariance > SAME * deviation * scattered)
    near = compared & ~same & (left_of_slopes(grey, PATCH) > TEXTURE**2)
    near = scipy.ndimage.uniform_filter(near.astype(np.float32), MAJORITY) > 0.5
    return scipy.ndimage.maximum_filter(~near, 2 * RIM + 1)


def _moved(grey: np.ndarray) -> Iterator[np.ndarray]:
    """A picture (H, W) moved by up to `STILL` pixels each way."""
    height, width = grey.shape
    wider = np.pad(grey, STILL, mode="edge")
    for row, column in itertools.product(range(2 * STILL + 1), repeat=2):
        yield wider[row : row + height, column : column + width]


def _moments(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of each patch (H, W)."""
    mean = scipy.ndimage.uniform_filter(grey, PATCH)
    return mean, np.sqrt(np.maximum(scipy.ndimage.uniform_filter(grey * grey, PATCH) - mean * mean, 0))
