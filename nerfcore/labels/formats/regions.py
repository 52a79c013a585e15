"""What all formats of labels have in common: pictures with regions of a class, and how regions are drawn and packed."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import skimage
from PIL import Image, UnidentifiedImageError

from ...errors import InputError
from ...params import LARGEST_PICTURE

Color = tuple[int, int, int]
MOST_PIXELS = 2**29  # of a picture
STUFF = "stuff"  # how files call areas that are no single thing, in tools for which else every area is one


@dataclass(frozen=True)
class Region:
    """An area of a picture, as the patch (h, w) bool that encloses it, at the column `left` and row `top`; instance: number
    of the thing in this picture, 0 for none."""

    class_name: str
    patch: np.ndarray
    left: int
    top: int
    instance: int = 0

    @property
    def bounds(self) -> tuple[int, int, int, int]:
        """Left, top, right, bottom (exclusive)."""
        return self.left, self.top, self.left + self.patch.shape[1], self.top + self.patch.shape[0]

    def paint(self, values: np.ndarray, value: int) -> None:
        """Set what is in the area to a value, in an array (H, W) of the whole picture."""
        left, top, right, bottom = self.bounds
        values[top:bottom, left:right][self.patch] = value

    def mask(self, width: int, height: int) -> np.ndarray:
        """The area in a mask (H, W) bool of the whole picture."""
        return placed(self.patch, self.left, self.top, width, height)


def region_of(class_name: str, mask: np.ndarray, instance: int = 0) -> Region:
    """The region that a mask (H, W) bool of a whole picture shows."""
    rows = np.flatnonzero(mask.any(1))
    if not len(rows):
        return Region(class_name, np.zeros((0, 0), bool), 0, 0, instance)
    top, inside = int(rows[0]), mask[rows[0] : rows[-1] + 1]
    columns = np.flatnonzero(inside.any(0))
    return Region(class_name, inside[:, columns[0] : columns[-1] + 1].copy(), int(columns[0]), top, instance)


@dataclass(frozen=True)
class Picture:
    """The regions of one picture, later ones over earlier ones. name: of its file."""

    name: str
    width: int
    height: int
    regions: list[Region]


@dataclass(frozen=True)
class LabelClass:
    """A class: its id in label maps, name and sRGB colour 0–255."""

    id: int
    name: str
    color: Color


@dataclass
class Source:
    """What a file holds. classes: names in their order, with colours where they have one; skipped: kinds of shapes that
    have no area, and how many there were, complete once the pictures were read; ids: which id new classes get, if it is
    free, where the pictures themselves hold ids."""

    pictures: Iterator[Picture]
    classes: dict[str, Color | None] = field(default_factory=dict)
    skipped: dict[str, int] = field(default_factory=dict)
    ids: dict[str, int] = field(default_factory=dict)

    def skip(self, kind: str) -> None:
        self.skipped[kind] = self.skipped.get(kind, 0) + 1


def files_in(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """Files of these suffixes in a folder; where there are none, those in the folders in it, as cameras of one capture have
    their own."""
    for place in (folder.glob("*"), folder.rglob("*")):
        found = sorted(file for file in place if file.suffix.lower() in suffixes and file.is_file())
        if found:
            return found
    return []


def read_json(path: Path) -> Any:
    """The JSON in a file. Raises InputError."""
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.", "Give the file that the labelling tool wrote.") from error
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read as JSON: {error}.", "Export the labels once more.") from error


def checked_size(width: Any, height: Any, name: str) -> tuple[int, int]:
    """Width and height of a picture as whole numbers. Raises InputError where they cannot be right."""
    try:
        size = int(width), int(height)
    except (TypeError, ValueError) as error:
        raise InputError(f"The size of the picture {name} is not given.", "Export the labels once more.") from error
    if not (min(size) > 0 and max(size) <= LARGEST_PICTURE and size[0] * size[1] <= MOST_PIXELS):
        raise InputError(f"The picture {name} has the size {size[0]}×{size[1]}.", "Export the labels once more.")
    return size


def polygon_mask(points: Sequence[float] | Sequence[Sequence[float]], width: int, height: int) -> np.ndarray:
    """The pixels (H, W) whose centres lie inside a polygon of corners x, y in pixels, (N, 2) or flat."""
    corners = np.asarray(points, np.float64).reshape(-1, 2)
    if len(corners) < 3 or not np.isfinite(corners).all():
        return np.zeros((height, width), bool)
    low, high = np.clip([np.floor(corners.min(0)), np.ceil(corners.max(0))], 0, [width, height]).astype(int)
    (left, top), (columns, rows) = low.tolist(), (high - low).tolist()
    patch = skimage.draw.polygon2mask((rows, columns), (corners - low)[:, ::-1] - 0.5)
    return placed(patch, left, top, width, height)


def box_mask(left: float, top: float, right: float, bottom: float, width: int, height: int) -> np.ndarray:
    """The pixels (H, W) whose centres lie inside a box."""
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    return ((y >= top) & (y < bottom))[:, None] & ((x >= left) & (x < right))


def ellipse_mask(x: float, y: float, rx: float, ry: float, width: int, height: int, degrees: float = 0) -> np.ndarray:
    """The pixels (H, W) whose centres lie inside an ellipse, turned clockwise on the screen by some degrees."""
    if min(rx, ry) <= 0:
        return np.zeros((height, width), bool)
    dx, dy = np.meshgrid(np.arange(width) + 0.5 - x, np.arange(height) + 0.5 - y)
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return ((dx * cos + dy * sin) / rx) ** 2 + ((dy * cos - dx * sin) / ry) ** 2 <= 1


def placed(patch: np.ndarray, left: int, top: int, width: int, height: int) -> np.ndarray:
    """A patch (h, w) bool at its place in a picture (H, W); what stands out is cut off."""
    mask = np.zeros((height, width), bool)
    first_row, first_column = max(0, top), max(0, left)
    part = patch[first_row - top : max(0, height - top), first_column - left : max(0, width - left)]
    mask[first_row : first_row + part.shape[0], first_column : first_column + part.shape[1]] = part
    return mask


def runs_of(values: np.ndarray) -> list[int]:
    """Lengths of the runs of a flat mask, beginning with that of zeros, which may be 0."""
    flat = np.asarray(values, bool).reshape(-1)
    changes = np.flatnonzero(np.diff(flat)) + 1
    runs = np.diff(np.concatenate([[0], changes, [len(flat)]])).tolist()
    return [0, *runs] if len(flat) and flat[0] else runs


def from_runs(runs: Sequence[int], count: int) -> np.ndarray:
    """The flat mask (count,) of such runs. Raises ValueError where they are of another length."""
    lengths = np.asarray(runs, np.int64)
    if (lengths < 0).any() or int(lengths.sum()) != count:
        raise ValueError(f"its runs make {int(lengths.sum())} pixels instead of {count}")
    return np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)


def png_bytes(values: np.ndarray) -> bytes:
    """A picture as PNG."""
    out = io.BytesIO()
    Image.fromarray(values).save(out, "PNG")
    return out.getvalue()


def picture_of(data: bytes | Path, name: str) -> Image.Image:
    """A picture from bytes or a file. Raises InputError."""
    try:
        image = Image.open(io.BytesIO(data) if isinstance(data, bytes) else data)
        checked_size(*image.size, name)
        image.load()
        return image
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(f"The labels of {name} cannot be read: {error}.", "Export the labels once more.") from error


def mask_of_png(data: bytes, name: str) -> np.ndarray:
    """A mask (h, w): opaque pixels where the PNG has transparency, else those that are not black."""
    image = picture_of(data, name)
    if image.mode in ("RGBA", "LA"):
        return np.asarray(image.getchannel("A")) > 0
    return np.asarray(image.convert("RGB")).max(2) > 0 if image.mode in ("RGB", "P") else np.asarray(image) > 0


def from_base64(text: Any, name: str) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except (ValueError, TypeError) as error:
        raise InputError(f"The labels of {name} are damaged: {error}.", "Export the labels once more.") from error


def hex_color(text: Any) -> Color | None:
    """The colour “#rrggbb” (or "#rgb"); None where it is none."""
    digits = str(text or "").lstrip("#")
    digits = "".join(2 * d for d in digits) if len(digits) == 3 else digits[:6]
    try:
        value = bytes.fromhex(digits)
    except ValueError:
        return None
    return (value[0], value[1], value[2]) if len(value) == 3 else None


def color_hex(color: Color) -> str:
    return "#" + bytes(color).hex()


def id_picture(numbers: np.ndarray) -> np.ndarray:
    """Numbers (H, W) below 2²⁴ as RGB: red counts 1, green 256, blue 65536."""
    return np.stack([numbers & 255, numbers >> 8 & 255, numbers >> 16 & 255], -1).astype(np.uint8)


def numbers_of(picture: Image.Image) -> np.ndarray:
    """The numbers (H, W) int64 of such a picture; of a grey or palette picture its values."""
    if picture.mode in ("RGB", "RGBA"):
        return np.asarray(picture)[..., :3].astype(np.int64) @ [1, 256, 65536]
    return np.asarray(picture).astype(np.int64)


def numbered(pictures: Iterable[Picture]) -> Iterator[tuple[int, Picture]]:
    return enumerate(pictures, 1)
