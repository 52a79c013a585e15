"""Marks on the surface in a real window. The screenshots stay in build/gui/labels_on_surface-<suite>/."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.params import LabelPrepareParams, MeshParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import edit_project
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.gui.test_live import REASON, nearest, played, window
from fieldwork.tests.nerfcore.support.ball import RADIUS, SMALL, ball_project

pytestmark = [
    pytest.mark.gui,
    pytest.mark.slow,
    pytest.mark.timeout(1200 * window.PATIENCE),
    pytest.mark.skipif(REASON is not None, reason=str(REASON)),
]


@pytest.fixture
def ball() -> Path:
    """The ball without label maps, trained, with a mesh and prepared for labelling."""
    folder = window.BUILD / "ball_labels"
    shutil.rmtree(folder, ignore_errors=True)
    ball_project(folder, views=16)
    with edit_project(folder) as project:
        for image in project.images:
            image.label = None
    run_verb("train", TrainParams(project=folder, preset="draft", steps=800, set=SMALL), Reporter())
    run_verb("mesh", MeshParams(project=folder, resolution=48), Reporter())
    run_verb("label prepare", LabelPrepareParams(project=folder, surfels=3000), Reporter())
    return folder


@pytest.mark.parametrize("suite", ["sid", "sid-vulkan", "trixie"])
def test_strokes_on_the_surface_become_marks(ball: Path, suite: str) -> None:
    facts, folder = played(ball, "labels_on_surface", suite, 600)
    *marks, first, second = facts["marks"]
    assert facts["after a click beside it"] == 2, "a click beside the surface marks nothing"
    assert [mark["class_id"] for mark in marks] == [1, 2]
    for piece, side in ((first, 1), (second, -1)):
        places = np.array(piece["places"])
        assert piece["class_id"] == 1
        np.testing.assert_allclose(np.linalg.norm(places, axis=1), RADIUS, atol=0.05)
        assert (places[:, 2] * side > 0).all()
    assert len(first["places"]) > len(second["places"]) > 5, "over the whole ball, and over half of it"
    for mark, height in zip(marks, (0.5, -0.5)):
        places = np.array(mark["places"])
        assert len(places) > 5
        np.testing.assert_allclose(np.linalg.norm(places, axis=1), RADIUS, atol=0.05)
        np.testing.assert_allclose(places[:, 2], height * RADIUS, atol=0.05)
        # The stroke is drawn in the color of its class, where the bumps of the mesh do not hide it.
        wanted = facts["colors"][str(mark["class_id"])]
        np.testing.assert_allclose(nearest(folder, "surface", facts["seen"][str(height)], wanted), wanted, atol=0.05)
