"""Labels that know how sure they are: probability maps, and confidence maps beside label maps."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from PIL import Image

from ..errors import InputError
from .arrays import read_array
from .limits import UNDECODABLE
from .names import beside

PROBABILITY_SUFFIXES = (".npy", ".npz", ".exr")


def find_probabilities(folder: Path, stems: Sequence[str]) -> Path | None:
    """The probability map of a photo in a labels folder, under one of its stems (`names.companion_stems`)."""
    places = (folder / f"{stem}{suffix}" for stem in stems for suffix in PROBABILITY_SUFFIXES)
    return next((place for place in places if os.path.isfile(place)), None)


def find_confidence(folder: Path, stems: Sequence[str], label: Path | None) -> Path | None:
    """What says how sure a photo's labels are: the probability map itself, else `confidence/<stem>.png`."""
    if label is None or label.suffix.lower() in PROBABILITY_SUFFIXES:
        return label
    return next((path for stem in stems if (path := beside(folder / "confidence", stem))), None)


def read_probabilities(path: Path) -> np.ndarray:
    """Class probabilities (H, W, K) float32; channel k is that of class id k.

    An .npz holds one array; values of a pixel may sum to less than 1 (the rest is unknown).

    Raises:
        InputError: it cannot be read, or holds no probabilities. One clause, fit as a reason.
    """
    if path.suffix.lower() == ".exr":
        buffer = oiio.ImageBuf(str(path))
        values = None if buffer.has_error else buffer.get_pixels(oiio.FLOAT)
        if values is None:
            raise InputError(f"probability map {path.name} cannot be read: {buffer.geterror() or 'no pixels'}")
    else:
        try:
            values = read_array(path)
        except InputError as error:
            raise InputError(f"probability map {error}") from error
    values = np.asarray(values, np.float32)
    if values.ndim != 3 or values.shape[2] < 2 or values.size == 0:
        raise InputError(
            f"probability map {path.name} has the shape {values.shape}; height × width × classes is needed"
        )
    if not np.isfinite(values).all() or values.min() < 0 or values.sum(2).max() > 1.02:
        raise InputError(f"probability map {path.name} does not hold probabilities: they are in 0…1, with sums up to 1")
    return values


def read_confidence(path: Path) -> np.ndarray:
    """Confidence (H, W) uint8, 255 for certain: the largest probability of a probability map, or a grey picture.

    Raises:
        InputError: it cannot be read. One clause, fit as a reason.
    """
    if path.suffix.lower() in PROBABILITY_SUFFIXES:
        return (read_probabilities(path).max(2).clip(0, 1) * 255 + 0.5).astype(np.uint8)
    try:
        with Image.open(path) as image:
            wide = image.mode.startswith("I")
            values = np.asarray(image if wide else image.convert("L"))
    except UNDECODABLE as error:
        raise InputError(f"confidence map {path.name} cannot be read: {error}") from error
    return (values.astype(np.int64).clip(0, 65535) // 257).astype(np.uint8) if wide else values.astype(np.uint8)
