"""Photos as a surface reads them: posed, without what a mask or transparency takes away, in several sizes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
import torch

from ..data.photo import photo_of
from ..data.scene import View
from ..images.picture import resized, srgb_to_linear, with_alpha
from ..images.working import nearest, read_image, read_label
from .visibility import PosedCamera

LINEAR = srgb_to_linear(np.arange(256) / 255).astype(np.float32)  # light of a byte of sRGB

ROWS = 128  # of a photo that are sharpened at once: what stays in a processor's cache
PIXEL_BLUR = 0.5  # share of the blur of a pixel's own width that is taken back


@dataclass(frozen=True)
class Photo:
    """A posed photo.

    read: → (H, W, 4) uint8 sRGB of the camera's size; alpha 0 where nothing may be taken from it. labels: → class ids
    (H, W) int64 and how sure they are (H, W) uint8, 255 for certain; None without a label map.
    """

    view: PosedCamera
    read: Callable[[], np.ndarray]
    labels: Callable[[], tuple[np.ndarray, np.ndarray]] | None = None


def posed_photo(view: View, pose: np.ndarray) -> Photo:
    """A photo of a project at the resolution of its working copy; `pose`: camera-to-mesh (4, 4)."""
    size = view.camera.width, view.camera.height

    def mask() -> np.ndarray | None:
        return None if view.mask is None else nearest(read_image(view.mask)[..., 0], *size) > 127

    def read() -> np.ndarray:
        photo, inside = resized(photo_of(view), *size), mask()
        rgba = with_alpha(photo).pixels
        if photo.alpha != "none":
            rgba = rgba.copy()
            rgba[..., 3] = np.where(rgba[..., 3] > 127, 255, 0)
        if inside is not None:
            rgba[..., 3][~inside] = 0
        if (rgba[..., 3] == 0).any():
            # What borders on nothing is mixed with it.
            rgba[..., 3] = scipy.ndimage.minimum_filter(rgba[..., 3], 3, mode="nearest")
        return rgba

    def labels() -> tuple[np.ndarray, np.ndarray]:
        assert view.label is not None
        ids = nearest(read_label(view.label), *size)
        sure = np.full(ids.shape, 255, np.uint8)
        if view.confidence is not None:
            sure = nearest(read_image(view.confidence)[..., 0], *size).copy()
        inside = mask()
        if inside is not None:
            sure[~inside] = 0
        return ids, sure

    posed = PosedCamera(view.camera, np.asarray(pose, np.float64), mask if view.mask is not None else None)
    return Photo(posed, read, labels if view.label else None)


def halvings(picture: torch.Tensor, levels: int) -> list[torch.Tensor]:
    """A picture (C, H, W) and its means over squares of 2, 4, … pixels, `levels` in all."""
    result = [picture]
    for _ in range(levels - 1):
        if min(result[-1].shape[1:]) < 2:
            break
        result.append(torch.nn.functional.avg_pool2d(result[-1][None], 2, ceil_mode=True, count_include_pad=False)[0])
    return result


def sharpened(rgba: np.ndarray) -> torch.Tensor:
    """Colours (3, H, W) of a photo (H, W, 4) uint8 as stored, in [0, 1], with a part of the blur taken back that its pixels
    are: a pixel is the mean over its square, which blurs by a 24th of the Laplacian; `PIXEL_BLUR` of that is subtracted.
    What is masked has no part in it."""
    sharp = np.empty((*rgba.shape[:2], 3), np.float32)
    for top in range(0, len(rgba), ROWS):
        low = max(top - 1, 0)
        sharp[top : top + ROWS] = _sharpened(rgba[low : top + ROWS + 1])[top - low :][:ROWS]
    return torch.from_numpy(sharp).permute(2, 0, 1)


def _sharpened(rgba: np.ndarray) -> np.ndarray:
    """See `sharpened`; (H, W, 3)."""
    color, known = rgba[..., :3].astype(np.float32) / 255, rgba[..., 3] > 0
    sharp, masked = color.copy(), not known.all()
    for one, other in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        apart = (color[other] - color[one]) * np.float32(PIXEL_BLUR / 24)
        if masked:
            apart[~(known[one] & known[other])] = 0
        sharp[one] -= apart
        sharp[other] += apart
    return np.clip(sharp, 0, 1, out=sharp)


def sample(levels: list[torch.Tensor], pixels: np.ndarray, level: np.ndarray, mode: str = "bilinear") -> torch.Tensor:
    """Values (N, C) at pixel coordinates (N, 2) of the full size, each from the picture of its level (N,)."""
    out = torch.empty((len(pixels), levels[0].shape[0]))
    level = np.clip(level, 0, len(levels) - 1)
    where = torch.from_numpy(np.asarray(pixels, np.float32))
    for number in np.unique(level):
        rows = torch.from_numpy(np.flatnonzero(level == number))
        picture = levels[number]
        size = torch.tensor([picture.shape[2], picture.shape[1]])
        grid = where[rows] / (2.0**number) / size * 2 - 1
        kind = mode if number == 0 else "bilinear"
        found = torch.nn.functional.grid_sample(
            picture[None], grid[None, None], mode=kind, padding_mode="border", align_corners=False
        )
        out[rows] = found[0, :, 0].T
    return out
