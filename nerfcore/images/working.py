"""Reading the working copies of a project: photos, label maps, masks, depth maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from ..errors import InputError
from .picture import Picture, from_channels, is_transparent, to_srgb8

MASK_UNKNOWN = 64  # in masks that Fieldwork makes, where black is empty: nobody knows whether something is there


def read_image(path: Path) -> np.ndarray:
    """Pixels (H, W, C) uint8, C 1 to 4, of an image file. Raises InputError naming the file."""
    buffer = oiio.ImageBuf(str(path))
    pixels = None if buffer.has_error else buffer.get_pixels(oiio.UINT8)
    if pixels is None:
        raise InputError(f"{path} cannot be read: {buffer.geterror() or 'no pixels'}.", "Replace or remove the file.")
    return pixels


def read_picture(path: Path) -> Picture:
    """A photo as 8-bit sRGB, alpha straight if it has one. Raises InputError naming the file."""
    buffer = oiio.ImageBuf()
    asked = oiio.ImageSpec()
    asked["oiio:UnassociatedAlpha"] = 1  # as it is in the file, please
    buffer.reset(str(path), 0, 0, asked)
    pixels = None if buffer.has_error else buffer.get_pixels(oiio.UINT8)
    if pixels is None:
        raise InputError(f"{path} cannot be read: {buffer.geterror() or 'no pixels'}.", "Replace or remove the file.")
    kept = "straight" if buffer.spec().getattribute("oiio:UnassociatedAlpha") else "associated"
    return to_srgb8(from_channels(pixels, "srgb", kept))


def shows_transparency(path: Path) -> bool:
    """Whether a photo has pixels that are not opaque; those without alpha are not decoded.

    Raises:
        InputError: it cannot be read.
    """
    buffer = oiio.ImageBuf(str(path))
    return (buffer.has_error or buffer.nchannels in (2, 4)) and is_transparent(read_picture(path))


def read_label(path: Path) -> np.ndarray:
    """A label map as class ids (H, W) int64. Raises InputError naming the file."""
    buffer = oiio.ImageBuf(str(path))
    pixels = (
        None if buffer.has_error else buffer.get_pixels(oiio.UINT16 if buffer.spec().format == "uint16" else oiio.UINT8)
    )
    if pixels is None:
        raise InputError(f"{path} cannot be read: {buffer.geterror() or 'no pixels'}.", "Replace or remove the file.")
    return pixels[..., 0].astype(np.int64)


def nearest(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """A map (H, W) sampled at the pixel centres of width × height."""
    if values.shape == (height, width):
        return values
    y = ((np.arange(height) + 0.5) * values.shape[0] / height).astype(int)
    x = ((np.arange(width) + 0.5) * values.shape[1] / width).astype(int)
    return values[y][:, x]


def read_depth(path: Path) -> np.ndarray:
    """A depth map (H, W) float32 of a project. Raises InputError naming the file."""
    buffer = oiio.ImageBuf(str(path))
    pixels = None if buffer.has_error else buffer.get_pixels(oiio.FLOAT)
    if pixels is None:
        raise InputError(f"{path} cannot be read: {buffer.geterror() or 'no pixels'}.", "Replace or remove the file.")
    return pixels[..., 0]
