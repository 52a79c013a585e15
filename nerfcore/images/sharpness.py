"""How sharp a photo is, and whether two photos are the same."""

from __future__ import annotations

import numpy as np
from PIL import Image
from scipy import ndimage

WORKING_SIZE = 1000  # pixels of the long side; not tuned


def sharpness(image: Image.Image) -> float:
    """Variance of the Laplacian of the sharpest parts of a photo (8-bit grey levels squared).

    Measured at a common size so that values of one capture compare; the 90th percentile over an 8×8 grid of tiles, so
    that a plain background does not count as blur.
    """
    grey = image.convert("L")
    scale = WORKING_SIZE / max(grey.size)
    if scale < 1:
        grey = grey.resize(
            (max(8, round(grey.width * scale)), max(8, round(grey.height * scale))), Image.Resampling.BOX
        )
    laplacian = ndimage.laplace(np.asarray(grey, np.float32))
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
    return bool(difference.mean() < 0.7 and difference.max() < 6 and min(a.std(), b.std()) > 4.0)
