"""Decoding photos: every still format becomes upright 8-bit sRGB, alpha straight, with its EXIF facts."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pillow_heif
from PIL import Image, ImageCms, UnidentifiedImageError

from ..errors import InputError
from ..progress import log
from .exif import photo_facts
from .limits import UNDECODABLE
from .picture import Picture, associated, exposed, from_channels, from_image, resized, to_srgb8, without_unused_alpha
from .suffixes import FLOAT_SUFFIXES, RAW_SUFFIXES, TIFF_SUFFIXES

pillow_heif.register_heif_opener()

FLOAT_KINDS = ("half", "float", "double")
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

    `picture` is upright 8-bit sRGB without or with straight alpha, no larger than asked for; `full_size` the upright
    size of the original; `orientation` the EXIF value that was applied (1 = none); `lossy` whether it came from a lossy
    format; `facts` are those of `exif.photo_facts`.
    """

    picture: Picture
    full_size: tuple[int, int]
    orientation: int = 1
    lossy: bool = False
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def image(self) -> Image.Image:
        """The picture as Pillow's, RGB or RGBA."""
        return Image.fromarray(self.picture.pixels)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file as stored (EXIF orientation not applied), without decoding it.

    Raises:
        InputError: the file is not a readable image.
    """
    if path.suffix.lower() in FLOAT_SUFFIXES or is_linear(path) or _unknown_tiff(path):
        source = oiio.ImageInput.open(str(path))
        if source is None:
            raise InputError(f"{path} is not a readable image: {oiio.geterror()}.", "Replace or remove it.")
        return source.spec().width, source.spec().height
    try:
        with Image.open(path) as image:
            return _stored_size(image, orientation_of(image))
    except UNDECODABLE as error:
        raise InputError(f"{path} is not a readable image: {error}.", "Replace or remove it.") from error


def read_photo(path: Path, max_size: int = 0, exposure: float = 1.0, turn: bool = True) -> Photo:
    """Decode one photo.

    EXIF orientation is baked in, embedded colour profiles are turned into sRGB, 16-bit files become 8-bit, and float
    images (EXR, HDR, TIFF) go through the sRGB curve after multiplication with `exposure`. Colours of files with
    associated alpha are freed of it.

    Args:
        path: any still image.
        max_size: the long side is shrunk to this many pixels; 0 keeps the size.
        exposure: factor for scene-linear images.
        turn: False leaves the pixels as stored, whatever EXIF says. HEIF has no such pixels: turning is a part of
            its decoding.
    Raises:
        InputError: it is empty, truncated, unreadable or no image; the message is one clause, fit as a reason.
    """
    try:
        if path.stat().st_size == 0:
            raise InputError("the file is empty (0 bytes)")
        suffix = path.suffix.lower()
        if is_linear(path):
            return _fit(_read_float(path, exposure, turn), max_size)
        if suffix in RAW_SUFFIXES and suffix != ".raw":
            return _fit(_read_raw(path, turn), max_size)
        if _unknown_tiff(path):
            return _fit(_read_float(path, 1.0, turn), max_size)
        return _fit(_read_pillow(path, max_size, turn), max_size)
    except PermissionError as error:
        raise InputError("the file cannot be read: permission denied") from error
    except UnidentifiedImageError as error:
        raise InputError("the file is not an image, whatever its name says") from error
    except Image.DecompressionBombError as error:
        raise InputError(f"the image is too large: {error}") from error
    except MemoryError as error:
        raise InputError("the image is larger than the memory") from error
    except UNDECODABLE as error:
        text = str(error).lower()
        if "truncated" in text or "eof" in text or "broken data" in text or "premature" in text:
            raise InputError("the file is truncated: its end is missing") from error
        raise InputError(f"the file is damaged: {error}") from error


def _fit(photo: Photo, max_size: int) -> Photo:
    width, height = photo.picture.size
    if not max_size or max(width, height) <= max_size:
        return photo
    scale = max_size / max(width, height)
    return replace(photo, picture=resized(photo.picture, max(1, round(width * scale)), max(1, round(height * scale))))


def _read_pillow(path: Path, max_size: int, turn: bool) -> Photo:
    with Image.open(path) as image:
        exif = image.getexif()
        tag = orientation_of(image)
        orientation = tag if turn else 1
        stored_size = _stored_size(image, tag)
        facts = photo_facts(exif, stored_size)
        if max_size and image.format == "JPEG":
            # The decoder itself halves the size as often as it can without falling below the working size.
            scale = max_size / max(stored_size)
            if scale < 0.5:
                image.draft("RGB", (max(1, round(stored_size[0] * scale)), max(1, round(stored_size[1] * scale))))
        lossy = image.format in ("JPEG", "MPO", "HEIF", "WEBP", "AVIF")
        if _is_deep(image):
            decoded = Image.fromarray(to_srgb8(_read_oiio(path)[0]).pixels)
            decoded.info["icc_profile"] = image.info.get("icc_profile")
            decoded = _to_srgb(decoded)
        elif image.mode in ("I;16", "I;16B", "I;16L", "I", "F"):
            decoded = stored_pixels(Image.fromarray(_grey_to_8bit(np.asarray(image))).convert("RGB"), image.format, tag)
        else:
            image.load()
            decoded = stored_pixels(_to_srgb(image), image.format, tag)
        if b"GPano:ProjectionType" in image.info.get("xmp", b""):  # which may stand behind the pixels of a PNG
            facts["panorama"] = True
    full = (stored_size[1], stored_size[0]) if orientation >= 5 else stored_size
    return Photo(_upright_picture(decoded, orientation), full, orientation, lossy, facts)


def _upright_picture(image: Image.Image, orientation: int) -> Picture:
    return without_unused_alpha(from_image(upright(image, orientation)))


def orientation_of(image: Image.Image) -> int:
    """The EXIF orientation (1–8) of an image that was opened and not yet loaded; 1 where there is none."""
    if image.format == "PNG" and "exif" not in image.info and "xmp" not in image.info:
        return 1  # Pillow would decode the whole file in search of one
    value = image.getexif().get(0x0112, 1)
    return value if isinstance(value, int) and value in ROTATE else 1


def stored_pixels(image: Image.Image, format: str | None, orientation: int) -> Image.Image:
    """A loaded image as it is stored: Pillow has turned TIFFs by their orientation."""
    return upright(image, {6: 8, 8: 6}.get(orientation, orientation)) if format == "TIFF" else image


def _stored_size(image: Image.Image, orientation: int) -> tuple[int, int]:
    return (image.height, image.width) if image.format == "TIFF" and orientation >= 5 else image.size


def upright(image: Image.Image, orientation: int) -> Image.Image:
    """Apply an EXIF orientation (1–8)."""
    return image.transpose(ROTATE[orientation]) if orientation in ROTATE else image


def _to_srgb(image: Image.Image) -> Image.Image:
    """Convert any 8-bit mode to RGB or RGBA in sRGB, alpha straight."""
    if image.mode in ("RGBa", "La"):
        image = image.convert(image.mode.upper())
    # Also palettes, and PNGs in which one colour means transparent.
    alpha = image.convert("RGBA").getchannel("A") if image.has_transparency_data else None
    base = image
    if image.mode in ("LA", "1"):
        base = image.convert("L")
    elif image.mode in ("P", "PA", "RGBA"):
        base = image.convert("RGB")
    image = _from_profile(base, image.info.get("icc_profile"))
    if alpha is not None:
        image.putalpha(alpha)
    return image


def other_profile(profile: bytes | None) -> ImageCms.ImageCmsProfile | None:
    """An embedded colour profile that is not sRGB's; None where there is none, or a damaged one."""
    if not profile:
        return None
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        return None if "srgb" in ImageCms.getProfileDescription(source).lower() else source
    except (ImageCms.PyCMSError, OSError) as error:
        # A damaged profile only costs some colour accuracy; the pixels are good.
        log.info("embedded colour profile ignored: %s", error)
        return None


def _from_profile(image: Image.Image, profile: bytes | None) -> Image.Image:
    """An image without alpha, in the colours of an embedded profile, as sRGB."""
    source = other_profile(profile)
    if source is not None:
        try:
            converted = ImageCms.profileToProfile(image, source, ImageCms.createProfile("sRGB"), outputMode="RGB")
            image = converted if converted is not None else image
        except (ImageCms.PyCMSError, OSError) as error:
            log.info("embedded colour profile ignored: %s", error)  # it is one of other pictures, CMYK for instance
    return image.convert("RGB")


def _grey_to_8bit(values: np.ndarray) -> np.ndarray:
    top = 65535.0 if values.dtype.kind in "ui" or values.max() > 1 else 1.0
    return np.clip(values.astype(np.float64) / top * 255 + 0.5, 0, 255).astype(np.uint8)


def _is_deep(image: Image.Image) -> bool:
    """Whether a file has colours, or grey with alpha, of more bits than Pillow can hold."""
    if image.mode.startswith("I"):
        return False
    if image.format == "TIFF":
        bits = image.tag_v2.get(258, (8,))  # type: ignore[attr-defined]
        return max(bits if isinstance(bits, tuple) else (bits,)) > 8
    # The last part of a tile is its arguments: for PNG the mode of the rows as stored.
    tile = getattr(image, "tile", None)
    return image.format == "PNG" and bool(tile) and ";16" in str(tile[0][3])


def _read_oiio(path: Path) -> tuple[Picture, Any]:
    """A picture in the file's own kind (uint16 sRGB, or float32 linear) and alpha, and its OpenImageIO spec.

    Raises:
        ValueError: it cannot be read.
    """
    asked = oiio.ImageSpec()
    asked["oiio:UnassociatedAlpha"] = 1  # as it is in the file, please
    source = oiio.ImageInput.open(str(path), asked)
    if source is None:
        raise ValueError(oiio.geterror())
    spec = source.spec()
    is_float = str(spec.format) in FLOAT_KINDS
    pixels = source.read_image(0, 0, 0, spec.nchannels, "float" if is_float else "uint16")
    if pixels is None:
        raise ValueError(source.geterror())
    names = [name.split(".")[-1].upper() for name in spec.channelnames]
    color = [names.index(c) for c in "RGB"] if all(c in names for c in "RGB") else [0, 1, 2][: len(names)]
    color = color if len(color) == 3 else [0]
    alpha = [names.index("A")] if "A" in names and names.index("A") not in color else []
    kept = "straight" if spec.getattribute("oiio:UnassociatedAlpha") else "associated"
    return from_channels(pixels[..., color + alpha], "linear" if is_float else "srgb", kept), spec


def _unknown_tiff(path: Path) -> bool:
    """Whether a file is a TIFF of a kind that Pillow does not know and OpenImageIO does, such as grey of 16 bits with alpha."""
    if path.suffix.lower() not in TIFF_SUFFIXES:
        return False
    try:
        with Image.open(path):
            return False
    except UNDECODABLE:
        return oiio.ImageInput.open(str(path)) is not None


def _read_float(path: Path, exposure: float, turn: bool) -> Photo:
    found, spec = _read_oiio(path)
    orientation = int(spec.getattribute("Orientation") or 1) if turn else 1
    picture = _upright_picture(Image.fromarray(to_srgb8(exposed(found, exposure)).pixels), orientation)
    return Photo(picture, picture.size, orientation)


def is_linear(path: Path) -> bool:
    """Whether a file holds scene-linear light: EXR, HDR and float TIFF; False also where it cannot be read."""
    suffix = path.suffix.lower()
    if suffix not in TIFF_SUFFIXES:
        return suffix in FLOAT_SUFFIXES
    source = oiio.ImageInput.open(str(path))
    return source is not None and str(source.spec().format) in FLOAT_KINDS


def float_exposure(paths: list[Path]) -> float:
    """One exposure for all scene-linear files of a capture.

    1 when they already lie in the displayable range (the median of the files' 99th percentiles in [0.2, 1.5]);
    otherwise what brings that median to 1.
    """
    tops = []
    for path in paths[:: max(1, len(paths) // 12)]:
        try:
            tops.append(float(np.nanpercentile(associated(_read_oiio(path)[0]).pixels[..., :3], 99)))
        except ValueError:
            continue  # the file gets its own reason when it is decoded
    top = float(np.median(tops)) if tops else 1.0
    return 1.0 if 0.2 <= top <= 1.5 or not np.isfinite(top) or top <= 0 else 1.0 / top


def _read_raw(path: Path, turn: bool) -> Photo:
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            # Fixed brightness: an automatic one would differ from photo to photo of the same wall.
            # Turning is part of developing unless another flip than the camera's is asked for.
            flip = None if turn else 0
            pixels = raw.postprocess(use_camera_wb=True, no_auto_bright=True, output_bps=8, user_flip=flip)
    except rawpy.LibRawError as error:
        raise InputError(f"the camera raw file cannot be developed: {error}") from error
    picture = Picture(pixels)
    return Photo(picture, picture.size, 1, False, _raw_facts(path, picture.size))


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
