"""Shots of the small ball, and what they share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.film.exposure import Exposure, expose
from fieldwork.nerfcore.film.fields import FieldStore
from fieldwork.nerfcore.film.shot import Shot
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.live import shared_ball

W, H = 96, 64
ABOVE = np.eye(4)
ABOVE[2, 3] = 2.0  # looks down at the ball
SIDE = np.array([[1, 0, 0, 0], [0, 0, -1, -2], [0, 1, 0, 0], [0, 0, 0, 1.0]])  # looks along y at it, z is up


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The trained and baked ball; no test changes it."""
    return shared_ball(tmp_path_factory)


@pytest.fixture(scope="module")
def store() -> FieldStore:
    return FieldStore()


def lens(pose: np.ndarray = SIDE, **more: Any) -> dict[str, Any]:
    plain = {"kind": "perspective", "width": W, "height": H, "scale": (120, 120), "center": (W / 2, H / 2)}
    return {**plain, "clip": (0.1, 100), "poses": [pose.tolist()], **more}


def take(ball: Path, store: FieldStore, passes: list[str], item: Any = (), **more: Any) -> dict[str, np.ndarray]:
    """Passes of a shot, first row on top."""
    return {name: pixels[::-1] for name, pixels in taken(ball, store, passes, item, **more).passes.items()}


def taken(ball: Path, store: FieldStore, passes: list[str], item: Any = (), **more: Any) -> Exposure:
    field = {"name": "Ball", "project": ball, "scene_from_capture": np.eye(4).tolist(), **dict(item)}
    shot = {"lens": lens(), "border": (0, 0, W, H), "fields": [field], "passes": passes, "file": "none", **more}
    return expose(Shot.model_validate(shot), store, Reporter())
