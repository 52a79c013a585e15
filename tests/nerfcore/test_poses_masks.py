"""Masks in the pose stage: photos without one beside photos with one, masks that were edited."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.params import PosesParams
from fieldwork.nerfcore.poses.estimate import _forget_changed
from fieldwork.nerfcore.poses.inputs import STATE_FILE, WORK_FOLDER
from fieldwork.nerfcore.poses.spread import find_features
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project
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


def test_edited_masks_count(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos")
    (photos / "masks").mkdir()
    for i in range(3):
        half(photos / "masks" / f"p{i}.png")
    project = ingest(photos, tmp_path / "p")
    before = features(project)
    assert features(project) == before
    Image.new("L", (320, 200), 255).save(project / "masks" / "p1.png")
    after = features(project)
    assert after["p1.jpg"] > 1.5 * before["p1.jpg"]
    assert after["p0.jpg"] == before["p0.jpg"]


def test_the_state_of_an_earlier_version_keeps_features(tmp_path: Path) -> None:
    """It says which mask a photo had, not what was in it."""
    photos = folder_of(tmp_path / "photos")
    (photos / "masks").mkdir()
    half(photos / "masks" / "p1.png")
    project = ingest(photos, tmp_path / "p")
    records = load_project(project).images
    assert _forget_changed(project, records)
    state = project / WORK_FOLDER / STATE_FILE
    state.write_text(json.dumps({name: value[:6] for name, value in json.loads(state.read_text()).items()}))
    assert _forget_changed(project, records)
    assert len(json.loads(state.read_text())["p1"]) == 7
