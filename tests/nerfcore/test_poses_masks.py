"""Masks in the pose stage: photos without one beside photos with one."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.params import PosesParams
from fieldwork.nerfcore.poses.estimate import WORK_FOLDER
from fieldwork.nerfcore.poses.spread import find_features
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.captures import ingest
from fieldwork.tests.nerfcore.support.photos import folder_of, picture
from PIL import Image


def features(project: Path) -> dict[str, int]:
    """How many features each photo has, after finding them."""
    find_features(PosesParams(project=project, preset="fast"), Reporter())
    (database,) = (project / WORK_FOLDER).glob("*.db")
    with sqlite3.connect(f"file:{database}?mode=ro", uri=True) as connection:
        return dict(connection.execute("SELECT name, rows FROM images LEFT JOIN keypoints USING (image_id)").fetchall())


def half(path: Path) -> None:
    mask = np.zeros((200, 320), np.uint8)
    mask[:, 160:] = 255
    Image.fromarray(mask).save(path)


@pytest.mark.parametrize("how", ["mask", "alpha"])
def test_photos_without_a_mask_are_seen_whole(tmp_path: Path, how: str) -> None:
    photos = folder_of(tmp_path / "photos")
    if how == "mask":
        (photos / "masks").mkdir()
        half(photos / "masks" / "p1.png")
    else:
        (photos / "p1.jpg").unlink()
        cut = picture(1)
        cut.putalpha(Image.fromarray(np.repeat(np.array([[0, 255]], np.uint8), [160, 160], 1).repeat(200, 0)))
        cut.save(photos / "p1.png")
    found = features(ingest(photos, tmp_path / "p"))
    masked = found.pop("p1.jpg" if how == "mask" else "p1.png")
    assert len(found) == 2
    assert all(count is not None and count > 1.5 * masked > 0 for count in found.values())
