"""Pictures that know what their numbers mean: how colour is encoded, and what alpha has done to it.

Every change between encodings, kinds of alpha and sizes goes through the functions here, so that no caller has to know
that curves apply to colours without their alpha, and filters to colours with it (Porter and Duff, Compositing Digital
Images, 1984).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from PIL import Image

Encoding = Literal["srgb", "linear"]
Alpha = Literal["none", "straight", "associated"]


@dataclass(frozen=True)
class Picture:
    """RGB, or RGB and alpha.

    pixels: (H, W, 3), or (H, W, 4) unless `alpha` is "none"; uint8 and uint16 in parts of their largest value, or
    float32. encoding: "srgb" (IEC 61966-2-1) or "linear" light; both have the primaries of sRGB. alpha: "straight"
    colours are those of what covers the pixel, "associated" (premultiplied) ones that times alpha, in the encoding.

    Raises:
        ValueError: the number of channels does not fit.
    """

    pixels: np.ndarray
    encoding: Encoding = "srgb"
    alpha: Alpha = "none"

    def __post_init__(self) -> None:
        channels = 3 if self.alpha == "none" else 4
        if self.pixels.ndim != 3 or self.pixels.shape[2] != channels:
            raise ValueError(f"a picture with alpha “{self.alpha}” has {channels} channels, not {self.pixels.shape}")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.pixels.shape[1], self.pixels.shape[0]


def from_channels(pixels: np.ndarray, encoding: Encoding = "srgb", alpha: Alpha = "straight") -> Picture:
    """The picture of (H, W, 1 to 4) pixels: grey is repeated; `alpha` is that of files with two or four channels."""
    if pixels.shape[2] <= 2:
        pixels = np.concatenate([np.repeat(pixels[..., :1], 3, 2), pixels[..., 1:]], 2)
    return Picture(pixels, encoding, alpha if pixels.shape[2] == 4 else "none")


def from_image(image: Image.Image) -> Picture:
    """The picture of an 8-bit sRGB RGB or RGBA image of Pillow's, whose alpha is straight."""
    return Picture(np.asarray(image), "srgb", "straight" if image.mode == "RGBA" else "none")


def to_bytes(values: np.ndarray) -> np.ndarray:
    """Values in [0, 1] → uint8, rounded."""
    return (values.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def srgb_to_linear(color: np.ndarray) -> np.ndarray:
    """sRGB in [0, 1] → linear light (IEC 61966-2-1)."""
    return np.where(color <= 0.04045, color / 12.92, ((np.maximum(color, 0) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(color: np.ndarray) -> np.ndarray:
    """Linear light ≥ 0 → sRGB (IEC 61966-2-1)."""
    return np.where(color <= 0.0031308, color * 12.92, 1.055 * np.maximum(color, 0) ** (1 / 2.4) - 0.055)


def as_float(picture: Picture) -> Picture:
    """The same picture as float32, integers as parts of their largest value."""
    if picture.pixels.dtype.kind == "f":
        return replace(picture, pixels=picture.pixels.astype(np.float32, copy=False))
    return replace(picture, pixels=picture.pixels / np.float32(np.iinfo(picture.pixels.dtype).max))


def associated(picture: Picture) -> Picture:
    """The picture with colours times alpha, float32 unless it is so already."""
    if picture.alpha != "straight":
        return picture
    pixels = as_float(picture).pixels
    return replace(
        picture, pixels=np.concatenate([pixels[..., :3] * pixels[..., 3:], pixels[..., 3:]], 2), alpha="associated"
    )


def straight(picture: Picture) -> Picture:
    """The picture with colours freed of alpha, float32 unless it is so already; black where alpha is 0."""
    if picture.alpha != "associated":
        return picture
    pixels = as_float(picture).pixels
    alpha = pixels[..., 3:]
    color = np.where(alpha > 0, pixels[..., :3] / np.where(alpha > 0, alpha, 1), 0)
    return replace(picture, pixels=np.concatenate([color, alpha], 2).astype(np.float32, copy=False), alpha="straight")


def to_linear(picture: Picture) -> Picture:
    """The picture in linear light, float32 unless it is so already; its kind of alpha stays."""
    return picture if picture.encoding == "linear" else _recoded(picture, "linear")


def to_srgb(picture: Picture) -> Picture:
    """The picture in sRGB, float32 unless it is so already; its kind of alpha stays. Light beyond 1 is not clipped."""
    return picture if picture.encoding == "srgb" else _recoded(picture, "srgb")


def _recoded(picture: Picture, encoding: Encoding) -> Picture:
    free = as_float(straight(picture))
    curve = srgb_to_linear if encoding == "linear" else linear_to_srgb
    color = curve(free.pixels[..., :3])
    pixels = np.concatenate([color, free.pixels[..., 3:]], 2).astype(np.float32, copy=False)
    result = replace(free, pixels=pixels, encoding=encoding)
    return associated(result) if picture.alpha == "associated" else result


def to_srgb8(picture: Picture) -> Picture:
    """The picture as 8-bit sRGB with straight alpha, if any; NaN becomes black, light beyond 1 white."""
    if picture.pixels.dtype == np.uint8 and picture.encoding == "srgb" and picture.alpha != "associated":
        return picture
    found = as_float(picture)
    found = to_srgb(straight(replace(found, pixels=np.nan_to_num(found.pixels))))
    return replace(found, pixels=to_bytes(found.pixels))


def exposed(picture: Picture, factor: float) -> Picture:
    """The picture with its colours, not its alpha, times a factor."""
    if factor == 1:
        return picture
    pixels = as_float(picture).pixels
    return replace(picture, pixels=np.concatenate([pixels[..., :3] * np.float32(factor), pixels[..., 3:]], 2))


def resized(picture: Picture, width: int, height: int) -> Picture:
    """The picture at another size and of the same kind, filtered with Lanczos' kernel in its own encoding.

    Colours weigh as much as they cover: what lies under alpha 0 does not show at edges.
    """
    if picture.size == (width, height):
        return picture
    if picture.alpha == "none" and picture.pixels.dtype == np.uint8:
        return replace(picture, pixels=np.asarray(_shrunk(Image.fromarray(picture.pixels), width, height)))
    weighted = as_float(associated(picture))
    planes = [
        np.asarray(_shrunk(Image.fromarray(np.ascontiguousarray(weighted.pixels[..., c])), width, height))
        for c in range(weighted.pixels.shape[2])
    ]
    result = replace(weighted, pixels=np.stack(planes, 2))
    # Colours are freed of alpha as filtered: its overshoots are theirs too.
    result = straight(result) if picture.alpha == "straight" else result
    if picture.alpha != "none":
        result.pixels[..., 3] = result.pixels[..., 3].clip(0, 1)
    if picture.pixels.dtype.kind == "f":
        return result
    top = np.iinfo(picture.pixels.dtype).max
    return replace(result, pixels=(result.pixels.clip(0, 1) * top + 0.5).astype(picture.pixels.dtype))


def _shrunk(image: Image.Image, width: int, height: int) -> Image.Image:
    # Far larger pictures are first averaged to three times the size; the kernel sees no difference.
    return image.resize((width, height), Image.Resampling.LANCZOS, reducing_gap=3.0)


def over(picture: Picture, background: float | np.ndarray) -> Picture:
    """The picture, float32 and without alpha, over a background: grey, or RGB (…, 3), in the picture's encoding."""
    if picture.alpha == "none":
        return as_float(picture)
    pixels = as_float(associated(picture)).pixels
    color = pixels[..., :3] + np.float32(1) * background * (1 - pixels[..., 3:])
    return replace(picture, pixels=color.astype(np.float32, copy=False), alpha="none")


def cut_out(picture: Picture, inside: np.ndarray) -> Picture:
    """The picture with straight alpha, 0 outside a mask (H, W) bool; colours and kind of number stay."""
    pixels = with_alpha(straight(picture)).pixels.copy()
    pixels[..., 3] = np.where(inside, pixels[..., 3], 0)
    return replace(picture, pixels=pixels, alpha="straight")


def with_alpha(picture: Picture) -> Picture:
    """The picture with an alpha channel: straight and full where it had none."""
    if picture.alpha != "none":
        return picture
    kind = picture.pixels.dtype
    height, width, channels = picture.pixels.shape
    pixels = np.empty((height, width, channels + 1), kind)
    for channel in range(channels):  # five times as fast as all at once
        pixels[..., channel] = picture.pixels[..., channel]
    pixels[..., channels] = 1 if kind.kind == "f" else np.iinfo(kind).max
    return replace(picture, pixels=pixels, alpha="straight")


def is_transparent(picture: Picture) -> bool:
    """Whether any pixel's alpha is not full."""
    if picture.alpha == "none":
        return False
    alpha = picture.pixels[..., 3]
    return bool((alpha < (1 if alpha.dtype.kind == "f" else np.iinfo(alpha.dtype).max)).any())


def without_unused_alpha(picture: Picture) -> Picture:
    """The picture, without its alpha channel where that is full everywhere."""
    if picture.alpha == "none" or is_transparent(picture):
        return picture
    return replace(picture, pixels=np.ascontiguousarray(picture.pixels[..., :3]), alpha="none")
