"""Bringing the files of a posed data set into a project, unchanged where possible."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import InputError
from ..files import atomic_path, copied
from ..images.arrays import read_array
from ..images.decode import other_profile, read_photo
from ..images.labels import Colors, read_labels, read_mask
from ..images.limits import UNDECODABLE
from ..images.soft_labels import read_confidence
from ..images.suffixes import FLOAT_SUFFIXES, RAW_SUFFIXES

PLAIN_SUFFIXES = {".png", ".jpg", ".jpeg", ".webp"}
PLAIN_MODES = {"RGB", "RGBA", "L", "LA", "P"}


def copy_photo(source: Path, folder: Path, name: str) -> Path:
    """Put a photo into `folder` as `name`.

    PNG, JPEG and WebP of 8 bits in sRGB are copied as they are. Others become 8-bit PNG in sRGB; so do photos with an EXIF
    orientation, because poses are given for the pixels as stored: the tag is dropped, the pixels stay. Only HEIF is
    turned, since its orientation is a part of the format that every decoder applies.

    Raises:
        InputError: it cannot be decoded.
    """
    suffix = source.suffix.lower()
    if suffix in PLAIN_SUFFIXES:
        try:
            with Image.open(source) as image:
                plain = image.mode in PLAIN_MODES and image.getexif().get(0x0112, 1) in (0, 1)
                plain = plain and other_profile(image.info.get("icc_profile")) is None
                image.load()  # headers of truncated files are whole
        except UNDECODABLE as error:
            raise InputError(f"The photo {source} cannot be used: {error}.", "Replace or remove it.") from error
        if plain:
            return copy_file(source, folder, name)
    target = folder / f"{name}.png"
    taken = source.stat()
    # One of the same size holds the same bytes: a copy that is to be decoded now.
    if target.is_file() and target.stat().st_mtime_ns == taken.st_mtime_ns and target.stat().st_size != taken.st_size:
        return target
    with atomic_path(target) as temporary:
        _decode(source, suffix).save(temporary, compress_level=2)
        os.utime(temporary, ns=(taken.st_atime_ns, taken.st_mtime_ns))  # tells later which one it is a copy of
    return target


def _decode(source: Path, suffix: str) -> Image.Image:
    try:
        return read_photo(source, turn=False).image
    except InputError as error:
        kind = "raw photo" if suffix in RAW_SUFFIXES else "float image" if suffix in FLOAT_SUFFIXES else "photo"
        raise InputError(f"The {kind} {source} cannot be used: {error}.", "Replace or remove it.") from error


def copy_file(source: Path, folder: Path, name: str) -> Path:
    """Copy a file into `folder` as `name` with its own suffix, unless it is there already."""
    target = folder / f"{name}{source.suffix.lower()}"
    stat = source.stat()
    if target.is_file() and (target.stat().st_size, target.stat().st_mtime) == (stat.st_size, stat.st_mtime):
        return target
    with atomic_path(target) as temporary:
        copied(source, temporary)
    return target


def copy_labels(
    source: Path, folder: Path, name: str, size: tuple[int, int], colors: Colors | None, ignore_id: int
) -> tuple[Path, set[int]]:
    """Write a label map as an index PNG of the photo's size; returns its path and the ids in it.

    Raises:
        InputError: it is no label map, or not of the photo's shape.
    """
    values = read_labels(source, colors, ignore_id)
    target = folder / f"{name}.png"
    with atomic_path(target) as temporary:
        _save_map(_fitted(values, size, source), temporary)
    return target, set(np.unique(values).tolist())


def copy_mask(source: Path, folder: Path, name: str, size: tuple[int, int]) -> Path:
    """Write a mask as a black and white PNG of the photo's size. Raises InputError when it cannot."""
    values = read_mask(source).astype(np.uint8) * 255
    target = folder / f"{name}.png"
    with atomic_path(target) as temporary:
        _save_map(_fitted(values, size, source), temporary)
    return target


def copy_confidence(source: Path, folder: Path, name: str, size: tuple[int, int]) -> Path:
    """Write how sure labels are as a grey PNG of the photo's size, 255 for certain.

    Raises:
        InputError: it is no confidence or probability map, or not of the photo's shape.
    """
    values = read_confidence(source)
    target = folder / f"{name}.png"
    with atomic_path(target) as temporary:
        _save_map(_fitted(values, size, source), temporary)
    return target


def copy_depth(source: Path, folder: Path, name: str, scale: float) -> Path:
    """Write a depth map as float32 EXR: distance along the camera's z axis in units of the SfM frame, 0 = unknown.

    Args:
        scale: units of the frame per unit of the file.
    Raises:
        InputError: it cannot be read.
    """
    import OpenImageIO as oiio

    if source.suffix.lower() == ".npy":
        try:
            values = read_array(source)
        except InputError as error:
            raise InputError(f"The depth map {source} is damaged: {error}.", "Replace or remove it.") from error
    else:
        pixels = oiio.ImageBuf(str(source))
        if pixels.has_error:
            raise InputError(f"The depth map {source} cannot be read: {pixels.geterror()}.", "Replace or remove it.")
        whole = {"uint8": oiio.UINT8, "uint16": oiio.UINT16}  # as they are, not as parts of the largest value
        values = pixels.get_pixels(whole.get(str(pixels.spec().format), oiio.FLOAT))
    values = np.squeeze(np.asarray(values))
    depth = (values[..., 0] if values.ndim == 3 else values).astype(np.float32) * np.float32(scale)
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
    target = folder / f"{name}.exr"
    with atomic_path(target) as temporary:
        spec = oiio.ImageSpec(depth.shape[1], depth.shape[0], 1, oiio.FLOAT)
        spec.channelnames = ("Z",)
        output = oiio.ImageBuf(spec)
        output.set_pixels(oiio.ROI(), np.ascontiguousarray(depth)[..., None])
        if not output.write(str(temporary)):
            raise OSError(output.geterror())
    return target


def _fitted(values: np.ndarray, size: tuple[int, int], source: Path) -> np.ndarray:
    height, width = values.shape
    if abs(width / height / (size[0] / size[1]) - 1) > 0.02:
        raise InputError(
            f"{source} is {width}×{height}, its photo {size[0]}×{size[1]}.", "Both need the same proportions."
        )
    if (width, height) == size:
        return values
    return np.asarray(Image.fromarray(values).resize(size, Image.Resampling.NEAREST))


def _save_map(values: np.ndarray, path: Path) -> None:
    Image.fromarray(values.astype(np.uint8) if values.max(initial=0) < 256 else values).save(path, compress_level=2)
