"""The simulated annotator, what is scored, and the suite `labels` on a ball."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.bench import label_times
from fieldwork.nerfcore.bench import labels as suite
from fieldwork.nerfcore.bench.annotator import LONGEST, correction, first_strokes, largest_component, medial_stroke
from fieldwork.nerfcore.bench.label_bounds import HeldOut, boldest, class_overlaps, held_out, of_pixels, seen_before
from fieldwork.nerfcore.bench.label_studies import photos_needed, photos_that_show
from fieldwork.nerfcore.bench.label_trials import Subject, best_pair, calibration_error, labelled, scores
from fieldwork.nerfcore.bench.labels import row
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.params import BenchParams, LabelAcceptParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.runs import read_metrics
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


def test_photos_that_are_needed_are_counted_between_photos() -> None:
    curve = {"next": [0.2, 0.6, 0.8], "random": [0.2, 0.3, 0.4]}
    assert photos_needed([curve]) == pytest.approx(1.5 / 3)
    assert photos_needed([{"next": [0.2, 0.2], "random": [0.2, 0.3]}]) is None
    assert photos_needed([{"next": [0.5, 0.6], "random": [0.2, 0.3]}]) == pytest.approx(1 / 2)


def test_other_orders_are_counted_the_same() -> None:
    assert photos_needed([{"best": [0.2, 0.6], "random": [0.2, 0.4]}], "best") == pytest.approx(1.5 / 2)


class FourSurfels:
    """A prepared run of four surfels on a photo of two rows: the first two on the left, the others on the right; the photo
    "b" shows the left ones alone."""

    surfels = range(4)

    def map_of(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        shown = np.array([[0, 0, 2, 2], [1, 1, 3, -1]]) if name == "a" else np.array([[0, 1]])
        return shown, np.zeros(shown.shape, bool)


@pytest.fixture
def half_and_half() -> Subject:
    truth = {"a": np.array([[5, 5, 7, 7], [5, 5, 7, 7]]), "b": np.array([[5, 5]])}
    return Subject(FourSurfels(), truth, [5, 7], ["b"], ["b"], ["a"], 0)  # type: ignore[arg-type]


def test_overlaps_of_held_out_pixels_are_those_of_photos(half_and_half: Subject) -> None:
    shown = labelled(np.array([[0.9, 0.1], [0.2, 0.8], [0.1, 0.9], [0.1, 0.2]], np.float32), [5, 7])
    assert class_overlaps(half_and_half, shown) == pytest.approx({5: 2 / 4, 7: 2 / 6})
    assert np.mean(list(class_overlaps(half_and_half, shown).values())) == pytest.approx(
        scores(half_and_half, shown)["miou"], abs=1e-4
    )
    only_one = labelled(
        np.array([[0.9], [0.2], [0.9], [0.1]], np.float32), [7]
    )  # void, where no class is likely enough
    assert class_overlaps(half_and_half, only_one) == pytest.approx({5: 0, 7: 2 / 6})


def test_the_first_photos_show_half_of_the_other_one(half_and_half: Subject) -> None:
    assert seen_before(half_and_half, held_out(half_and_half)) == pytest.approx(4 / 8)


def test_the_best_threshold_makes_no_more_void_than_may_be(half_and_half: Subject) -> None:
    pixels = HeldOut(np.repeat(np.arange(4), 100), np.repeat([0, 0, 1, 1], 100))
    sure = labelled(np.array([[0.95, 0], [0.8, 0], [0, 0.9], [0.6, 0.1]], np.float32), [5, 7])
    # Only the last surfel is wrong: as void it costs nothing, and any other would.
    threshold = boldest(half_and_half, pixels, sure)
    void = of_pixels(pixels, 1 - sure.probability.sum(1), 1.0)
    assert (void > threshold).sum() == 100
    assert void[-1] > threshold


def test_each_further_photo_shows_classes_that_were_missing() -> None:
    sizes = {
        "a": np.array([900, 0, 0]),
        "b": np.array([500, 500, 0]),
        "c": np.array([0, 0, 300]),
        "d": np.array([9, 9, 9]),
    }
    assert photos_that_show(sizes)[:2] == ["b", "c"]


def test_rows_say_whether_what_is_asked_is_reached() -> None:
    found = row("a", [0.9, 0.8, None], 0.8)
    assert (found["asked"], found["worst"], found["mean"], found["reached"]) == ("≥ 0.8", 0.8, 0.85, "yes")
    assert row("a", [1.0, 3.0], most=2.0)["reached"] == "no"
    assert row("a", [0.5])["asked"] == "–"
    assert row("a", [None], 0.5)["reached"] is None


def test_a_field_of_other_settings_or_that_was_stopped_is_trained_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ball = ball_project(tmp_path / "ball", views=6)
    prepared = SimpleNamespace(inputs={}, surfels=[])
    monkeypatch.setattr(suite, "ensured", lambda *_: (prepared, False))
    monkeypatch.setattr(suite, "scene_figures", lambda *_: {"rows": [], "trials": [], "notes": []})
    params = BenchParams(suite="labels", out=tmp_path / "out", scenes=[str(ball)], preset="draft", set=SMALL)
    place = tmp_path / "out" / "labels" / "projects" / "ball" / "runs" / "main"

    def field(report: Reporter | None = None, **values: Any) -> tuple[int, int]:
        """Steps of the field after the suite, and when it was written."""
        run_verb("bench", params.model_copy(update=values), report or Reporter())
        return read_metrics(place)["train"]["steps"], (place / "field.safetensors").stat().st_mtime_ns

    class Stops(Reporter):
        def stage(self, name: str) -> None:
            super().stage(name)
            if name == "Training":
                self.cancel()

    with pytest.raises(Cancelled):
        field(Stops(), steps=6)
    assert (place / "field.safetensors").is_file()
    trained = field(steps=6)
    assert trained[0] == 6
    assert field(steps=6) == trained, "a field that is finished stays"
    assert field(steps=9)[0] == 9
    assert field(seconds=1.5)[0] != 800


@pytest.mark.slow
def test_the_suite_measures_and_writes_its_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(label_times, "LabelAcceptParams", partial(LabelAcceptParams, seconds=2))
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
    rows = {row["figure"]: row for row in result["rows"]}
    assert len(rows) == len(result["rows"]), "no figure is there twice"
    most = rows["mIoU, all label maps: the most that surfels can show"]["worst"]
    assert most > 0.7
    for words in ("two photos", "5 corrections", "two photos, head only", "two photos, + graph", "two photos, + parts"):
        assert 0 <= rows[f"mIoU, {words}"]["worst"] <= 1
    assert most >= rows["mIoU, 5 corrections"]["worst"] - 0.05
    (trial,) = result["trials"]
    assert len(trial["seconds"]) == len(trial["steps"]) <= 6
    assert 0 <= rows["void share of a class without strokes"]["worst"] <= 1
    assert 0 <= rows["void share of a class without strokes, best threshold"]["worst"] <= 1
    assert most + 0.05 >= rows["mIoU, two photos, every pixel of them marked"]["worst"] > 0.5
    assert 0.3 < rows["held-out pixels whose surface the two photos show"]["worst"] <= 1
    assert any("IoU by strokes" in note for note in result["notes"])
    assert any("best order [" in note for note in result["notes"])
    assert (
        rows["from a stroke to whole parts (s), 95 %"]["worst"]
        <= rows["from a stroke to all surfels (s), 95 %"]["worst"]
    )
    for words in ("undo (s), 95 %", "prepare (s)", "accept (s)"):
        assert rows[words]["worst"] > 0
        assert rows[words]["reached"] in ("yes", "no")
    # Of photos as small as these it is rounded to 0.
    assert rows["labels of another photo (s), 95 %"]["reached"] == "yes"
    assert rows["click, photo encoded, without the model (s), 95 %"]["worst"] < 5
    assert rows["accept: PSNR changed by (dB)"]["reached"] == "yes", "accepting changes no colour"
    assert rows["accept: mIoU lost against what was shown"]["worst"] < 0.3
    assert not (tmp_path / "out" / "labels" / "accepted" / "ball").exists()
    assert json.loads(Path(result["files"][0]).read_text())["rows"] == result["rows"]
    monkeypatch.setattr("fieldwork.nerfcore.bench.labels.scene_trials", None)  # nothing is measured twice
    assert run_verb("bench", params, Reporter())["rows"] == result["rows"]
    assert "## Labels from strokes" in page.read_text()
    assert "5 corrections" in page.read_text()
    bare = load_project(tmp_path / "out" / "labels" / "projects" / "ball")
    assert all(image.label is None for image in bare.images)
