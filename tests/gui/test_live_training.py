"""A field in training, hidden overlays, and endurance, in a real window. The screenshots stay in build/gui/<scenario>/."""

from __future__ import annotations

import shutil
import statistics
from pathlib import Path

import numpy as np
import pytest
from fieldwork.tests.gui import test_live as support
from fieldwork.tests.nerfcore.support.ball import pattern
from PIL import Image

HERE = Path(__file__).parent


colour, played, window, project = support.colour, support.played, support.window, support.project
pytestmark = support.pytestmark


@pytest.mark.parametrize("suite", ["sid", "trixie"])
def test_a_field_in_training_is_seen_converging_among_objects(project, suite):
    copy = window.BUILD / f"ball-{suite}"  # where the window sees it
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(project, copy)
    facts, folder = played(copy, "field_in_training", suite, 900)
    places, points = facts["places"], facts["points"]
    truth = {name: pattern(np.array(points[name]) / np.linalg.norm(points[name]) * 0.5) for name in ("field", "low")}
    assert facts["later size"][0] > facts["first size"][0], "pictures become finer"
    grey = colour(folder, "solid", places["front"])
    assert np.ptp(grey) < 0.05
    for shot in ("solid", "material", "cycles"):
        for name in ("field", "low"):
            found = colour(folder, shot, places[name])
            assert found == pytest.approx(truth[name], abs=0.2), f"{shot}: {name} is not as photographed"
        assert np.ptp(colour(folder, shot, places["front"])) < 0.06, f"{shot}: the field shows through the cube"
        assert np.ptp(colour(folder, shot, places["back"])) < 0.06, f"{shot}: what is behind is not beside the field"
    assert colour(folder, "labels", places["top"]) == pytest.approx([0.8, 0.2, 0.2], abs=0.12)
    assert colour(folder, "labels", places["low"]) == pytest.approx([0.2, 0.3, 0.8], abs=0.12)
    assert np.abs(colour(folder, "hidden", places["low"]) - truth["low"]).max() < 0.25
    x, y = places["top"]
    above = [x + 10, y - 30]
    assert np.abs(colour(folder, "hidden", above) - colour(folder, "solid", above)).max() > 0.1, (
        "the upper class is hidden"
    )
    assert facts["events"] > 20, "the training goes on meanwhile"
    assert facts["viewport error"] == ""
    assert facts["left"] == [0, False]
    print(suite, {name: facts[name] for name in ("first size", "later size", "waits", "python", "pictures")})
    print("median wait", statistics.median(facts["waits"]))


def test_hidden_overlays_are_told_where_fields_need_them(project):
    facts, folder = played(project, "overlays")
    x, y, width, height = facts["header"]
    shots = {}
    for shot in ("shown", "overlays-off"):
        pixels = np.asarray(Image.open(folder / f"{shot}.png").convert("RGB"), np.float64) / 255
        shots[shot] = pixels[y : y + height, x : x + width]
    red = {name: ((p[..., 0] > 0.4) & (p[..., 1:].max(-1) < 0.6 * p[..., 0])).sum() for name, p in shots.items()}
    assert red["overlays-off"] > red["shown"] + 500, "a red button in the header"
    field = facts["places"]["field"]
    assert np.ptp(colour(folder, "shown", field)) > 0.1
    assert np.ptp(colour(folder, "overlays-off", field)) < 0.06, "nothing is drawn before what hides it"


def test_two_hundred_sizes_and_fifty_undos_leave_nothing(project):
    facts, folder = played(project, "endurance", timeout=600, size=(960, 640))  # small: software OpenGL draws it
    points, places = facts["points"], facts["places"]
    truth = pattern(np.array(points["field"]) / np.linalg.norm(points["field"]) * 0.5)
    assert colour(folder, "after", places["field"]) == pytest.approx(truth, abs=0.15)
    assert facts["viewport error"] == ""
    assert facts["kept"][1] == 1
    assert facts["kept"][0] <= 2
    assert facts["changes"] >= 200, "the view had another size each time"
    assert facts["moved"] == pytest.approx(0, abs=1e-6), "all is undone"
    begin, resized, end = facts["memory"]
    print("MB before, after the sizes, after the undos:", begin, resized, end)
    # A picture of the view takes 5 MB, coarse and fine: two hundred that are kept would be a gigabyte.
    assert resized - begin < 120
    assert end - begin < 160
