"""Decoding photos: one function for every still format."""

from __future__ import annotations

from pathlib import Path

from PIL import Image, UnidentifiedImageError

from ..errors import InputError

# Stitched panoramas are larger than Pillow's decompression-bomb limit; ours is the memory a decode would need.
Image.MAX_IMAGE_PIXELS = 600_000_000


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file as stored (EXIF orientation not applied), without decoding it.

    Raises:
        InputError: the file is not a readable image.
    """
    try:
        with Image.open(path) as image:
            return image.size
    except (OSError, UnidentifiedImageError, ValueError) as error:
        raise InputError(f"{path} is not a readable image: {error}.", "Replace or remove it.") from error
