"""The simulated annotator, what is scored, and the suite `labels` on a ball."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.bench.annotator import LONGEST, correction, first_strokes, largest_component, medial_stroke
from fieldwork.nerfcore.bench.label_trials import best_pair, calibration_error
from fieldwork.nerfcore.params import BenchParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from skimage.morphology import medial_axis


def two_bars() -> np.ndarray:
    """Labels: a long bar of class 1, a short one of class 1, a bar of class 2, and ten pixels of class 3."""
    ids = np.zeros((60, 80), np.uint8)
    ids[10:20, 5:75] = 1
    ids[30:40, 5:25] = 1
    ids[30:40, 40:70] = 2
    ids[50, 10:20] = 3
    return ids


@pytest.mark.parametrize("seed", range(5))
def test_strokes_lie_in_the_middle_of_the_largest_part_and_are_short(seed: int) -> None:
    ids = two_bars()
    strokes = first_strokes("a", ids, [1, 2, 3], seed)
    assert [s.class_id for s in strokes] == [1, 2]  # ten pixels are too few
    for stroke in strokes:
        x, y = np.floor(stroke.points).astype(int).T
        assert (ids[y, x] == stroke.class_id).all()
        skeleton = np.count_nonzero(medial_axis(largest_component(ids == stroke.class_id)))
        length = np.linalg.norm(np.diff(stroke.points, axis=0), axis=1).sum()
        assert length <= 2 * LONGEST * skeleton + 4
    assert (strokes[0].points[:, 1] < 20).all()
    again = first_strokes("a", ids, [1, 2, 3], seed)
    np.testing.assert_array_equal(strokes[0].points, again[0].points)
    assert not np.array_equal(strokes[0].points, first_strokes("a", ids, [1], seed + 10)[0].points)


def test_a_single_pixel_can_be_stroked() -> None:
    mask = np.zeros((5, 5), bool)
    mask[2, 3] = True
    points = medial_stroke(mask, np.random.default_rng(0))
    assert len(points) == 1
    assert np.abs(points[0] - [3.5, 2.5]).max() < 1


def test_the_largest_mistake_is_corrected_first() -> None:
    truth = two_bars()
    shown, other = truth.copy(), truth.copy()
    shown[30:40, 40:70] = 1
    other[30:40, 5:10] = 0
    stroke = correction({"a": (truth, other), "b": (truth, shown)}, [1, 2], 0)
    assert stroke is not None
    assert (stroke.photo, stroke.class_id) == ("b", 2)
    assert correction({"a": (truth, truth)}, [1, 2], 0) is None


def test_calibration_error_of_known_answers() -> None:
    sure = np.array([0.75] * 100 + [0.25] * 100)
    assert calibration_error(sure, np.arange(200) % 4 != 0) == pytest.approx((0 + 0.5) / 2, abs=0.01)
    right = np.concatenate([np.arange(100) % 4 != 0, np.arange(100) % 4 == 0])
    assert calibration_error(sure, right) == pytest.approx(0, abs=1e-6)


def test_the_first_photos_show_most_classes() -> None:
    ids = two_bars()
    truth = {"a": np.where(ids == 1, 1, 0), "b": np.where(ids == 1, 1, 0), "c": np.where(ids == 2, 2, 0)}
    assert sorted(best_pair(truth, ["a", "b", "c"], [1, 2])) in (["a", "c"], ["b", "c"])


def test_the_suite_measures_and_writes_its_page(tmp_path: Path) -> None:
    ball = ball_project(tmp_path / "ball", views=12)
    page = tmp_path / "page.md"
    params = BenchParams(
        suite="labels",
        out=tmp_path / "out",
        scenes=[str(ball)],
        seeds=[0],
        steps=120,
        preset="draft",
        set=SMALL,
        page=page,
    )
    result = run_verb("bench", params, Reporter())
    assert [row["strokes"] for row in result["rows"]] == [
        "on two photos, look alone",
        "on two photos",
        "5 corrections",
        "all label maps",
    ]
    by_strokes = {row["strokes"]: row["miou"] for row in result["rows"]}
    assert by_strokes["all label maps"] > 0.7
    assert by_strokes["all label maps"] >= by_strokes["5 corrections"] - 0.05
    assert all(0 <= miou <= 1 for miou in by_strokes.values())
    (trial,) = result["trials"]
    assert len(trial["seconds"]) == len(trial["steps"]) <= 6
    assert any("without strokes" in note for note in result["notes"])
    assert json.loads(Path(result["files"][0]).read_text())["rows"] == result["rows"]
    assert "## Labels from strokes" in page.read_text()
    assert "5 corrections" in page.read_text()
    bare = load_project(tmp_path / "out" / "labels" / "projects" / "ball")
    assert all(image.label is None for image in bare.images)
