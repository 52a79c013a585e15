"""Decoding photos: every still format becomes upright 8-bit sRGB with its EXIF facts."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pillow_heif
from PIL import Image, ImageCms, UnidentifiedImageError

from ..errors import InputError
from ..progress import log
from .exif import photo_facts

pillow_heif.register_heif_opener()
# Stitched panoramas are larger than Pillow's decompression-bomb limit; ours is what a decode may take in memory.
Image.MAX_IMAGE_PIXELS = 600_000_000

RAW_SUFFIXES = {
    ".3fr", ".arw", ".cr2", ".cr3", ".dcr", ".dng", ".erf", ".iiq", ".kdc", ".mef", ".mos", ".mrw", ".nef", ".nrw",
    ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f",
}  # fmt: skip
FLOAT_SUFFIXES = {".exr", ".hdr"}
PHOTO_SUFFIXES = RAW_SUFFIXES | FLOAT_SUFFIXES | {
    ".jpg", ".jpeg", ".jpe", ".png", ".tif", ".tiff", ".webp", ".bmp", ".heic", ".heif", ".hif", ".avif", ".ppm",
    ".jp2", ".tga",
}  # fmt: skip
ROTATE = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}


@dataclass(frozen=True)
class Photo:
    """A decoded photo.

    `image` is upright 8-bit RGB or RGBA, no larger than asked for; `full_size` the upright size of the original;
    `orientation` the EXIF value that was applied (1 = none); `lossy` whether it came from a lossy format; `facts` are
    those of `exif.photo_facts`.
    """

    image: Image.Image
    full_size: tuple[int, int]
    orientation: int = 1
    lossy: bool = False
    facts: dict[str, Any] = field(default_factory=dict)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file as stored (EXIF orientation not applied), without decoding it.

    Raises:
        InputError: the file is not a readable image.
    """
    if path.suffix.lower() in FLOAT_SUFFIXES:
        import OpenImageIO as oiio

        source = oiio.ImageInput.open(str(path))
        if source is None:
            raise InputError(f"{path} is not a readable image: {oiio.geterror()}.", "Replace or remove it.")
        return source.spec().width, source.spec().height
    try:
        with Image.open(path) as image:
            return image.size
    except (OSError, UnidentifiedImageError, ValueError) as error:
        raise InputError(f"{path} is not a readable image: {error}.", "Replace or remove it.") from error


def read_photo(path: Path, max_size: int = 0, exposure: float = 1.0) -> Photo:
    """Decode one photo.

    EXIF orientation is baked in, embedded colour profiles are turned into sRGB, 16-bit files become 8-bit, and float
    images go through the sRGB curve after multiplication with `exposure`.

    Args:
        path: any still image.
        max_size: the long side is shrunk to this many pixels; 0 keeps the size.
        exposure: factor for scene-linear images.
    Raises:
        InputError: it is empty, truncated, unreadable or no image; the message is one clause, fit as a reason.
    """
    try:
        if path.stat().st_size == 0:
            raise InputError("the file is empty (0 bytes)")
        suffix = path.suffix.lower()
        if suffix in FLOAT_SUFFIXES:
            return _fit(_read_float(path, exposure), max_size)
        if suffix in RAW_SUFFIXES and suffix != ".raw":
            return _fit(_read_raw(path), max_size)
        return _fit(_read_pillow(path, max_size), max_size)
    except PermissionError as error:
        raise InputError("the file cannot be read: permission denied") from error
    except UnidentifiedImageError as error:
        raise InputError("the file is not an image, whatever its name says") from error
    except Image.DecompressionBombError as error:
        raise InputError(f"the image is too large: {error}") from error
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        text = str(error).lower()
        if "truncated" in text or "eof" in text or "broken data" in text or "premature" in text:
            raise InputError("the file is truncated: its end is missing") from error
        raise InputError(f"the file is damaged: {error}") from error


def _fit(photo: Photo, max_size: int) -> Photo:
    image = photo.image
    long_side = max(image.size)
    if max_size and long_side > max_size:
        scale = max_size / long_side
        size = max(1, round(image.width * scale)), max(1, round(image.height * scale))
        image = image.resize(size, Image.Resampling.LANCZOS, reducing_gap=3.0)
    return Photo(image, photo.full_size, photo.orientation, photo.lossy, photo.facts)


def _read_pillow(path: Path, max_size: int) -> Photo:
    with Image.open(path) as image:
        exif = image.getexif()
        orientation = int(exif.get(0x0112, 1) or 1)
        stored_size = image.size
        facts = photo_facts(exif, stored_size)
        if "GPano:ProjectionType" in str(image.info.get("xmp", b"")[:20000]):
            facts["panorama"] = True
        if max_size and image.format == "JPEG":
            # The decoder itself halves the size as often as it can without falling below the working size.
            scale = max_size / max(stored_size)
            if scale < 0.5:
                image.draft("RGB", (round(stored_size[0] * scale), round(stored_size[1] * scale)))
        if image.mode in ("I;16", "I;16B", "I;16L", "I", "F"):
            pixels = _grey_to_8bit(np.asarray(image))
            decoded = Image.fromarray(pixels).convert("RGB")
        elif image.format == "TIFF" and _is_deep_tiff(image):
            decoded = _read_deep(path)
        else:
            image.load()
            decoded = _to_srgb(image)
        decoded.info.clear()
        lossy = image.format in ("JPEG", "MPO", "HEIF", "WEBP", "AVIF")
    decoded = upright(decoded, orientation)
    full = (stored_size[1], stored_size[0]) if orientation >= 5 else stored_size
    return Photo(decoded, full, orientation, lossy, facts)


def upright(image: Image.Image, orientation: int) -> Image.Image:
    """Apply an EXIF orientation (1–8)."""
    return image.transpose(ROTATE[orientation]) if orientation in ROTATE else image


def _to_srgb(image: Image.Image) -> Image.Image:
    """Convert any 8-bit mode to RGB or RGBA in sRGB."""
    profile = image.info.get("icc_profile")
    transparent = image.mode in ("RGBA", "LA", "PA") or (image.mode == "P" and "transparency" in image.info)
    if image.mode in ("P", "PA", "LA", "1"):
        image = image.convert("RGBA" if transparent else "RGB")
    alpha = image.getchannel("A") if image.mode == "RGBA" else None
    if profile:
        try:
            source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
            if "srgb" not in ImageCms.getProfileDescription(source).lower():
                base = image.convert("RGB") if image.mode == "RGBA" else image
                converted = ImageCms.profileToProfile(base, source, ImageCms.createProfile("sRGB"), outputMode="RGB")
                image = converted if converted is not None else image
        except (ImageCms.PyCMSError, OSError) as error:
            # A damaged profile only costs some colour accuracy; the pixels are good.
            log.info("embedded colour profile ignored: %s", error)
    image = image.convert("RGB")
    if alpha is not None and alpha.getextrema() != (255, 255):
        image.putalpha(alpha)
    return image


def _grey_to_8bit(values: np.ndarray) -> np.ndarray:
    top = 65535.0 if values.dtype.kind in "ui" or values.max() > 1 else 1.0
    return np.clip(values.astype(np.float64) / top * 255 + 0.5, 0, 255).astype(np.uint8)


def _is_deep_tiff(image: Image.Image) -> bool:
    bits = image.tag_v2.get(258, (8,)) if hasattr(image, "tag_v2") else (8,)  # type: ignore[attr-defined]
    return max(bits if isinstance(bits, tuple) else (bits,)) > 8


def _read_deep(path: Path) -> Image.Image:
    """A 16-bit or float RGB(A) TIFF, which Pillow cannot hold, as 8-bit."""
    pixels, _ = _read_oiio(path)
    if pixels.dtype.kind == "f":
        return Image.fromarray(linear_to_srgb8(pixels))
    return Image.fromarray((pixels.astype(np.float32) / 65535 * 255 + 0.5).astype(np.uint8))


def _read_oiio(path: Path) -> tuple[np.ndarray, Any]:
    """Pixels (H, W, 3 or 4) in the file's own kind (uint16 or float32) and its OpenImageIO spec."""
    import OpenImageIO as oiio

    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise ValueError(oiio.geterror())
    spec = source.spec()
    is_float = str(spec.format) in ("half", "float", "double")
    pixels = source.read_image(0, 0, 0, spec.nchannels, "float" if is_float else "uint16")
    if pixels is None:
        raise ValueError(source.geterror())
    names = [name.split(".")[-1].upper() for name in spec.channelnames]
    if all(c in names for c in "RGB"):
        picked = [names.index(c) for c in "RGB"] + ([names.index("A")] if "A" in names else [])
        pixels = pixels[..., picked]
    elif spec.nchannels < 3:
        pixels = np.repeat(pixels[..., :1], 3, axis=-1)
    return pixels, spec


def _read_float(path: Path, exposure: float) -> Photo:
    pixels, spec = _read_oiio(path)
    orientation = int(spec.getattribute("Orientation") or 1)
    image = upright(Image.fromarray(linear_to_srgb8(pixels, exposure)), orientation)
    return Photo(image, image.size, orientation)


def linear_to_srgb8(pixels: np.ndarray, exposure: float = 1.0) -> np.ndarray:
    """Scene-linear float RGB(A) to 8-bit sRGB with IEC 61966-2-1's curve; alpha stays linear. NaN becomes black."""
    color = np.clip(np.nan_to_num(pixels[..., :3] * exposure), 0, 1)
    encoded = np.where(color <= 0.0031308, color * 12.92, 1.055 * color ** (1 / 2.4) - 0.055)
    if pixels.shape[-1] == 4:
        encoded = np.concatenate([encoded, np.clip(pixels[..., 3:], 0, 1)], -1)
    return (encoded * 255 + 0.5).astype(np.uint8)


def float_exposure(paths: list[Path]) -> float:
    """One exposure for all scene-linear files of a capture.

    1 when they already lie in the displayable range (the median of the files' 99th percentiles in [0.2, 1.5]);
    otherwise what brings that median to 1.
    """
    tops = []
    for path in paths[:: max(1, len(paths) // 12)]:
        try:
            tops.append(float(np.nanpercentile(_read_oiio(path)[0][..., :3], 99)))
        except ValueError:
            continue  # the file gets its own reason when it is decoded
    top = float(np.median(tops)) if tops else 1.0
    return 1.0 if 0.2 <= top <= 1.5 or not np.isfinite(top) or top <= 0 else 1.0 / top


def _read_raw(path: Path) -> Photo:
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            # Fixed brightness: an automatic one would differ from photo to photo of the same wall.
            pixels = raw.postprocess(use_camera_wb=True, no_auto_bright=True, output_bps=8)
    except rawpy.LibRawError as error:
        raise InputError(f"the camera raw file cannot be developed: {error}") from error
    image = Image.fromarray(pixels)
    return Photo(image, image.size, 1, False, _raw_facts(path, image.size))


def _raw_facts(path: Path, size: tuple[int, int]) -> dict[str, Any]:
    """EXIF of raw formats that are TIFF inside (most are); none of the others."""
    with open(path, "rb") as file:
        if file.read(2) not in (b"II", b"MM"):
            return {}
        file.seek(0)
        exif = Image.Exif()
        try:
            exif.load_from_fp(file)
            return photo_facts(exif, size)
        except (OSError, ValueError, SyntaxError, KeyError, struct.error) as error:
            log.info("no EXIF in %s: %s", path, error)
            return {}
