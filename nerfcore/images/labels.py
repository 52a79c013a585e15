"""Label maps and masks of photos: decoding, matching orientation and size, nearest neighbour only."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import InputError
from .decode import image_size, orientation_of, upright
from .limits import UNDECODABLE
from .soft_labels import PROBABILITY_SUFFIXES, read_probabilities
from .suffixes import TIFF_SUFFIXES

Colors = dict[int, tuple[int, int, int]]
LOSSY_FORMATS = ("JPEG", "MPO", "HEIF", "AVIF")
# Formats whose EXIF orientation is ours to apply: HEIF and raw decoders turn pictures themselves.
TAGGED_SUFFIXES = {".jpg", ".jpeg", ".jpe", ".png", ".webp", ".tif", ".tiff"}


class UnknownColors(InputError):
    """A label map has colours, and no class is known to have them."""


def read_labels(path: Path, colors: Colors | None = None, ignore_id: int = 0) -> np.ndarray:
    """Class ids (H, W) uint16 of a label map.

    Grey PNGs (8 or 16 bits) and palette PNGs hold the ids themselves; a palette whose colours are those of the
    classes, and RGB pictures, are looked up in `colors` (id → RGB). Transparent pixels become `ignore_id`. Of
    probability maps the most probable class is taken, `ignore_id` where none has any.

    Raises:
        InputError: it is no image, lossily compressed, or has colours that no class has. One clause, fit as a reason.
    """
    if path.suffix.lower() in PROBABILITY_SUFFIXES:
        shares = read_probabilities(path)
        return np.where(shares.max(2) > 0, shares.argmax(2), ignore_id).astype(np.uint16)
    try:
        with Image.open(path) as image:
            if image.format in LOSSY_FORMATS or (image.format == "WEBP" and _is_lossy_webp(path)):
                raise InputError(f"label map {path.name} is a {image.format}: its compression changes ids; save as PNG")
            mode = image.mode
            if mode in ("L", "I", "I;16", "I;16B", "I;16L", "1"):
                values = np.asarray(image).astype(np.int64)
            elif mode == "P":
                values = _from_palette(image, colors, ignore_id)
            elif mode in ("RGB", "RGBA", "LA"):
                values = _from_colors(np.asarray(image.convert("RGBA")), colors, ignore_id, path.name)
            else:
                raise InputError(f"label map {path.name} has the unusual mode {mode}; save as 8-bit PNG")
    except UNDECODABLE as error:
        raise InputError(f"label map {path.name} cannot be read: {error}") from error
    if values.min() < 0 or values.max() > 65535:
        raise InputError(f"label map {path.name} has ids outside 0…65535")
    return values.astype(np.uint16)


def _is_lossy_webp(path: Path) -> bool:
    """Whether pixels are stored as `VP8 ` and not as `VP8L` (RFC 9649); chunks before them are skipped."""
    with open(path, "rb") as file:
        file.seek(12)
        while len(head := file.read(8)) == 8:
            kind, size = struct.unpack("<4sI", head)
            if kind in (b"VP8 ", b"VP8L"):
                return kind == b"VP8 "
            file.seek(0 if kind == b"ANMF" else size + size % 2, 1)
            if kind == b"ANMF":
                file.seek(16, 1)  # a frame of an animation has chunks of its own behind its place and time
    return False


def _from_palette(image: Image.Image, colors: Colors | None, ignore_id: int) -> np.ndarray:
    indices, alpha = np.asarray(image).astype(np.int64), np.full(256, 255)
    clear = image.info.get("transparency", b"")  # an index, or the alpha of the first ones
    alpha[clear if isinstance(clear, int) else slice(len(clear))] = 0 if isinstance(clear, int) else list(clear)
    return np.where(alpha[indices] > 127, _palette_ids(image, indices, colors, ignore_id), ignore_id)


def _palette_ids(image: Image.Image, indices: np.ndarray, colors: Colors | None, ignore_id: int) -> np.ndarray:
    palette = np.array(image.getpalette("RGB"), np.uint8).reshape(-1, 3)
    if not colors:
        return indices
    used = np.unique(indices)
    own = {ignore_id: (0, 0, 0)} | colors
    if all(i < len(palette) and tuple(palette[i].tolist()) == own.get(i) for i in used.tolist()):
        return indices  # also where two classes have the same colour
    by_color = {(0, 0, 0): ignore_id} | {tuple(color): i for i, color in colors.items()}
    ids = [by_color.get(tuple(palette[i].tolist())) if i < len(palette) else None for i in used]
    if any(i is None for i in ids):
        return indices
    table = np.zeros(int(used.max()) + 1, np.int64)
    table[used] = ids
    return table[indices]


def _from_colors(rgba: np.ndarray, colors: Colors | None, ignore_id: int, name: str) -> np.ndarray:
    opaque = rgba[..., 3] > 127
    rgb = rgba[..., :3].astype(np.int64)
    if not colors:
        # Some tools save ids as grey RGB; anything coloured needs a class file to be understood.
        if (rgb.max(-1) == rgb.min(-1)).all():
            return np.where(opaque, rgb[..., 0], ignore_id)
        raise UnknownColors(f"label map {name} is coloured; give --classes with a colour for each class")
    packed = rgb @ [65536, 256, 1]
    values = np.full(packed.shape, -1, np.int64)
    owner: dict[int, int] = {}
    for class_id, (red, green, blue) in colors.items():
        color = red * 65536 + green * 256 + blue
        its = packed == color
        if owner.setdefault(color, class_id) != class_id and (its & opaque).any():
            raise UnknownColors(
                f"label map {name}: its colour #{color:06x} is that of the classes {owner[color]} and {class_id}"
            )
        values[its] = class_id
    values[~opaque | ((values < 0) & (packed == 0))] = ignore_id  # black means unlabelled unless a class has it
    unknown = values < 0
    if unknown.any():
        example = f"#{int(packed[unknown][0]):06x}"
        raise UnknownColors(
            f"label map {name}: {100 * unknown.mean():.1f} % of its pixels have colours of no class (e.g. {example})"
        )
    return values


def read_mask(path: Path) -> np.ndarray:
    """Foreground mask (H, W) bool: alpha where the file has one, else brightness above one half; of 65535 where a file goes
    beyond 255, of 1 where it does not go beyond that; that of the brightest channel where a mask is painted in a colour. Grey
    files whose alpha is full everywhere have no alpha.

    Raises:
        InputError: it is no image. One clause, fit as a reason.
    """
    try:
        with Image.open(path) as image:
            if image.mode in ("L", "F") or image.mode.startswith("I"):
                values = np.asarray(image)
                brightest = values.max(initial=0)
                return values > (0.5 if brightest <= 1 else 127 if brightest <= 255 else 32767)
            if image.mode not in ("RGBA", "LA"):
                return np.asarray(image.convert("RGB")).max(-1) > 127
            pixels = np.asarray(image.convert("RGBA"))
            # Many programs save black and white with an alpha channel that says nothing.
            drawn = pixels[..., 3].min() == 255 and bool((pixels[..., :3] == pixels[..., :1]).all())
            return pixels[..., 0 if drawn else 3] > 127
    except UNDECODABLE as error:
        raise InputError(f"mask {path.name} cannot be read: {error}") from error


def fit_to_photo(
    values: np.ndarray,
    orientation: int,
    full_size: tuple[int, int],
    size: tuple[int, int],
    name: str,
    as_stored: bool = True,
) -> np.ndarray:
    """Bring a map (H, W) to the photo's working copy, nearest neighbour.

    Maps of the stored picture's proportions are turned as the photo was. Where proportions do not tell (orientations 2
    to 4, and square photos), `as_stored` does.

    Args:
        orientation: EXIF orientation of the photo; 1 for maps that are upright for certain.
        full_size: upright width, height of the original photo.
        size: width, height of the working copy.
    Raises:
        InputError: its proportions are not those of the photo.
    """
    image = Image.fromarray(values.astype(np.uint8) * 255 if values.dtype == bool else values)
    drawn = _drawn_as_stored(image.size, orientation, full_size)
    if orientation > 1 and (as_stored if drawn is None else drawn):
        image = upright(image, orientation)
    if not _close(image.width / image.height, full_size[0] / full_size[1]):
        raise InputError(
            f"{name} is {image.width}×{image.height}, which is not the shape of the photo ({full_size[0]}×{full_size[1]})"
        )
    resized = image.resize(size, Image.Resampling.NEAREST) if image.size != size else image
    return np.asarray(resized)


def own_orientation(path: Path) -> int:
    """The EXIF orientation that a map's own file gives; 1 where there is none."""
    if path.suffix.lower() in PROBABILITY_SUFFIXES:
        return 1
    try:
        with Image.open(path) as image:
            return orientation_of(image)
    except UNDECODABLE:
        return 1  # it gets its own reason when it is read


def turned_by_itself(values: np.ndarray, path: Path) -> tuple[np.ndarray, bool]:
    """A map (H, W), turned by the orientation of its own file if that has one, and whether it has."""
    orientation = own_orientation(path)
    if orientation == 1:
        return values, False
    if path.suffix.lower() in TIFF_SUFFIXES:
        return values, True  # Pillow has done so
    return np.asarray(upright(Image.fromarray(values), orientation)), True


def drawn_as_stored(pairs: Iterable[tuple[Path, Path | None]]) -> tuple[bool, list[str]]:
    """Whether the maps of a capture were drawn on photos as stored, and for which photos that is a guess.

    Photos lying on their side tell by the proportions of their maps, for one tool treats all photos alike. Without
    any the answer is yes: what computes maps mostly reads the pixels as they are.

    Args:
        pairs: photos, and the map of each.
    """
    votes, doubtful = 0, []
    for photo, path in pairs:
        if path is None or photo.suffix.lower() not in TAGGED_SUFFIXES:
            continue
        orientation = own_orientation(photo)
        if orientation == 1 or own_orientation(path) != 1:
            continue
        try:
            (width, height), size = image_size(photo), image_size(path)
        except InputError:
            continue  # it gets its own reason when it is read
        drawn = _drawn_as_stored(size, orientation, (height, width) if orientation >= 5 else (width, height))
        if drawn is None:
            doubtful.append(photo.name)
        else:
            votes += 1 if drawn else -1
    return votes >= 0, [] if votes else doubtful


def _drawn_as_stored(size: tuple[int, int], orientation: int, full_size: tuple[int, int]) -> bool | None:
    """What the proportions of a map tell about the picture it was drawn on; None when they say nothing."""
    if orientation < 5:
        return None
    aspect, wanted = size[0] / size[1], full_size[0] / full_size[1]
    as_is, on_its_side = _close(aspect, wanted), _close(1 / aspect, wanted)
    return None if as_is and on_its_side else not as_is and on_its_side


def _close(a: float, b: float) -> bool:
    return abs(a / b - 1) < 0.02
