"""Masks of objects that photos show before dark surroundings, where the user gave none.

An object on black velvet, or in a dark room by the light of a flash: what is around it does not matter, hardly agrees
between photos, and the dark itself says nothing about depth. Cut out, it is empty space, which a field learns at once.
Dark sides of the object are the danger: a mask rather keeps some of the surroundings than loses some of the object, leaves
open what dark places are that the object encloses – an opening or a shadow –, and masks are made only where nearly all
photos leave no doubt.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy
import skimage
from PIL import Image

from ..files import atomic_path
from ..images.working import MASK_UNKNOWN, read_picture
from ..progress import Reporter
from ..project.schema import ImageRecord
from .mask_mode import NEARLY_ALL, cuts_out

SIDE = 384  # longer side of the pictures in which outlines are looked for, in pixels
AROUND = 15  # pixels of it that brightness on both sides of an outline is averaged over, and that parts may lie apart
DIMMEST = 0.7  # of Otsu's threshold, which parts dark sides of an object from it
EDGE = 0.25  # from the brightness outside of an outline to that inside: what is brighter belongs to the object
FAINT = 0.6  # of the first threshold: what is darker is never taken for the object's shaded side
SPECK = 0.02  # of the largest part's area, below which a part is left out
OPENING = 0.005  # of the object's area, from which a dark place within it may be an opening
DARK, CONTRAST = 80, 2.0  # of 255: the brightest of the surroundings, and by how much the object outshines them
RIM = 2  # pixels of the small picture around its outline that the whole picture decides about
HALF, BESIDE = 0.5, 4  # where an edge runs there: halfway between the brightness of so many pixels beyond the rim


def mask_objects(
    records: Sequence[ImageRecord], folder: Path, report: Reporter, before: Sequence[ImageRecord] = ()
) -> bool:
    """Write a mask for each of the photos (`record.mask`) if nearly all show an object before dark surroundings; whether
    they do. Unchanged photos keep the mask that was made before.

    Args:
        records: photos of a project in `folder`, without masks. before: photos that masks were made for before.
    Raises:
        InputError: a photo cannot be read. DiskError: a mask cannot be written. What `report` raises to stop.
    """
    if not all_before_dark([folder / record.file for record in records], report):
        return False
    report.stage("Cutting the object out")
    there = {(r.sha256, r.width, r.height, r.mask) for r in before if r.mask and (folder / r.mask).is_file()}
    made = 0
    for number, record in enumerate(records):
        report.progress(number / len(records), record.name)
        record.mask = f"masks/{record.name}.png"
        if (record.sha256, record.width, record.height, record.mask) in there:
            continue
        made += 1
        mask = object_mask(read_picture(folder / record.file).pixels)
        with atomic_path(folder / record.mask) as path:
            Image.fromarray(mask).save(path, compress_level=2)
    report.note(
        f"The photos show an object before dark surroundings: {made} masks were made"
        + (f", {len(records) - made} are there already" if made < len(records) else "")
        + ", and what is dark around it is taken as empty space. Give masks of your own with --masks, or keep the surroundings with --keep-backdrop."
    )
    return True


def all_before_dark(photos: Sequence[Path], report: Reporter) -> bool:
    """Whether nearly all photos show an object before dark surroundings; gives up as soon as too many do not.

    Raises:
        InputError: one cannot be read.
    """
    doubtful, most = 0, math.floor((1 - NEARLY_ALL) * len(photos))
    for photo in photos:
        report.check()
        picture = read_picture(photo)
        if picture.alpha != "none":  # says by itself what is empty
            return False
        doubtful += not before_dark(picture.pixels)
        if doubtful > most:
            return False
    return len(photos) > 0


def before_dark(picture: np.ndarray) -> bool:
    """Whether a photo (H, W, 3) uint8 shows something bright that dark surroundings enclose, on all sides but perhaps one."""
    bright = _small(picture)
    mask, _ = _outlined(bright)
    if not mask.any() or not cuts_out(mask):
        return False
    around, within = np.percentile(bright[~mask], 90), np.median(bright[mask])
    return bool(around <= DARK and within >= CONTRAST * around)


def object_mask(picture: np.ndarray) -> np.ndarray:
    """What stands out from dark surroundings in a photo (H, W, 3) uint8: (H, W) uint8, 255 where it does, `MASK_UNKNOWN`
    in large dark places within it, 0 around it."""
    shown = _small(picture)
    mask, threshold = _outlined(shown)
    openings = _openings(mask & (shown <= threshold), OPENING * np.count_nonzero(mask))
    solid, size = mask & ~openings, (picture.shape[1], picture.shape[0])
    core = scipy.ndimage.binary_erosion(solid, iterations=RIM, border_value=1)
    reach = scipy.ndimage.binary_dilation(solid, iterations=RIM)
    halfway = Image.fromarray(_halfway(shown, core, ~reach, threshold))
    bright = scipy.ndimage.gaussian_filter(picture.max(2).astype(np.float32), 1.0)
    lit = bright > np.asarray(halfway.resize(size, Image.Resampling.BILINEAR))
    made = np.where(_enlarged(core, size) | (_enlarged(reach, size) & lit), 255, 0).astype(np.uint8)
    around = scipy.ndimage.binary_dilation(openings, iterations=RIM) & mask
    made[_enlarged(around, size) & (made == 0)] = MASK_UNKNOWN
    return made


def _small(picture: np.ndarray) -> np.ndarray:
    """Brightness (h, w) float32 of a photo's brightest channel, at most `SIDE` pixels a side, smoothed."""
    image = Image.fromarray(picture.max(2))
    image.thumbnail((SIDE, SIDE))
    return scipy.ndimage.gaussian_filter(np.asarray(image, np.float32), 1.0)


def _outlined(bright: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What stands out of a small picture: a mask (h, w) bool, and the brightness (h, w) float32 from which each place does.

    First all that is brighter than most of Otsu's threshold; then the threshold follows the brightness on either side of
    the outline found, as the shaded side of an object is darker than its lit one.
    """
    lowest, highest = float(bright.min()), float(bright.max())
    otsu = DIMMEST * skimage.filters.threshold_otsu(bright) if highest > lowest else highest
    first = _parts(bright > otsu)
    within = scipy.ndimage.gaussian_filter(first.astype(np.float32), AROUND)
    inside = scipy.ndimage.gaussian_filter(bright * first, AROUND) / np.maximum(within, 1e-3)
    outside = scipy.ndimage.gaussian_filter(bright * ~first, AROUND) / np.maximum(1 - within, 1e-3)
    threshold = np.clip(outside + EDGE * (inside - outside), FAINT * otsu, otsu).astype(np.float32)
    beside = (within > 0.02) & (within < 0.98)
    return _parts(np.where(beside, bright > threshold, first)), threshold


def _halfway(bright: np.ndarray, inside: np.ndarray, outside: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Brightness (h, w) float32 halfway between that inside and outside (h, w) bool near each place; `otherwise` where
    one of them is not near."""
    levels = []
    for part in (inside, outside):
        share = scipy.ndimage.gaussian_filter(part.astype(np.float32), BESIDE)
        level = scipy.ndimage.gaussian_filter(bright * part, BESIDE) / np.maximum(share, 1e-3)
        levels.append(np.where(share > 0.01, level, np.nan))
    middle = levels[1] + HALF * (levels[0] - levels[1])
    return np.where(np.isnan(middle), otherwise, middle).astype(np.float32)


def _parts(bright: np.ndarray) -> np.ndarray:
    """The largest part of a mask (h, w) and those near it that are more than specks, without holes."""
    labels, count = scipy.ndimage.label(bright)
    if count == 0:
        return np.zeros(bright.shape, bool)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    apart = scipy.ndimage.distance_transform_edt(labels != sizes.argmax())
    near = np.isin(np.arange(count + 1), labels[apart <= AROUND])
    kept = near & (sizes >= SPECK * sizes.max())
    kept[0] = False
    return scipy.ndimage.binary_fill_holes(kept[labels])


def _openings(dark: np.ndarray, least: float) -> np.ndarray:
    """Connected places of a mask (h, w) of at least so many pixels."""
    labels, _ = scipy.ndimage.label(dark)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return (sizes >= max(least, 1))[labels]


def _enlarged(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A mask at the size (width, height) of the whole picture."""
    return np.asarray(Image.fromarray(mask.astype(np.uint8) * 255).resize(size, Image.Resampling.BILINEAR)) > 127
