"""Which pixels of the training photos may show the sky: those whose colour other cameras see in the same direction.

An environment, a colour for each direction, explains whatever few cameras see there: a capture of 20 photos from inside
of a court lost its ground and its walls to it. While its surfaces form it is therefore behind these pixels only.
Measured: docs/experiments.md, “An environment that waits”.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
import torch

from ..data.pixels import training_size
from ..data.scene import Scene, View
from ..geometry.cameras import Camera, project
from .infinity import SIDE, between_points, colored_directions

FEW = 4  # other cameras that look in the direction of a pixel, at the median: with fewer the environment waits
OTHERS = 40  # photos at most that a photo is compared with
ALIKE = 4.0  # of 255: what one colour in one direction may differ by, beyond what it differs by between neighbours
UNEVEN = 40.0  # of 255: difference of neighbours from which on nearly every colour would be alike
AGREE = 0.2  # of the cameras that look there, and one at least: things hide the sky from many
MAJORITY = 5  # pixels: side of the neighbourhood that decides
CLOSE = 0.2  # of a photo's width: points no farther from each other have something between them, not sky


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
    scene: Scene,
    views: list[View],
    cameras: list[Camera],
    device: torch.device,
    check: Callable[[], None] = lambda: None,
) -> SkyMasks | None:
    """The masks of training `views`, whose pictures have the sizes of `cameras`; None where so many cameras look in each
    direction that colours of directions explain nothing but what is far away. `check` is called for each photo and may
    raise to stop."""
    chosen = np.unique(np.linspace(0, len(views) - 1, OTHERS).round().astype(int)).tolist()
    compared: dict[int, Small] = {}
    for i in chosen:
        check()
        compared[i] = Small.of(views[i])

    def counts(i: int, photo: Small) -> tuple[np.ndarray, np.ndarray]:
        check()
        return _looking_and_alike(photo, [other for j, other in compared.items() if j != i])

    counted = {i: counts(i, photo) for i, photo in compared.items()}
    looking = np.concatenate([looking for looking, _ in counted.values()])
    if np.median(looking) / max(len(chosen) - 1, 1) * (len(views) - 1) >= FEW:
        return None
    found = []
    for i, view in enumerate(views):
        photo = compared.get(i) or Small.of(view)
        found.append(_sky_of(photo, *(counted.get(i) or counts(i, photo)), scene.points.xyz))

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
    """A small version of a photo, of H · W pixels: directions in the world, NaN where the lens does not see, colors in
    [0, 255], and the least and the largest of neighbours, each (H · W, 3)."""

    view: View
    camera: Camera
    directions: np.ndarray
    colors: np.ndarray
    least: np.ndarray
    largest: np.ndarray

    @classmethod
    def of(cls, view: View) -> Small:
        camera = view.camera.resized(*training_size(view.camera, SIDE))
        directions, colors = colored_directions(view)
        picture = colors.reshape(camera.height, camera.width, 3)
        least, largest = (f(picture, (3, 3, 1)) for f in (scipy.ndimage.minimum_filter, scipy.ndimage.maximum_filter))
        return cls(view, camera, directions, colors, least.reshape(-1, 3), largest.reshape(-1, 3))


def _looking_and_alike(photo: Small, others: list[Small]) -> tuple[np.ndarray, np.ndarray]:
    """How many others look in the direction of each pixel of a small photo, and how many see its colour there, (H · W,)."""
    looking, alike = np.zeros(len(photo.colors), int), np.zeros(len(photo.colors), int)
    for other in others:
        index, pixel = _seen_by(other, photo.directions)
        color, least, largest = photo.colors[index], other.least[pixel], other.largest[pixel]
        apart = np.maximum(least - color, color - largest).max(1)
        looking[index] += 1
        alike[index] += (apart < ALIKE) & ((largest - least).max(1) < UNEVEN)
    return looking, alike


def _sky_of(photo: Small, looking: np.ndarray, alike: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Which pixels (H, W) bool of a small photo may show the sky."""
    # Where nobody else looks nothing speaks against it.
    agree = (looking == 0) | (alike >= np.maximum(1, AGREE * looking))
    agree &= ~between_points(photo.view, points, CLOSE)
    agree = agree.reshape(photo.camera.height, photo.camera.width)
    return scipy.ndimage.uniform_filter(agree.astype(np.float32), MAJORITY) > 0.5


def _seen_by(other: Small, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of the directions (N, 3) a camera sees, as indices (M,), and in which of its pixels (M,)."""
    camera = other.camera
    local = directions @ other.view.camera_to_world[:3, :3]
    ahead = np.isfinite(local).all(1)
    if camera.model not in ("EQUIRECTANGULAR", "OPENCV_FISHEYE"):
        ahead &= local[:, 2] > 0
    index = ahead.nonzero()[0]
    with np.errstate(invalid="ignore"):
        place = project(camera, local[index])
        inside = ((place >= 0) & (place < [camera.width, camera.height])).all(1)
    column, row = place[inside].astype(int).T
    return index[inside], row * camera.width + column
