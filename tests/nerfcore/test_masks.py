"""Black in a mask means "unknown" or "nothing is there", as the project says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.data.pixels import PixelStore
from fieldwork.nerfcore.errors import TrainingError
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project, save_project
from fieldwork.nerfcore.train.prepare import has_transparency
from fieldwork.tests.nerfcore.support.ball import ball_project
from fieldwork.tests.nerfcore.support.settings import trainer_of
from PIL import Image


def masked_project(folder: Path, mode: str, rows: int = 20) -> Path:
    """The ball without alpha, with the upper rows of every photo, of 40, masked out."""
    project = ball_project(folder, views=4)
    settings = load_project(project)
    settings.mask_mode = mode  # type: ignore[assignment]
    (project / "masks").mkdir()
    for record in settings.images:
        with Image.open(project / record.file) as image:
            opaque = image.convert("RGB")
        opaque.save(project / record.file)
        mask = np.full((40, 40), 255, np.uint8)
        mask[:rows] = 0
        Image.fromarray(mask).save(project / "masks" / f"{record.name}.png")
        record.mask = f"masks/{record.name}.png"
    save_project(project, settings)
    return project


def store_of(project: Path) -> PixelStore:
    return PixelStore(load_scene(project), [0, 1, 2, 3], [], np.eye(4), 400, torch.device("cpu"), Reporter())


def test_unknown_pixels_are_never_drawn(tmp_path: Path) -> None:
    project = masked_project(tmp_path / "p", "ignore")
    store = store_of(project)
    assert not has_transparency(load_scene(project))
    drawn = store.random_pixels(5000, torch.Generator().manual_seed(0))
    assert set((drawn % 1600 // 40).tolist()) == set(range(20, 40))
    assert store.batch(drawn).alpha.min() == 1


def test_masks_that_leave_nothing_are_told(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="masks leave nothing"):
        trainer_of(masked_project(tmp_path / "p", "ignore", rows=40))


def test_empty_pixels_are_drawn_and_transparent(tmp_path: Path) -> None:
    project = masked_project(tmp_path / "p", "empty")
    store = store_of(project)
    assert has_transparency(load_scene(project))
    drawn = store.random_pixels(5000, torch.Generator().manual_seed(0))
    rows = drawn % 1600 // 40
    assert set(rows.tolist()) == set(range(40))
    assert (store.batch(drawn).alpha == (rows >= 20)).all()
