"""A small trained and baked ball for tests of what Blender shows of a field."""

from __future__ import annotations

from pathlib import Path

import pytest
from fieldwork.nerfcore.params import BakeParams, EvaluateParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.verbs import run_verb

from .ball import SMALL, ball_project
from .once import made_once


def shared_ball(factory: pytest.TempPathFactory) -> Path:
    """`live_ball` for tests that do not change it."""
    return made_once(factory, "live ball", lambda folder: live_ball(folder / "ball"))


def live_ball(folder: Path) -> Path:
    """Train, evaluate and bake the ball: radius 0.5 around the origin of the world, class “top” above z = 0 and “bottom”
    below."""
    project = ball_project(folder, views=24)
    run_verb("train", TrainParams(project=project, preset="draft", steps=300, set=SMALL), Reporter())
    run_verb("evaluate", EvaluateParams(project=project), Reporter())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fieldwork.nerfcore.bake.verb.FINEST", 16)
        patch.setattr("fieldwork.nerfcore.bake.verb.RAYS", 50_000)
        patch.setattr("fieldwork.nerfcore.bake.fit.ROUNDS", 2)
        run_verb("bake", BakeParams(project=project, memory=20), Reporter())
    return project
