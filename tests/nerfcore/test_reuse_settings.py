"""`reconstruct` with other settings, another length of training or other held-out photos on a project that is there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.params import (
    ReconstructParams,
)
from fieldwork.nerfcore.project.runs import checkpoint_id
from fieldwork.nerfcore.project.store import load_project
from fieldwork.nerfcore.render import verb as render_verb
from fieldwork.nerfcore.render.run import Trained, load_info
from fieldwork.nerfcore.workflows.reconstruct import reconstruct
from fieldwork.tests.nerfcore.support.reconstructed import SETTINGS, STAGES, VIEWS, Stopping, call, redone


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"set": {**SETTINGS, "train.grid_rate": "0.02"}}, "changed: settings"),
        ({"set": {**SETTINGS, "train.steps": "9"}}, "changed: length of training"),
        ({"time_limit": 0.2}, "changed: length of training"),
        ({"preset": "standard"}, "changed: settings"),
        ({"holdout": 4}, "changed: training photos, photos, labels, masks, camera poses, sparse points"),
    ],
)
def test_what_training_depends_on(place: Path, values: dict[str, Any], reason: str) -> None:
    """Before, the old run was kept silently and the new settings went into the provenance."""
    before = checkpoint_id(place / "p", "main")
    result = call(place, **values)
    assert redone(result) == ["train", "mesh", "evaluate", "render"]
    assert reason.startswith(result["redone"]["train"])
    assert "trained field" in result["redone"]["mesh"]
    assert checkpoint_id(place / "p", "main") != before
    step = load_project(place / "p").last("train")
    assert step is not None
    assert step.settings["config"]["train"]["grid_rate"] == load_info(place / "p", "main").config.train.grid_rate
    assert call(place, **values)["reused"] == STAGES


@pytest.mark.parametrize("setting", ["render.accumulate=logits", "render.cull=0.001"])
def test_settings_of_rendering_that_training_reads(place: Path, setting: str) -> None:
    result = call(place, set={**SETTINGS, **dict([setting.split("=")])})
    assert redone(result) == ["train", "mesh", "evaluate", "render"]
    assert result["redone"]["train"] == "changed: settings"


def test_settings_that_only_pictures_depend_on(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before, they trained the field anew."""
    rendered_with = []
    load = render_verb.load_trained

    def loaded(project: Path, run: str) -> Trained:
        trained = load(project, run)
        rendered_with.append(trained.model.config.render)
        return trained

    monkeypatch.setattr(render_verb, "load_trained", loaded)
    field = checkpoint_id(place / "p", "main")
    asked = {"render.samples": "5", "render.per_bin": "0", "render.refine": "1", "render.fused": "off"}
    result = call(place, set={**SETTINGS, **asked})
    assert redone(result) == ["train", "mesh", "evaluate", "render"]
    assert result["redone"]["train"] == "changed: settings of rendering; the trained field is kept"
    assert checkpoint_id(place / "p", "main") == field
    assert result["train"]["steps"] == 8
    config = load_info(place / "p", "main").config
    made = [(c.samples, c.per_bin, c.refine, c.fused) for c in (config.render, *rendered_with)]
    assert made == [(5, 0.0, 1, "off")] * 2
    step = load_project(place / "p").last("train")
    assert step is not None
    assert step.settings["config"]["render"]["samples"] == 5
    assert call(place, set={**SETTINGS, **asked})["reused"] == STAGES
    assert redone(call(place)) == ["train", "mesh", "evaluate", "render"]
    assert checkpoint_id(place / "p", "main") == field


def test_a_stopped_training_goes_on_with_other_settings_of_rendering(place: Path) -> None:
    settings = {**SETTINGS, "train.steps": "30"}
    values = {"photos": place / "photos", "out": place / "p", "preset": "draft", "set": settings}
    with pytest.raises(Cancelled):
        reconstruct(ReconstructParams.model_validate(values), Stopping())
    begun = json.loads((place / "p" / "runs" / ".new" / "main" / "config.json").read_text())["origin"]["training"]
    call(place, set={**settings, "render.samples": "5"})
    info = load_info(place / "p", "main")
    assert (info.origin.training, info.config.render.samples) == (begun, 5)


def test_defaults_of_another_version_train_anew(place: Path) -> None:
    """A setting that is new with a default is none: what a run was trained with is in its config.json."""
    path = place / "p" / "runs" / "main" / "config.json"
    text = path.read_text()
    value = json.loads(text)
    del value["config"]["loss"]["huber_delta"]  # of a version that did not have it
    path.write_text(json.dumps(value))
    assert "train" in call(place)["reused"]
    value["config"]["loss"]["huber_delta"] = 0.3
    path.write_text(json.dumps(value))
    assert call(place)["redone"]["train"] == "changed: settings"


def test_settings_of_writing_change_nothing(place: Path) -> None:
    assert call(place, set={**SETTINGS, "train.preview_every": "99"})["reused"] == STAGES


def test_a_final_field_is_not_measured(place: Path) -> None:
    result = call(place, holdout=0)
    assert "evaluate" not in result
    assert len(load_info(place / "p", "main").images) == VIEWS
    assert call(place, holdout=0)["reused"] == [verb for verb in STAGES if verb != "evaluate"]
