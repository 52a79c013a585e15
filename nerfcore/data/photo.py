"""A view's photo as the field sees it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..images.picture import Picture
from ..images.working import read_picture
from .scene import View


def photo_of(view: View) -> Picture:
    """The photo of a view, 8-bit sRGB, its colours brought to the capture's common exposure.

    Raises:
        InputError: it cannot be read.
    """
    picture = read_picture(view.image)
    if view.gain is None:
        return picture
    pixels = picture.pixels.copy()
    gained = np.arange(256, dtype=np.float32)[:, None] * np.array(view.gain, np.float32)
    table = np.clip(np.round(gained), 0, 255).astype(np.uint8)
    for channel in range(3):
        pixels[..., channel] = table[pixels[..., channel], channel]
    return replace(picture, pixels=pixels)
