"""The suite `measures`: its captures are what they are said to be, and what it counts."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.bench import measures
from fieldwork.nerfcore.bench.machine import taken
from fieldwork.nerfcore.bench.still_life import TABLE, photographed, still_life
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.errors import TrainingError
from fieldwork.nerfcore.mesh.triangles import areas
from fieldwork.nerfcore.params import BenchParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.verbs import run_verb
from PIL import Image


def test_true_sizes_are_those_of_the_formulas() -> None:
    truth, other = still_life(3), still_life(4)
    drum, dome = (truth.vertices[np.unique(truth.faces[truth.face_class == n])] for n in (3, 4))
    radius = np.ptp(drum[:, 0]) / 2
    height = np.ptp(drum[:, 2])
    assert truth.volumes[3] == pytest.approx(np.pi * radius**2 * height, rel=0.01)
    assert truth.area(3) == pytest.approx(np.pi * radius**2 + 2 * np.pi * radius * height, rel=0.01)
    round_ = np.ptp(dome[:, 2])
    assert truth.volumes[4] == pytest.approx(2 / 3 * np.pi * round_**3, rel=0.01)
    assert truth.area(4) == pytest.approx(2 * np.pi * round_**2, rel=0.01)
    assert truth.volumes != other.volumes
    top = (truth.face_class == 1) & (truth.vertices[truth.faces][..., 2] > -0.01).all(1)
    assert areas(truth.vertices, truth.faces[top]).sum() == pytest.approx(4 * TABLE**2)


def test_photos_show_what_their_label_maps_say(tmp_path: Path) -> None:
    folder = photographed(still_life(0), tmp_path / "p", 0, photos=3, width=80)
    scene = load_scene(folder, 0)
    assert [c.name for c in scene.classes] == ["table", "block", "drum", "dome"]
    for name in ("00", "01", "02"):
        with (
            Image.open(folder / "images" / f"{name}.png") as image,
            Image.open(folder / "labels" / f"{name}.png") as map_,
        ):
            rgba, label = np.array(image).astype(int), np.array(map_)
        assert set(np.unique(label)) == {0, 1, 2, 3, 4}
        assert ((rgba[..., 3] > 127) == (label > 0)).mean() > 0.97
        # The block is red, the drum blue.
        assert (rgba[label == 2, 0] > rgba[label == 2, 2]).mean() > 0.9
        assert (rgba[label == 3, 2] > rgba[label == 3, 0]).mean() > 0.9
    again = photographed(still_life(0), tmp_path / "again", 0, photos=3, width=80)
    assert (again / "poses" / "poses.json").read_text() == (folder / "poses" / "poses.json").read_text()
    assert (again / "images" / "01.png").read_bytes() == (folder / "images" / "01.png").read_bytes()


def size(value: float | None, low: float | None, high: float | None) -> dict[str, Any]:
    return {"name": "drum", "kind": "volume", "true": 2.0, "value": value, "low": low, "high": high}


def test_what_is_held_is_counted() -> None:
    trials = [{"sizes": [one]} for one in (size(2.2, 1.8, 2.6), size(1.8, 1.7, 1.9), size(None, None, None))]
    (row,) = measures.summarised(trials)
    assert row == {"size": "volume of the drum", "held": "1 of 3", "half": 12.5, "off": 0.0, "spread": 14.1}
    assert measures.summarised([{"sizes": [size(None, None, None)]}]) == [
        {"size": "volume of the drum", "held": "0 of 1"}
    ]


def test_a_suite_goes_on_and_says_what_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def trial(seed: int, *_: object) -> dict[str, Any]:
        asked.append(seed)
        if seed == 2:
            raise TrainingError("The views agree on nothing.", "Train longer.")
        return {"seed": seed, "sizes": [size(2.0, 1.5, 2.5)], "processor_seconds": 30.0}

    monkeypatch.setattr(measures, "one_trial", trial)
    page = tmp_path / "page.md"
    params = BenchParams(suite="measures", out=tmp_path / "out", seeds=[1, 2], page=page)
    result = run_verb("bench", params, Reporter())
    assert (result["runs"], result["failed"]) == (1, 1)
    assert "1 of 1" in page.read_text()
    assert json.loads(Path(result["files"][0]).read_text())["rows"] == result["rows"]
    run_verb("bench", params, Reporter())
    assert asked == [1, 2, 2]
    for other in ({"seconds": 3.0}, {"set": {"loss.huber_delta": "0.2"}}, {"steps": 100}):
        run_verb("bench", params.model_copy(update={"seeds": [1], **other}), Reporter())
    assert asked == [1, 2, 2, 1, 1, 1], "of other settings figures are others"
    monkeypatch.setattr(measures, "taken", lambda: taken().model_copy(update={"commit": "another"}))
    run_verb("bench", params.model_copy(update={"seeds": [1]}), Reporter())
    assert asked[6:] == [1], "and of other code"


def test_a_capture_is_trained_for_as_long_as_was_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Trained(Exception): ...

    def train(params: TrainParams, report: Reporter) -> None:
        raise Trained((params.steps, params.time_limit))

    monkeypatch.setattr(measures, "photographed", lambda *_: None)
    monkeypatch.setattr(measures, "train", train)
    for asked, told in (({}, (200, None)), ({"seconds": 9.0}, (None, 9.0)), ({"steps": 30}, (30, None))):
        with pytest.raises(Trained) as found:
            measures.one_trial(0, BenchParams(suite="measures", **asked), tmp_path / "p", Reporter())
        assert found.value.args == (told,)


@pytest.mark.slow
def test_one_capture_goes_all_the_way(tmp_path: Path) -> None:
    params = BenchParams(suite="measures", out=tmp_path, seeds=[0])
    result = run_verb("bench", params, Reporter())
    assert result["failed"] == 0
    assert {row["size"] for row in result["rows"]} == {
        f"{kind} of the {name}" for kind in ("area", "volume") for name in ("block", "drum", "dome")
    }
    for found in result["trials"][0]["sizes"]:
        assert found["value"] == pytest.approx(found["true"], rel=0.25)
        assert found["low"] < found["true"] < found["high"]
    assert not (tmp_path / "measures" / "projects" / "0").exists()
