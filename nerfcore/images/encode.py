"""Writing pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from ..errors import DiskError
from ..files import atomic_path


def to_bytes(color: np.ndarray) -> np.ndarray:
    """Values in [0, 1] → uint8, rounded."""
    return (color.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def write_picture(path: Path, color: np.ndarray) -> None:
    """Write (H, W, 3 or 1) values in [0, 1], or uint8/uint16 as they are, in the format of the suffix.

    Raises:
        DiskError: the file cannot be written.
    """
    pixels = to_bytes(color) if color.dtype.kind == "f" and path.suffix.lower() != ".exr" else color
    buffer = oiio.ImageBuf(np.ascontiguousarray(pixels if pixels.ndim == 3 else pixels[..., None]))
    if not buffer.write(str(path)):
        raise DiskError(
            f"{path} cannot be written: {buffer.geterror()}.", "Check the disk and the folder's permissions."
        )


def write_depth(path: Path, depth: np.ndarray) -> None:
    """Atomically write a depth map (height, width) float32 as a one-channel EXR, channel "Z".

    Raises:
        DiskError: it cannot be written.
    """
    height, width = depth.shape
    spec = oiio.ImageSpec(width, height, 1, "float")
    spec.channelnames = ("Z",)
    spec.attribute("compression", "zip")
    with atomic_path(path) as temporary:
        out = oiio.ImageOutput.create(str(temporary))
        # OpenImageIO takes the last axis for the channels.
        pixels = np.ascontiguousarray(depth, np.float32)[..., None]
        if out is None or not (out.open(str(temporary), spec) and out.write_image(pixels) and out.close()):
            raise DiskError(f"{path} cannot be written: {oiio.geterror()}.", "Check the disk and the permissions.")
