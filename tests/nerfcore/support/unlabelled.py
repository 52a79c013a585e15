"""A trained field that nobody labelled."""

from __future__ import annotations

from pathlib import Path

import pytest
from fieldwork.nerfcore.labels.preparation import prepare
from fieldwork.nerfcore.params import LabelPrepareParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import edit_project
from fieldwork.nerfcore.train.verb import train
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from fieldwork.tests.nerfcore.support.once import made_once

SIDE = 40


@pytest.fixture(scope="session")
def unlabelled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ball without label maps, trained and prepared for labelling; tests copy it."""
    return made_once(tmp_path_factory, "unlabelled", lambda folder: _without_labels(folder / "p"))


def _without_labels(place: Path) -> Path:
    folder = ball_project(place, views=12, side=SIDE)
    with edit_project(folder) as project:
        for image in project.images:
            image.label = None
    train(TrainParams(project=folder, preset="draft", steps=250, set=SMALL), Reporter())
    prepare(LabelPrepareParams(project=folder, surfels=3000), Reporter())
    return folder
