"""What the report of an evaluation says of a capture, and what to photograph next."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.capture.select import TWIN
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.data.scene import Scene
from fieldwork.nerfcore.errors import SettingError
from fieldwork.nerfcore.evaluate.advice import advice
from fieldwork.nerfcore.params import EvaluateParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import ImageRecord
from fieldwork.nerfcore.project.store import edit_project
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """24 views all around, every 8th held out."""
    return load_scene(ball_project(tmp_path_factory.mktemp("advice") / "p", views=24, side=16))


def scores(scene: Scene, **changed: float) -> list[dict]:
    names = [scene.views[i].name for i in scene.test]
    return [{"name": name, "psnr": changed.get(f"psnr_{name}", 30.0), "unknown": 0.0} for name in names]


def test_a_good_capture_gets_no_advice(scene: Scene) -> None:
    assert advice(scene, scores(scene), {"top": 0.9}) == []


def test_a_bad_place_is_named_with_its_neighbours(scene: Scene) -> None:
    (text,) = advice(scene, scores(scene, psnr_08=22.0), {})
    assert text.startswith("What 08 shows is 8 dB worse than most")
    between = re.search(r"between (\d+) and (\d+) from", text)
    assert between is not None
    assert {abs(int(name) - 8) for name in between.groups()} <= {1, 2}


def test_what_no_photo_looked_at_is_told(scene: Scene) -> None:
    given = scores(scene)
    given[1]["unknown"] = 0.31
    (text,) = advice(scene, given, {})
    assert text.startswith(f"31% of what {given[1]['name']} looks through is in no training photo")


def test_a_gap_in_the_ring_is_told_and_one_side_alone_is_not(scene: Scene) -> None:
    def trained_on(kept: list[int]) -> Scene:
        return replace(scene, views=[scene.views[i] for i in kept], train=list(range(len(kept))), test=[])

    (text, few) = advice(trained_on([i for i in range(24) if i not in (5, 6, 7, 8)]), [], {}) + [""]
    assert "Between 04 and 09 nobody photographed for 75° around" in text
    assert few == ""
    assert not any("Between" in line for line in advice(trained_on(list(range(8))), [], {}))


def test_a_photo_that_is_held_out_leaves_no_gap(scene: Scene) -> None:
    """12 photos all around, 30° apart: without those held out there would be 60°."""
    sparse = replace(scene, views=scene.views[::2], train=[i for i in range(12) if i % 8], test=[0, 8])
    assert not any("nobody photographed" in line for line in advice(sparse, [], {}))


def test_few_or_rejected_photos_and_wrong_classes_are_told(scene: Scene) -> None:
    few = advice(replace(scene, train=scene.train[:10]), [], {"top": 0.2, "bottom": 0.9}, rejected=7)
    assert any(line.startswith("Only 10 photos were trained on") for line in few)
    assert any(line.startswith("7 photos were left out") for line in few)
    assert next(line for line in few if "class" in line).startswith("The class “top” is mostly wrong (IoU 0.20)")


def test_evaluate_writes_a_report_that_judges_the_capture(tmp_path: Path) -> None:
    project = ball_project(tmp_path / "p", views=16, side=24)
    run_verb("train", TrainParams(project=project, preset="draft", steps=40, set=SMALL), Reporter())
    page = tmp_path / "Bericht ü.html"
    with pytest.raises(SettingError, match=r"\.html or \.pdf"):
        run_verb("evaluate", EvaluateParams(project=project, report=tmp_path / "report.txt"), Reporter())
    result = run_verb("evaluate", EvaluateParams(project=project, report=page), Reporter())
    text = page.read_text("utf-8")
    assert "<h2>Is the capture good?</h2>" in text
    answer = {"good": "Yes.", "weak": "In part.", "failed": "No."}
    assert any(f"<td>{word}</td>" in text for word in answer.values())
    assert any(line.startswith("Only 14 photos") for line in result["advice"])
    assert "Only 14 photos were trained on" in text
    assert text.count("data:image/png;base64,") >= 2  # held-out photos beside their renders
    assert 0 <= result["per_image"][0]["unknown"] <= 1
    assert np.isfinite(result["psnr"])
    # Where time is short, photos are compared in another order than they are told.
    params = EvaluateParams(project=project, split="train", time_limit=1000)
    result = run_verb("evaluate", params, Reporter())
    names = [score["name"] for score in result["per_image"]]
    assert len(names) == 14
    assert names == sorted(names)
    assert [Path(picture).stem for picture in result["pictures"]] == [Path(name).stem for name in names]
    # Nobody has to take a photo again of which there is a second copy.
    with edit_project(project) as edited:
        edited.images += [ImageRecord(name=f"copy {i}", status="rejected", reason=TWIN) for i in range(9)]
    assert not any("were left out" in line for line in run_verb("evaluate", params, Reporter())["advice"])
    with edit_project(project) as edited:
        edited.images += [ImageRecord(name=f"x {i}", status="rejected", reason="blurred") for i in range(9)]
    assert any(line.startswith("9 photos were left") for line in run_verb("evaluate", params, Reporter())["advice"])
