"""Scraps outside of most masks are taken off a surface."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from fieldwork.nerfcore.data.scene import View
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.mesh.cut_outs import left_out
from fieldwork.nerfcore.progress import Reporter
from PIL import Image

CAMERA = Camera(model="PINHOLE", width=60, height=40, fx=50, fy=50, cx=30, cy=20)
FACES = np.array([[0, 1, 2], [3, 4, 5], [6, 7, 8]])


def triangle(x: float) -> np.ndarray:
    return np.array([[x, 0, 2], [x + 0.02, 0, 2], [x, 0.02, 2]])


VERTICES = np.concatenate(
    [triangle(0), triangle(0.6), triangle(5)]
)  # on the object, a scrap beside it, out of the picture


def views_of(folder: Path, right: list[int], grey: int = 255) -> list[View]:
    """Eight photos from one place; masks are white in the middle and, in some of the photos, at the right as well."""
    made = []
    for number in range(8):
        mask = np.zeros((40, 60), np.uint8)
        mask[10:30, 20:40] = 255
        mask[:, 42:52] = grey if number in right else 0
        Image.fromarray(mask).save(folder / f"{number}.png")
        made.append(View(f"{number}", CAMERA, np.eye(4), folder / "none.png", mask=folder / f"{number}.png"))
    return made


def test_what_most_masks_leave_out_goes(tmp_path: Path) -> None:
    assert left_out(VERTICES, FACES, views_of(tmp_path, []), Reporter()).tolist() == [False, True, False]
    assert left_out(VERTICES, FACES, views_of(tmp_path, [0, 1, 2]), Reporter()).tolist() == [False, True, False]


def test_what_few_masks_leave_out_stays(tmp_path: Path) -> None:
    """Masks drawn by hand contradict each other, and of places that are merely dark nobody knows."""
    assert not left_out(VERTICES, FACES, views_of(tmp_path, [0, 1, 2, 3, 4, 5]), Reporter()).any()
    assert not left_out(VERTICES, FACES, views_of(tmp_path, list(range(8)), grey=64), Reporter()).any()


def test_one_mask_alone_takes_nothing_off(tmp_path: Path) -> None:
    assert not left_out(VERTICES, FACES, views_of(tmp_path, [])[:1], Reporter()).any()
    bare = [View("a", CAMERA, np.eye(4), tmp_path / "none.png")] * 5
    assert not left_out(VERTICES, FACES, bare, Reporter()).any()
