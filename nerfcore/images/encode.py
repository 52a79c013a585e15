"""Writing pictures."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from ..errors import DiskError
from ..files import atomic_path
from ..progress import go_on
from .picture import Picture, to_bytes, to_srgb8

SRGB_PRIMARIES = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)  # x, y of red, green, blue and white: IEC 61966-2-1


PNG_LEVEL = 2  # of 9: a texture is packed three times as fast as with the usual 6, and an eighth to a sixth larger
BAND = 1 << 22  # values that are written between two questions whether to go on: a fraction of a second


def write_picture(
    path: Path,
    picture: Picture | np.ndarray,
    check: Callable[[], None] = go_on,
    facts: dict[str, int] | None = None,
) -> None:
    """Write a picture as 8-bit sRGB with straight alpha, if any; or (H, W, 3 or 1) values in [0, 1], or uint8/uint16 as
    they are, in the format of the suffix. `check` is called between bands of rows, and may raise. `facts` are texts in a PNG.

    Raises:
        DiskError: the file cannot be written.
    """
    if isinstance(picture, Picture):
        pixels = to_srgb8(picture).pixels
    else:
        pixels = to_bytes(picture) if picture.dtype.kind == "f" else picture
    pixels = np.ascontiguousarray(pixels if pixels.ndim == 3 else pixels[..., None])
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, str(pixels.dtype))
    spec.attribute("oiio:UnassociatedAlpha", 1)  # else colours are divided by alpha once more
    spec.attribute("png:compressionLevel", PNG_LEVEL)
    for name, value in (facts or {}).items():
        spec.attribute(name, str(value))
    out = oiio.ImageOutput.create(str(path))
    written = out is not None and out.open(str(path), spec)
    rows = max(1, BAND // (width * channels))
    try:
        for top in range(0, height, rows):
            check()
            end = min(height, top + rows)
            written = written and out.write_scanlines(top, end, 0, pixels[top:end])
    finally:
        written = out is not None and out.close() and written
    if not written:
        why = oiio.geterror() if out is None else out.geterror()
        raise DiskError(f"{path} cannot be written: {why}.", "Check the disk and the folder's permissions.")


def png_bytes(pixels: np.ndarray, check: Callable[[], None] = go_on) -> bytes:
    """A picture (H, W, C) uint8 as a PNG file; see `write_picture`."""
    with tempfile.TemporaryDirectory(prefix="fieldwork-png-") as name:
        path = Path(name) / "picture.png"
        write_picture(path, pixels, check)
        return path.read_bytes()


def write_layers(path: Path, layers: dict[str, np.ndarray], facts: dict[str, int] | None = None) -> None:
    """One multilayer EXR with float channels (H, W) named as the keys, whose colours have the primaries of sRGB; `facts` are
    attributes of its header.

    Raises:
        DiskError: it cannot be written.
    """
    names = list(layers)
    height, width = layers[names[0]].shape
    spec = oiio.ImageSpec(width, height, len(names), oiio.FLOAT)
    spec.channelnames = tuple(names)
    spec.attribute("chromaticities", "float[8]", SRGB_PRIMARIES)
    for name, value in (facts or {}).items():
        spec.attribute(name, value)
    buffer = oiio.ImageBuf(spec)
    buffer.set_pixels(spec.roi, np.ascontiguousarray(np.stack([layers[n] for n in names], -1), np.float32))
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
