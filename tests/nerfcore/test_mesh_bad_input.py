"""What `mesh` says where there is no surface to be had, of which nothing is written, or next to none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.errors import TrainingError
from fieldwork.nerfcore.geometry.cameras import pixel_centers, rays
from fieldwork.nerfcore.kernels.depth_arrays import FREE
from fieldwork.nerfcore.mesh import build, depth_maps
from fieldwork.nerfcore.params import MeshParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project, save_project
from fieldwork.nerfcore.render.run import load_trained
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import RADIUS, SMALL, ball_project
from fieldwork.tests.nerfcore.support.depth_views import sphere


@pytest.fixture(scope="module")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = ball_project(tmp_path_factory.mktemp("untrained") / "ball")
    settings = {**SMALL, "loss.rgb_warmup": "0"}  # two steps turn it transparent
    run_verb("train", TrainParams(project=folder, preset="draft", steps=2, set=settings), Reporter())
    return folder


def learned(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The project of a ball, with the depth maps of a field that has learned it."""
    box = load_trained(folder, "main").info.box(load_project(folder)).box_from_world
    scale = np.cbrt(np.linalg.det(box[:3, :3]))

    def perfect(model, flats, report) -> list[depth_maps.DepthMap]:
        made = []
        for flat in flats:
            c = flat.camera
            local, _ = rays(c, pixel_centers(c.width, c.height).reshape(-1, 2))
            far = sphere(RADIUS * scale)(flat.pose[:3, 3] - box[:3, 3], local @ flat.pose[:3, :3].T)
            solid = np.isfinite(far)
            z = np.where(solid, np.where(solid, far, 0) * local[:, 2], FREE).astype(np.float32)
            z = z.reshape(c.height, c.width)
            made.append(depth_maps.DepthMap(z, np.full_like(z, 1e-3), depth_maps.cosines(c, z)))
        return made

    monkeypatch.setattr(depth_maps, "depth_maps", perfect)
    return folder


def written(folder: Path) -> list[Path]:
    return [path for path in (folder / "exports").rglob("*") if path.is_file()]


def test_an_untrained_field_has_no_surface(untrained: Path) -> None:
    report = Reporter()
    with pytest.raises(TrainingError, match="surface") as caught:
        run_verb("mesh", MeshParams(project=untrained, resolution=32), report)
    assert "Train longer" in (caught.value.hint or "")
    assert "2 steps only" in report.warnings[0]
    assert written(untrained) == []


def test_the_scraps_of_an_untrained_field_are_called_a_failure(tmp_path: Path) -> None:
    folder = ball_project(tmp_path / "ball")
    still = {**SMALL, "train.network_rate": "1e-9", "train.grid_rate": "1e-9"}
    run_verb("train", TrainParams(project=folder, preset="draft", steps=2, set=still), Reporter())
    report = Reporter()
    result = run_verb("mesh", MeshParams(project=folder, resolution=32), report)
    assert result["verdict"]["level"] == "failed"
    assert "Train longer" in result["verdict"]["reasons"][0]
    assert "2 steps only" in report.warnings[0]
    assert "surface will have holes" in report.warnings[1]


def test_an_empty_field_has_no_surface(untrained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(model, flats, report) -> list[depth_maps.DepthMap]:
        shapes = [(flat.camera.height, flat.camera.width) for flat in flats]
        return [depth_maps.DepthMap(np.full(s, FREE, np.float32), *np.zeros((2, *s), np.float32)) for s in shapes]

    monkeypatch.setattr(depth_maps, "depth_maps", nothing)
    with pytest.raises(TrainingError, match="several views agree"):
        run_verb("mesh", MeshParams(project=untrained, resolution=32), Reporter())
    assert written(untrained) == []


def test_a_region_that_misses_everything_is_said_to(untrained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learned(untrained, monkeypatch)
    with pytest.raises(TrainingError, match="no surface in the region"):
        run_verb("mesh", MeshParams(project=untrained, resolution=32, region="50,50,50,51,51,51"), Reporter())
    assert written(untrained) == []


def test_one_photo_is_no_surface(untrained: Path) -> None:
    trained = load_trained(untrained, "main")
    scene = load_scene(untrained, trained.info.holdout)
    alone = replace(scene, train=scene.train[:1])
    with pytest.raises(TrainingError, match="at least two"):
        build.build(trained, load_project(untrained), alone, MeshParams(project=untrained), Reporter())


def test_what_nobody_labelled_is_void(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = ball_project(tmp_path / "plain")
    project = load_project(folder)
    plain = [image.model_copy(update={"label": None}) for image in project.images]
    save_project(folder, project.model_copy(update={"images": plain, "classes": []}))
    run_verb("train", TrainParams(project=folder, preset="draft", steps=2, set=SMALL), Reporter())
    result = run_verb("mesh", MeshParams(project=learned(folder, monkeypatch), resolution=32), Reporter())
    assert list(result["classes"]) == ["void"]
    with np.load(folder / "exports" / "main" / "mesh.npz") as mesh:
        assert (mesh["class_id"] == load_scene(folder, 8).ignore_id).all()
        assert np.median(np.abs(np.linalg.norm(mesh["vertices"], axis=1) - RADIUS)) < 0.02  # half a pixel
