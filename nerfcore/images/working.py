"""Reading the working copies of a project: photos, label maps, masks, depth maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from ..errors import InputError


def read_image(path: Path) -> np.ndarray:
    """Pixels (H, W, C) uint8, C 1 to 4, of an image file. Raises InputError naming the file."""
    buffer = oiio.ImageBuf(str(path))
    pixels = None if buffer.has_error else buffer.get_pixels(oiio.UINT8)
    if pixels is None:
        raise InputError(f"{path} cannot be read: {buffer.geterror() or 'no pixels'}.", "Replace or remove the file.")
    return pixels


def read_photo(path: Path) -> np.ndarray:
    """A photo as (H, W, 4) uint8 with straight alpha. Raises InputError naming the file."""
    buffer = oiio.ImageBuf()
    config = oiio.ImageSpec()
    config["oiio:UnassociatedAlpha"] = 1
    buffer.reset(str(path), 0, 0, config)
    pixels = None if buffer.has_error else buffer.get_pixels(oiio.UINT8)
    if pixels is None:
        raise InputError(f"{path} cannot be read: {buffer.geterror() or 'no pixels'}.", "Replace or remove the file.")
    if pixels.shape[2] <= 2:
        pixels = np.concatenate([np.repeat(pixels[..., :1], 3, 2), pixels[..., 1:]], 2)
    if pixels.shape[2] == 3:
        pixels = np.concatenate([pixels, np.full_like(pixels[..., :1], 255)], 2)
    return pixels


def read_label(path: Path) -> np.ndarray:
    """A label map as class ids (H, W) int64. Raises InputError naming the file."""
    buffer = oiio.ImageBuf(str(path))
    pixels = (
        None if buffer.has_error else buffer.get_pixels(oiio.UINT16 if buffer.spec().format == "uint16" else oiio.UINT8)
    )
    if pixels is None:
        raise InputError(f"{path} cannot be read: {buffer.geterror() or 'no pixels'}.", "Replace or remove the file.")
    return pixels[..., 0].astype(np.int64)


def resize(pixels: np.ndarray, width: int, height: int, nearest: bool = False) -> np.ndarray:
    """Resample (H, W, C) uint8 to width × height; box-like filtering unless `nearest`."""
    if pixels.shape[1] == width and pixels.shape[0] == height:
        return pixels
    if nearest:
        y = ((np.arange(height) + 0.5) * pixels.shape[0] / height).astype(int)
        x = ((np.arange(width) + 0.5) * pixels.shape[1] / width).astype(int)
        return pixels[y][:, x]
    source = oiio.ImageBuf(np.ascontiguousarray(pixels))
    result = oiio.ImageBufAlgo.resize(source, roi=oiio.ROI(0, width, 0, height, 0, 1, 0, pixels.shape[2]))
    return np.asarray(result.get_pixels(oiio.UINT8))


def read_depth(path: Path) -> np.ndarray:
    """A depth map (H, W) float32 of a project. Raises InputError naming the file."""
    buffer = oiio.ImageBuf(str(path))
    pixels = None if buffer.has_error else buffer.get_pixels(oiio.FLOAT)
    if pixels is None:
        raise InputError(f"{path} cannot be read: {buffer.geterror() or 'no pixels'}.", "Replace or remove the file.")
    return pixels[..., 0]
