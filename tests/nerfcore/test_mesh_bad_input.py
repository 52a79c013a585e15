"""What `mesh` says where there is no surface to be had, of which nothing is written, or next to none."""

from __future__ import annotations

import errno
import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.errors import DiskError, SettingError, TrainingError
from fieldwork.nerfcore.geometry.cameras import pixel_centers, rays
from fieldwork.nerfcore.kernels.depth_arrays import FREE
from fieldwork.nerfcore.mesh import build, depth_maps, photo_texture
from fieldwork.nerfcore.params import MeshParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import SemanticClass
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


@pytest.mark.parametrize(("share", "warned"), [(0.29, True), (0.31, False)])
def test_little_that_views_agree_on_is_told(share: float, warned: bool) -> None:
    report = Reporter()
    build.check_agreement(share, report)
    assert ["will have holes" in text for text in report.warnings] == [True] * warned


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


@pytest.mark.parametrize("preview", [False, True])
def test_an_empty_region_is_said_to_before_the_work(
    untrained: Path, monkeypatch: pytest.MonkeyPatch, preview: bool
) -> None:
    monkeypatch.setattr(depth_maps, "depth_maps", lambda *_: pytest.fail("depth maps were rendered"))
    with pytest.raises(SettingError, match="is empty"):
        run_verb("mesh", MeshParams(project=untrained, region="1,0,0,0,1,1", preview=preview), Reporter())


@pytest.mark.parametrize("option", ["out", "turntable"])
def test_a_preview_that_shall_write_files_is_refused(untrained: Path, option: str) -> None:
    params = MeshParams.model_validate({"project": untrained, "preview": True, option: untrained / "look.ply"})
    with pytest.raises(SettingError, match=r"look\.ply") as caught:
        run_verb("mesh", params, Reporter())
    assert f"--{option}" in (caught.value.hint or "")


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


def test_a_class_that_nobody_labelled_has_no_surface(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = ball_project(tmp_path / "ball")
    project = load_project(folder)
    unused = SemanticClass(id=9, name="moss", color=(0.2, 0.6, 0.2))
    save_project(folder, project.model_copy(update={"classes": [*project.classes, unused]}))
    run_verb("train", TrainParams(project=folder, preset="draft", steps=2, set=SMALL), Reporter())
    result = run_verb("mesh", MeshParams(project=learned(folder, monkeypatch), resolution=32, texture=64), Reporter())
    assert {"top", "bottom"} <= set(result["classes"]) <= {"top", "bottom", "void"}
    with np.load(folder / "exports" / "main" / "mesh.npz") as mesh:
        assert 9 not in mesh["face_class"]
        assert 9 not in mesh["class_id"]


@pytest.mark.slow
def test_more_triangles_than_there_are_is_all_there_are(untrained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learned(untrained, monkeypatch)
    whole = run_verb("mesh", MeshParams(project=untrained, resolution=32), Reporter())
    asked = run_verb("mesh", MeshParams(project=untrained, resolution=32, faces=50_000_000), Reporter())
    assert asked["faces"] == whole["faces"] > 1000


def test_no_memory_for_a_texture_is_said_before_any_work(untrained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Little:
        available = 1_000_000_000

    monkeypatch.setattr(photo_texture.psutil, "virtual_memory", lambda: Little)
    report, before = Reporter(), contents(untrained)
    with pytest.raises(SettingError, match="16384×16384 needs") as caught:
        run_verb("mesh", MeshParams(project=untrained, texture=16384), report)
    assert "8192 or less" in (caught.value.hint or "")
    assert not report.warnings  # the field was not even looked at
    assert contents(untrained) == before


@pytest.mark.parametrize("asked", [{"out": "file/a.glb"}, {"out": "folder.glb"}, {"turntable": "file/around"}])
def test_where_no_file_can_be_is_said_before_any_work(untrained: Path, tmp_path: Path, asked: dict[str, str]) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder.glb").mkdir()
    report, before = Reporter(), contents(tmp_path)
    params = MeshParams(project=untrained, **{name: tmp_path / place for name, place in asked.items()})
    with pytest.raises(DiskError, match="in its way"):
        run_verb("mesh", params, report)
    assert not report.warnings  # the field was not even looked at
    assert contents(tmp_path) == before


def contents(folder: Path) -> dict[Path, str]:
    files = [path for path in folder.rglob("*") if path.is_file() and "jobs" not in path.parts]
    return {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.mark.parametrize(
    "writer",
    [
        pytest.param("painted.write_picture", marks=pytest.mark.slow),
        pytest.param("outputs.np.savez", marks=pytest.mark.slow),
        "files._write",
    ],
)
def test_on_a_full_disk_the_earlier_mesh_stays(
    untrained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writer: str
) -> None:
    learned(untrained, monkeypatch)
    params = MeshParams(project=untrained, resolution=32, texture=64, out=tmp_path / "a.glb")
    run_verb("mesh", params, Reporter())
    before = contents(untrained), contents(tmp_path)

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(f"fieldwork.nerfcore.mesh.{writer}", full)
    with pytest.raises(DiskError, match="No space left"):
        run_verb("mesh", params.model_copy(update={"resolution": 30}), Reporter())
    assert (contents(untrained), contents(tmp_path)) == before
