"""What black in masks means, where nobody said: masks that cut an object out of nearly all photos leave empty space."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from ..images.labels import read_mask
from ..progress import Reporter

MaskMode = Literal["ignore", "empty"]
# Not tuned. A mask that hides passers-by, the sky or a tripod is white along most of the border of its photo, or black
# along one side of it.
NEARLY_ALL = 0.9  # of the photos have such a mask
BORDER = 0.8  # of its border is black
SIDE = 0.5  # of each of three sides at least; objects stand on the fourth


def chosen_mask_mode(asked: MaskMode | None, masks: Sequence[Path], photos: int, report: Reporter) -> MaskMode:
    """What was asked for, else a guess, of which a note tells where it changes anything; see `guess_mask_mode`."""
    mode = asked or guess_mask_mode(masks, photos)
    if asked is None and mode == "empty":
        report.note(
            f"The masks cut an object out of nearly all {photos} photos: what is black in them is taken as empty space "
            "(--mask-mode empty). Where there is something that only shall not count, use --mask-mode ignore."
        )
    return mode


def guess_mask_mode(masks: Sequence[Path], photos: int) -> MaskMode:
    """ "empty" where masks cover the background of nearly all photos, else "ignore".

    Args:
        masks: masks fitted to photos, white what counts. photos: number of photos, with a mask or without.
    Raises:
        InputError: a mask cannot be read.
    """
    if photos == 0 or len(masks) < NEARLY_ALL * photos:
        return "ignore"
    cut_out = sum(cuts_out(read_mask(mask)) for mask in masks)
    return "empty" if cut_out >= NEARLY_ALL * photos else "ignore"


def cuts_out(mask: np.ndarray) -> bool:
    """Whether a mask (H, W) of what counts leaves the surroundings of an object out, on all sides but perhaps one."""
    black = ~np.asarray(mask, bool)
    sides = [side.mean() for side in (black[0], black[-1], black[:, 0], black[:, -1])]
    return bool(np.mean(sides) >= BORDER and sorted(sides)[1] >= SIDE and not black.all())
