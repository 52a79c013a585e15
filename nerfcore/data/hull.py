"""The visual hull of an object that was cut out of its photos, and masks without what lies outside of it.

Cloth in the light, a lamp or a reflection stands out from the dark as the object does (`capture/backdrop.py`), but in few
photos, or each time elsewhere. The object is what most masks show where they see it; of that the hull is made (Laurentini,
“The visual hull concept for silhouette-based image understanding”, 1994), and what a mask holds beside it is left open.
Measured: docs/experiments.md, “Masks that agree”.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy
from PIL import Image

from ..capture.backdrop import object_mask
from ..config import SceneConfig
from ..files import atomic_path
from ..geometry.cameras import project
from ..geometry.similarity import similarity_scale, transform_points
from ..images.working import MASK_UNKNOWN, nearest, read_image, read_picture
from ..progress import Reporter
from .box import choose_box
from .load import load_scene
from .scene import View

# Not tuned, but for the third.
CELLS = 96  # of the hull along the box
SIDE = 384  # longer side of the pictures in which masks are compared, in pixels
MOST = 0.8  # share of the photos that see a place, in whose masks it must be
FEWEST = 3  # photos that must see it
SLACK = 1  # pixels by which a mask may reach beyond the hull
LEAST = 0.5  # of a mask that must lie in the hull: else its pose is wrong, or the hull, and the mask stays


def trim_masks(folder: Path, report: Reporter) -> int:
    """Leave open (`MASK_UNKNOWN`) what those masks of a project with poses that Fieldwork made, and nobody changed, hold
    beside the object that most of them agree on; how many masks were changed.

    Raises:
        InputError: a photo or a mask cannot be read. DiskError: a mask cannot be written. What `report` raises to stop.
    """
    scene = load_scene(folder)
    report.stage("Comparing the masks")
    shown: list[Shown] = []
    for number, view in enumerate(scene.views):
        report.progress(number / len(scene.views) / 2, view.name)
        if view.mask is not None:
            shown.append(Shown.of(view, read_image(view.mask)[..., 0]))
    if len(shown) < FEWEST:
        return 0
    box = choose_box(scene, SceneConfig(), empty_around=True)
    side = (np.arange(CELLS) + 0.5) / CELLS * 2 - 1
    cells = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
    hull = hull_of(shown, transform_points(box.world_from_box, cells), report)
    changed = 0
    for number, one in enumerate(shown if len(hull) else []):
        report.progress((1 + number / len(shown)) / 2, one.view.name)
        changed += _trim(one, hull, similarity_scale(box.world_from_box) * 2 / CELLS)
    if changed:
        report.note(f"What {changed} masks show beside the object, and most others do not, was left open in them.")
    return changed


def _trim(one: Shown, hull: np.ndarray, size: float) -> bool:
    """Leave open what a mask shows beside the cells (N, 3) of the hull, of that size; whether it was changed."""
    assert one.view.mask is not None
    kept, made = read_image(one.view.mask)[..., 0], object_mask(read_picture(one.view.image).pixels[..., :3])
    if kept.shape != made.shape or not ((kept == made) | ((kept == MASK_UNKNOWN) & (made == 255))).all():
        return False  # somebody's own, or edited
    covered = nearest(one.covered(hull, size), made.shape[1], made.shape[0])
    beside = (made == 255) & ~covered
    if np.count_nonzero(beside) > (1 - LEAST) * np.count_nonzero(made == 255):
        return False
    trimmed = np.where(beside, MASK_UNKNOWN, made).astype(np.uint8)
    if np.array_equal(trimmed, kept):
        return False
    with atomic_path(one.view.mask) as path:
        Image.fromarray(trimmed).save(path, compress_level=2)
    return True


@dataclass(frozen=True)
class Shown:
    """A photo, and which pixels of a small picture (h, w) bool its mask says may show the object, with `SLACK`."""

    view: View
    small: np.ndarray

    @classmethod
    def of(cls, view: View, mask: np.ndarray) -> Shown:
        # As `pixels.training_size` has it, which comes with torch.
        scale = min(1.0, SIDE / max(view.camera.width, view.camera.height))
        width, height = (max(1, round(side * scale)) for side in (view.camera.width, view.camera.height))
        return cls(view, scipy.ndimage.maximum_filter(nearest(mask, width, height) > 0, 2 * SLACK + 1))

    def pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Column and row (N, 2) int of points (N, 3) of the world in the small picture, and which of them it shows (N,)."""
        camera = self.view.camera.resized(self.small.shape[1], self.small.shape[0])
        local = (points - self.view.camera_to_world[:3, 3]) @ self.view.camera_to_world[:3, :3]
        with np.errstate(all="ignore"):
            place = project(camera, local)
            seen = (local[:, 2] > 0) & ((place >= 0) & (place < [camera.width, camera.height])).all(1)
        return np.where(seen[:, None], place, 0).astype(int), seen

    def covered(self, hull: np.ndarray, size: float) -> np.ndarray:
        """Which pixels (h, w) bool of the small picture show cells (N, 3) of the hull, of that size, with `SLACK`."""
        pixel, seen = self.pixels(hull)
        picture = np.zeros(self.small.shape, bool)
        picture[pixel[seen, 1], pixel[seen, 0]] = True
        away = np.linalg.norm(hull - self.view.camera_to_world[:3, 3], axis=1)
        camera = self.view.camera.resized(self.small.shape[1], self.small.shape[0])
        cell = size * camera.pixels_per_radian / max(float(np.median(away)), 1e-9)
        reach = SLACK + int(np.ceil(min(cell, max(picture.shape))))
        return scipy.ndimage.maximum_filter(picture, 2 * reach + 1)


def hull_of(shown: list[Shown], cells: np.ndarray, report: Reporter) -> np.ndarray:
    """Those of the cells' centres (N, 3) that are in most masks of the photos that see them, (M, 3)."""
    inside, seeing = np.zeros(len(cells), np.int32), np.zeros(len(cells), np.int32)
    for one in shown:
        report.check()
        pixel, seen = one.pixels(cells)
        seeing += seen
        inside += seen & one.small[pixel[:, 1], pixel[:, 0]]
    return cells[(seeing >= FEWEST) & (inside > MOST * seeing)]
