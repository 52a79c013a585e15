"""How sharp a photo is, and whether two photos are the same."""

from __future__ import annotations

import numpy as np
import scipy
from PIL import Image

# Not tuned.
WORKING_SIZE = 1000  # pixels of the long side
COARSER = 4
SAME = 0.7  # grey levels by which thumbnails of the same picture differ at most in the mean
NOTHING = 0.05  # grey levels squared: less than what rounding to 8 bits makes


def sharpness(image: Image.Image) -> float:
    """Variance of the Laplacian of the sharpest parts of a photo (8-bit grey levels squared).

    Measured at a common size so that values of one capture compare; the 90th percentile over an 8×8 grid of tiles, so
    that a plain background does not count as blur.
    """
    return _energy(_grey(image))


def focus(image: Image.Image) -> float:
    """`sharpness` of a photo relative to that of the same photo at a quarter of the size.

    What a photo shows changes both alike: a sharp photo of a plain wall has little at either size, a blurred one of
    anything has structure that only the small one shows.
    """
    grey = _grey(image)
    small = grey.resize((max(8, grey.width // COARSER), max(8, grey.height // COARSER)), Image.Resampling.BOX)
    return _energy(grey) / max(_energy(small), NOTHING)


def _grey(image: Image.Image) -> Image.Image:
    grey = image.convert("L")
    scale = WORKING_SIZE / max(grey.size)
    if scale >= 1:
        return grey
    return grey.resize((max(8, round(grey.width * scale)), max(8, round(grey.height * scale))), Image.Resampling.BOX)


def _energy(grey: Image.Image) -> float:
    laplacian = scipy.ndimage.laplace(np.asarray(grey, np.float32))
    rows = np.array_split(laplacian, 8, axis=0)
    return float(np.percentile([tile.var() for row in rows for tile in np.array_split(row, 8, axis=1)], 90))


def thumbnail(image: Image.Image) -> np.ndarray:
    """Grey thumbnail (64, 64) float32 for comparing photos."""
    return np.asarray(image.convert("L").resize((64, 64), Image.Resampling.BOX), np.float32)


def same_picture(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two thumbnails show the same exposure, saved twice.

    Recompression changes single pixels of a thumbnail by a grey level or two; another exposure, even from almost the
    same place, moves edges. Pictures without structure are never called the same.
    """
    difference = np.abs(a - b)
    return bool(difference.mean() < SAME and difference.max() < 6 and min(a.std(), b.std()) > 4.0)
