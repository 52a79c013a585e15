"""`reconstruct` on a project that is there does again what changed and what follows from it, and nothing else."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.blender.package import package
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.export.verb import export
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.geometry.points import Points
from fieldwork.nerfcore.mesh.surface import Surface
from fieldwork.nerfcore.mesh.verb import mesh
from fieldwork.nerfcore.params import (
    AlignParams,
    ClassesParams,
    ExportParams,
    MeshParams,
    PackageParams,
    PosesParams,
    ReconstructParams,
    RegionParams,
    RenderParams,
    TrainParams,
)
from fieldwork.nerfcore.poses.align import align
from fieldwork.nerfcore.poses.estimate import posed, posing_inputs
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.edit import classes, region
from fieldwork.nerfcore.project.fingerprints import difference, digest, rounded
from fieldwork.nerfcore.project.runs import MESH_RECORD, checkpoint_id, run_folder
from fieldwork.nerfcore.project.schema import PosedImage, Poses
from fieldwork.nerfcore.project.store import edit_project, load_project, save_poses
from fieldwork.nerfcore.render import verb as render_verb
from fieldwork.nerfcore.render.run import Trained, load_info
from fieldwork.nerfcore.render.verb import render
from fieldwork.nerfcore.train.verb import train
from fieldwork.nerfcore.workflows import reconstruct as workflow
from fieldwork.nerfcore.workflows.reconstruct import reconstruct
from fieldwork.tests.nerfcore.support.ball import SMALL, camera_poses, draw
from PIL import Image

SIDE, VIEWS = 72, 10
CAMERA = Camera(width=SIDE, height=SIDE, fx=1.375 * SIDE, fy=1.375 * SIDE, cx=SIDE / 2, cy=SIDE / 2)
STAGES = ["new", "poses", "train", "evaluate", "mesh", "render"]
SETTINGS = {**SMALL, "train.steps": "8"}


def known_poses(params: PosesParams, report: Reporter) -> dict[str, Any]:
    """Instead of structure from motion: the poses the photos were drawn with."""
    folder = Path(params.project)
    true = camera_poses(VIEWS + 2)
    with edit_project(folder) as project:
        records = [record for record in project.images if record.status != "rejected"]
        images = [PosedImage(name=r.name, camera=0, camera_to_world=true[int(r.name[1:])].tolist()) for r in records]
        save_poses(folder, Poses(source="sfm", cameras=[CAMERA], images=images), Points.empty())
        result = {"registered": len(images), "total": len(images)}
        project.record("poses", params.model_dump(mode="json"), result, posing_inputs(folder, project, params))
    return result


def take_photos(folder: Path, count: int = VIEWS) -> None:
    (folder / "labels").mkdir(parents=True, exist_ok=True)
    for i, pose in enumerate(camera_poses(VIEWS + 2)[:count]):
        rgba, label, _ = draw(CAMERA, pose)
        Image.fromarray(rgba).save(folder / f"p{i:02d}.png")
        Image.fromarray(label).save(folder / "labels" / f"p{i:02d}.png")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with photos/ and the project p/ that was reconstructed from them."""
    place = tmp_path_factory.mktemp("reuse")
    take_photos(place / "photos")
    with pytest.MonkeyPatch.context() as patch:
        fake(patch)
        result = call(place)
    assert result["reused"] == []
    assert result["redone"] == {}
    return place


def fake(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("fieldwork.nerfcore.mesh.verb.build", triangle)
    patch.setitem(workflow.STAGES, "poses", workflow.Stage(known_poses, posed))
    # Small enough for a test; what is asked of each stage stays the same from call to call.
    small = {
        "mesh": {"resolution": 24},
        "render": {"orbit": 1, "size": (16, 16), "passes": ["rgb"]},
        "evaluate": {"speed": False},
    }
    for verb, values in small.items():
        patch.setitem(workflow.STAGES, verb, smaller(workflow.STAGES[verb], values))


def triangle(trained: Trained, *_: Any) -> SimpleNamespace:
    """Instead of a surface, for which a field would have to be trained for longer."""
    corners = np.eye(3, dtype=np.float32)
    face = np.array([[0, 1, 2]], np.int32)
    surface = Surface(
        corners, face, corners, np.full((3, 3), 128, np.uint8), np.ones(3, np.int32), np.ones(1, np.int32)
    )
    return SimpleNamespace(trained=trained, surface=surface, region=SimpleNamespace(voxel=0.1))


def smaller(stage: workflow.Stage, values: dict[str, Any]) -> workflow.Stage:
    def changed(function: Callable) -> Callable:
        return lambda params, *rest: function(params.model_copy(update=values), *rest)

    return workflow.Stage(changed(stage.run), changed(stage.earlier))


def call(place: Path, **values: Any) -> dict[str, Any]:
    values = {"photos": place / "photos", "out": place / "p", "preset": "draft", "set": SETTINGS, **values}
    return reconstruct(ReconstructParams.model_validate(values), values.pop("report", None) or Reporter())


@pytest.fixture
def place(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    fake(monkeypatch)
    copy = Path(shutil.copytree(made, tmp_path / "place"))
    # A copy keeps the times of the photos; what the project remembers of where they lay is another place.
    path = copy / "p" / "project.json"
    path.write_text(path.read_text().replace(str(made), str(copy)))
    return copy


def redone(result: dict[str, Any]) -> list[str]:
    """The stages that were done, of which `redone` says why where they had been done before."""
    done = [verb for verb in STAGES if verb not in result["reused"]]
    assert set(result["redone"]) <= set(done)
    return done


def test_the_same_command_twice(place: Path) -> None:
    field = checkpoint_id(place / "p", "main")
    before = load_project(place / "p")
    result = call(place)
    assert result["reused"] == STAGES
    assert result["redone"] == {}
    assert result["train"]["steps"] == 8
    assert result["evaluate"]["psnr"] > 0
    assert all(Path(path).is_file() for path in [*result["mesh"]["files"], *result["render"]["frames"]])
    assert checkpoint_id(place / "p", "main") == field
    assert load_project(place / "p") == before  # provenance says nothing that was not done


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
    assert redone(result) == ["train", "evaluate", "mesh", "render"]
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
    assert redone(result) == ["train", "evaluate", "mesh", "render"]
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
    assert redone(result) == ["train", "evaluate", "mesh", "render"]
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
    assert redone(call(place)) == ["train", "evaluate", "mesh", "render"]
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


def test_photos_added(place: Path) -> None:
    take_photos(place / "photos", VIEWS + 1)
    result = call(place)
    assert redone(result) == STAGES
    assert result["redone"]["new"].startswith("changed: photos")
    assert result["redone"]["poses"].startswith("changed: photos")
    assert len(load_info(place / "p", "main").images) == VIEWS + 1 - 2
    assert call(place)["reused"] == STAGES


def test_photos_removed(place: Path) -> None:
    (place / "photos" / "p05.png").unlink()
    result = call(place)
    assert redone(result) == STAGES
    assert "p05" not in load_info(place / "p", "main").images


def test_a_photo_replaced(place: Path) -> None:
    shutil.copyfile(place / "photos" / "p03.png", place / "photos" / "p05.png")
    assert redone(call(place)) == STAGES


def test_a_photo_touched(place: Path) -> None:
    """Its working copy is written again, and found to be the same."""
    os.utime(place / "photos" / "p05.png")
    assert redone(call(place)) == ["new"]


def test_a_label_of_training(place: Path) -> None:
    shutil.copyfile(place / "photos" / "labels" / "p03.png", place / "photos" / "labels" / "p05.png")
    result = call(place)
    assert redone(result) == ["new", "train", "evaluate", "mesh", "render"]
    assert result["redone"]["train"] == "changed: labels"


def test_a_label_held_out(place: Path) -> None:
    shutil.copyfile(place / "photos" / "labels" / "p03.png", place / "photos" / "labels" / "p08.png")
    assert redone(call(place)) == ["new", "evaluate"]


def test_a_label_changed_in_the_project(place: Path) -> None:
    shutil.copyfile(place / "p" / "labels" / "p03.png", place / "p" / "labels" / "p05.png")
    assert redone(call(place)) == ["train", "evaluate", "mesh", "render"]


def test_masks(place: Path) -> None:
    (place / "photos" / "masks").mkdir()
    Image.fromarray(np.full((SIDE, SIDE), 255, np.uint8)).save(place / "photos" / "masks" / "p05.png")
    result = call(place)
    assert redone(result) == STAGES
    assert result["redone"]["train"] == "changed: masks"


def test_names_and_colours_of_classes_are_not_trained(place: Path) -> None:
    known = classes(ClassesParams(project=place / "p"), Reporter())["classes"]
    known[0]["name"] = "Oben"
    classes(ClassesParams.model_validate({"project": place / "p", "classes": known}), Reporter())
    assert redone(call(place)) == ["evaluate", "mesh", "render"]
    known[0]["priority"] = 3.0
    classes(ClassesParams.model_validate({"project": place / "p", "classes": known}), Reporter())
    result = call(place)
    assert redone(result) == ["train", "evaluate", "mesh", "render"]
    assert result["redone"]["train"] == "changed: classes"


def test_the_region(place: Path) -> None:
    region(RegionParams(project=place / "p", bounds=[[-0.6] * 3, [0.6] * 3]), Reporter())
    result = call(place)
    assert result["redone"]["train"] == "changed: region"
    # In a world of another size it is the same region.
    align(AlignParams(project=place / "p", scale=("p00", "p01", 5.0)), Reporter())
    result = call(place)
    assert redone(result) == ["evaluate", "mesh", "render"]
    assert "alignment" in result["redone"]["mesh"]


def test_alignment_trains_nothing_anew(place: Path) -> None:
    field = checkpoint_id(place / "p", "main")
    align(AlignParams(project=place / "p", up="x"), Reporter())
    assert "train" not in redone(call(place))
    assert checkpoint_id(place / "p", "main") == field


def test_poses_of_other_settings_by_hand_are_kept(place: Path) -> None:
    known_poses(PosesParams(project=place / "p", preset="robust"), Reporter())
    assert call(place)["reused"] == STAGES


def test_an_output_that_is_gone_is_made_again(place: Path) -> None:
    (place / "p" / "exports" / "main" / "mesh.ply").unlink()
    assert call(place)["redone"] == {"mesh": "mesh.ply is gone"}


class Stopping(Reporter):
    def __init__(self) -> None:
        super().__init__()
        self.running = False

    def stage(self, name: str) -> None:
        self.running = name == "Training"

    def check(self) -> None:
        if self.running:
            self.cancel()
        super().check()


def test_a_stopped_training_goes_on(place: Path) -> None:
    settings = {**SETTINGS, "train.steps": "30"}
    field = checkpoint_id(place / "p", "main")
    values = {"photos": place / "photos", "out": place / "p", "preset": "draft", "set": settings}
    with pytest.raises(Cancelled):
        reconstruct(ReconstructParams.model_validate(values), Stopping())
    assert checkpoint_id(place / "p", "main") == field
    begun = json.loads((place / "p" / "runs" / ".new" / "main" / "config.json").read_text())["origin"]["training"]
    result = call(place, set=settings)
    assert load_info(place / "p", "main").origin.training == begun
    assert result["train"]["steps"] == 30
    assert call(place, set=settings)["reused"] == STAGES


def test_a_moved_project_is_as_it_was(place: Path) -> None:
    moved = (place / "p").rename(place / "elsewhere")
    result = call(place, out=moved)
    assert result["reused"] == STAGES
    paths = [result["train"]["checkpoint"], *result["mesh"]["files"], *result["render"]["frames"]]
    assert all(Path(path).is_relative_to(moved) and Path(path).is_file() for path in paths)


def test_a_project_of_before_keeps_its_poses(place: Path) -> None:
    """A version 1 project has no fingerprints: the poses stay while the photos do, the rest is done again and said."""
    path = place / "p" / "project.json"
    value = json.loads(path.read_text())
    value["version"] = 1
    del value["uuid"]
    for step in value["provenance"]:
        del step["inputs"], step["checkpoint"]
    path.write_text(json.dumps(value))
    from fieldwork.nerfcore.poses import estimate

    records = load_project(place / "p").images
    (place / "p" / "poses" / "sfm").mkdir()
    estimate._forget_changed(place / "p" / "poses" / "sfm", records)
    result = call(place)
    assert "poses" in result["reused"]
    assert "earlier version" in result["redone"]["new"]
    assert result["redone"]["train"] == "trained in another project" or "train" in result["reused"]
    assert call(place)["reused"] == STAGES


def test_meshes_of_an_earlier_training_are_not_delivered_silently(place: Path, tmp_path: Path) -> None:
    project = place / "p"
    report = Reporter()
    export(ExportParams(project=project, to="ply", out=tmp_path / "a.ply"), report)
    package(PackageParams(project=project), report)
    assert report.warnings == []
    render(RenderParams(project=project, out=project / "exports" / "renders" / "photos", all=True), Reporter())
    train(TrainParams(project=project, preset="draft", set=SETTINGS), Reporter())
    export(ExportParams(project=project, to="ply", out=tmp_path / "b.ply"), report)
    assert ["mesh is from an earlier training" in warning for warning in report.warnings] == [True]
    report = Reporter()
    package(PackageParams(project=project), report)
    assert len(report.warnings) == 2
    assert "renders of the photos are from an earlier training" in report.warnings[1]
    written = json.loads((project / "exports" / "main" / "package" / "package.json").read_text())
    assert written["checkpoint"] == checkpoint_id(project, "main") != written["mesh_checkpoint"]
    mesh(MeshParams(project=project, resolution=24), Reporter())
    report = Reporter()
    export(ExportParams(project=project, to="ply", out=tmp_path / "c.ply"), report)
    assert report.warnings == []
    # A mesh without a record beside a field that has an identity is of a version that wrote none.
    (project / "exports" / "main" / MESH_RECORD).unlink()
    export(ExportParams(project=project, to="ply", out=tmp_path / "d.ply"), report)
    assert len(report.warnings) == 1
    assert run_folder(project, "main").is_dir()


def test_digests() -> None:
    assert digest({"b": 1, "a": [Path("x")]}) == digest({"a": ["x"], "b": 1})
    assert digest([1, 23]) != digest([12, 3])
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    points = np.random.default_rng(1).normal(size=(8, 3))
    assert digest(rounded(points @ turn @ turn.T)) == digest(rounded(points))
    assert digest(rounded(points * 1.001)) != digest(rounded(points))
    assert difference({"a": "1", "b": "2"}, {"b": "3", "c": "4"}) == "changed: a, b, c"
