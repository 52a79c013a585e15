"""Runs that an earlier version trained are read, rendered and trained further."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.config import make_config
from fieldwork.nerfcore.errors import ProjectError
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.params import TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.render.image import render_view
from fieldwork.nerfcore.render.run import load_info, load_trained
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project, camera_poses
from safetensors import safe_open
from safetensors.torch import save_file

# What version 2 called them.
TENSORS = {
    "model.visible_share": "model.shown_share",
    "model.occupancy.importance": "model.occupancy.interest",
    "model.occupancy.skip_distance": "model.occupancy.reach",
    "model.occupancy.empty_distance": "model.occupancy.empty",
}


def train(project: Path, **changes: object) -> None:
    settings = {**SMALL, "sampling.importance": "boundary"}
    run_verb(
        "train",
        TrainParams.model_validate({"project": project, "preset": "draft", "set": settings, **changes}),
        Reporter(),
    )


def as_version_2(folder: Path) -> None:
    """Rewrite a run's files as version 2 wrote them."""
    path = folder / "config.json"
    info = json.loads(path.read_text(encoding="utf-8"))
    info["version"] = 2
    sampling = info["config"]["sampling"]
    sampling["interest"] = sampling.pop("importance")
    path.write_text(json.dumps(info), encoding="utf-8")
    with safe_open(folder / "field.safetensors", "pt") as file:
        metadata, tensors = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    assert set(TENSORS) <= set(tensors)
    old = {TENSORS.get(name, name): v for name, v in tensors.items() if name != "model.occupancy.unknown"}
    save_file(old, folder / "field.safetensors", metadata=metadata)


def picture(project: Path) -> list[np.ndarray]:
    camera = Camera(width=24, height=24, fx=33, fy=33, cx=12, cy=12)
    frame = render_view(load_trained(project, "main").model, camera, camera_poses(16)[3], 0.0)
    return [frame.color, frame.opacity, frame.depth]


def test_a_run_of_version_2_renders_and_trains_on_as_before(tmp_path: Path) -> None:
    project = ball_project(tmp_path / "ball", views=8, side=24)
    train(project, steps=40)
    before = picture(project)
    as_version_2(project / "runs" / "main")
    assert load_info(project, "main").config.sampling.importance == "boundary"
    for now, then in zip(picture(project), before):
        assert np.array_equal(now, then, equal_nan=True)
    train(project, steps=45, resume=True)
    assert load_trained(project, "main").state["steps"] == 45
    assert bool(torch.isfinite(torch.from_numpy(picture(project)[0])).all())


def test_a_run_of_version_2_without_settings_is_called_damaged(tmp_path: Path) -> None:
    (tmp_path / "runs" / "main").mkdir(parents=True)
    for text in ('{"version": 2}', '{"version": 2, "config": {"sampling": 3}}', "[]"):
        (tmp_path / "runs" / "main" / "config.json").write_text(text)
        with pytest.raises(ProjectError, match="damaged"):
            load_info(tmp_path, "main")


def test_settings_are_known_by_their_earlier_names() -> None:
    assert make_config("draft", {"sampling.interest": "boundary"}).sampling.importance == "boundary"


def test_a_run_beyond_the_limits_of_settings_is_read_as_it_was_trained(tmp_path: Path) -> None:
    project = ball_project(tmp_path / "p", views=4, side=24)
    train(project, steps=2)
    path = project / "runs" / "main" / "config.json"
    value = json.loads(path.read_text(encoding="utf-8"))
    value["config"]["train"]["grid_rate"], value["config"]["render"]["samples"] = 1e30, 10**9
    path.write_text(json.dumps(value), encoding="utf-8")
    config = load_trained(project, "main").info.config
    assert (config.train.grid_rate, config.render.samples) == (1e30, 10**9)
    value["config"]["train"]["grid_rate"] = "fast"
    path.write_text(json.dumps(value), encoding="utf-8")
    with pytest.raises(ProjectError, match="damaged"):
        load_info(project, "main")
