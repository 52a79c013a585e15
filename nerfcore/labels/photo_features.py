"""What photos show finer than the field, brought to the surfels: texture by filters, and features of a model the user brings."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import scipy

from ..data.scene import View
from ..errors import InputError
from ..images.picture import over
from ..images.working import read_picture
from ..progress import Reporter
from .graph import FILTERS, TOKENS, standardised
from .tokens import TokenModel

SCALES = (1, 2)  # deviations of the filters in pixels of the map; wider ones mix what lies side by side
ANSWERS = 6 * len(SCALES)
TOKEN_COMPONENTS = 24  # of a model's features
THREADS = min(8, os.cpu_count() or 1)
SAMPLED = 4096  # patches of each photo that the components are found by

Picture = tuple[
    View, np.ndarray, np.ndarray
]  # a photo, the surfel (H, W) of each pixel of its map, and its CIE Lab (H, W, 3)


def photo_features(count: int, pictures: Sequence[Picture], model: TokenModel | None, report: Reporter) -> np.ndarray:
    """Columns (count, G) float32 by which surfels are told apart, weighted, by what the photos show of them.

    Raises:
        InputError: the model does not fit, or a photo cannot be read. Cancelled.
    """
    report.stage("Looking at the photos")

    def filtered(picture: Picture) -> tuple[np.ndarray, np.ndarray]:
        report.check()
        return picture[1], texture_filters(picture[2])

    with ThreadPoolExecutor(THREADS) as pool:
        values = uplifted(count, pool.map(filtered, pictures))
    columns = [FILTERS * standardised(np.sign(values) * np.log1p(np.abs(values)))]
    if model is not None:
        columns.append(TOKENS * token_features(count, pictures, model, report))
    return np.concatenate(columns, 1).astype(np.float32)


def identity(path: Path) -> tuple[str, int, int]:
    """A file, and what changes with it. Raises InputError where there is none."""
    try:
        stat = path.stat()
    except OSError as error:
        raise InputError(f"There is no model at {path}.", "Choose an .onnx file.") from error
    return str(path), stat.st_mtime_ns, stat.st_size


def texture_filters(lab: np.ndarray) -> np.ndarray:
    """Answers (H, W, ANSWERS) float32 of filters to a picture in CIE Lab (H, W, 3): at each scale strength of the gradient of
    the lightness, eigenvalues of its second derivatives, and deviation of each channel."""
    lightness, found = lab[..., 0], []
    for scale in SCALES:
        found.append(scipy.ndimage.gaussian_gradient_magnitude(lightness, scale))
        xx, xy, yy = (derivative(lightness, scale, *orders) for orders in ((0, 2), (1, 1), (2, 0)))
        root = np.sqrt((xx - yy) ** 2 + 4 * xy**2)
        found += [(xx + yy + root) / 2, (xx + yy - root) / 2]
        for channel in np.moveaxis(lab, -1, 0):
            mean = scipy.ndimage.gaussian_filter(channel, 2 * scale)
            found.append(np.sqrt((scipy.ndimage.gaussian_filter(channel**2, 2 * scale) - mean**2).clip(0)))
    return np.stack(found, -1).astype(np.float32)


def derivative(values: np.ndarray, scale: float, along_y: int, along_x: int) -> np.ndarray:
    """Derivative (H, W) of these orders of values (H, W) that are smoothed by a Gaussian."""
    return scipy.ndimage.gaussian_filter1d(
        scipy.ndimage.gaussian_filter1d(values, scale, 0, along_y), scale, 1, along_x
    )


def uplifted(count: int, pictures: Iterable[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Means (count, C) float32 of pictures' values over the pixels that show each surfel; 0 where none does.

    Args:
        pictures: of each photo the surfel (H, W) of each pixel, −1 for none, and its values (H, W, C).
    """
    total, amount = np.zeros((count, 0)), np.zeros(count)
    for surfel, values in pictures:
        seen = surfel >= 0
        if not total.shape[1]:
            total = np.zeros((count, values.shape[-1]))
        shown, number, pixels = np.unique(surfel[seen], return_inverse=True, return_counts=True)
        for column, layer in enumerate(np.moveaxis(values, -1, 0)):
            total[shown, column] += np.bincount(number, layer[seen], len(shown))
        amount[shown] += pixels
    return (total / np.maximum(amount, 1)[:, None]).astype(np.float32)


def principal_axes(centred: np.ndarray, count: int) -> np.ndarray:
    """The axes (C, at most count) along which values (N, C) of mean 0 vary most."""
    return np.linalg.eigh(centred.T @ centred / max(len(centred), 1))[1][:, ::-1][:, :count]


def token_features(count: int, pictures: Sequence[Picture], model: TokenModel, report: Reporter) -> np.ndarray:
    """Features (count, at most TOKEN_COMPONENTS) of a model, brought to the surfels that photos show.

    Raises:
        InputError: the model has no token for each patch, or a photo cannot be read. Cancelled.
    """
    maps: list[np.ndarray] = []
    for number, (view, _, _) in enumerate(pictures):
        report.progress(number / len(pictures), view.name)
        color = over(read_picture(view.image), 1.0).pixels[..., :3]
        maps.append(model.features((color * 255 + 0.5).astype(np.uint8)).astype(np.float16))
    random = np.random.default_rng(0)
    rows = [found.reshape(-1, found.shape[-1]) for found in maps]
    some = np.concatenate([own[random.permutation(len(own))[:SAMPLED]].astype(np.float32) for own in rows])
    mean, axes = some.mean(0), principal_axes(some - some.mean(0), TOKEN_COMPONENTS)
    small = ((found.astype(np.float32) - mean) @ axes for found in maps)
    sized = ((surfel, spread(found, *surfel.shape)) for (_, surfel, _), found in zip(pictures, small))
    values = uplifted(count, sized)
    return values / max(float(values[:, 0].std()), 1e-6)


def spread(values: np.ndarray, height: int, width: int) -> np.ndarray:
    """Values (h, w, C) at another size (height, width, C), linear between the middles of the old cells."""
    rows, columns = values.shape[:2]
    y = (np.arange(height) + 0.5) * rows / height - 0.5
    x = (np.arange(width) + 0.5) * columns / width - 0.5
    place = np.meshgrid(y, x, indexing="ij")
    return np.stack(
        [scipy.ndimage.map_coordinates(layer, place, order=1, mode="nearest") for layer in np.moveaxis(values, -1, 0)],
        -1,
    )
