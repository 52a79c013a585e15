"""`reconstruct` on a project that is there does again what changed and what follows from it, and nothing else."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.blender.package import package
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.export.verb import export
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
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.edit import classes, region
from fieldwork.nerfcore.project.fingerprints import difference, digest, rounded
from fieldwork.nerfcore.project.runs import MESH_RECORD, checkpoint_id, run_folder
from fieldwork.nerfcore.project.store import load_project
from fieldwork.nerfcore.render.run import load_info
from fieldwork.nerfcore.render.verb import render
from fieldwork.nerfcore.train.verb import train
from fieldwork.nerfcore.workflows.reconstruct import reconstruct
from fieldwork.tests.nerfcore.support.reconstructed import (
    SETTINGS,
    SIDE,
    STAGES,
    VIEWS,
    Stopping,
    call,
    known_poses,
    redone,
    take_photos,
)
from PIL import Image


def test_the_same_command_twice(place: Path) -> None:
    field = checkpoint_id(place / "p", "main")
    before = load_project(place / "p")
    result = call(place)
    assert result["reused"] == STAGES
    assert result["redone"] == {}
    assert result["train"]["steps"] == 8
    assert result["evaluate"]["psnr"] > 0
    assert result["evaluate"]["fps"] is None
    assert all(Path(path).is_file() for path in [*result["mesh"]["files"], *result["render"]["frames"]])
    assert checkpoint_id(place / "p", "main") == field
    assert load_project(place / "p") == before  # provenance says nothing that was not done


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
    assert redone(result) == ["new", "train", "mesh", "evaluate", "render"]
    assert result["redone"]["train"] == "changed: labels"


def test_a_label_held_out(place: Path) -> None:
    shutil.copyfile(place / "photos" / "labels" / "p03.png", place / "photos" / "labels" / "p08.png")
    assert redone(call(place)) == ["new", "evaluate"]


def test_a_label_changed_in_the_project(place: Path) -> None:
    shutil.copyfile(place / "p" / "labels" / "p03.png", place / "p" / "labels" / "p05.png")
    assert redone(call(place)) == ["train", "mesh", "evaluate", "render"]


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
    assert redone(call(place)) == ["mesh", "evaluate", "render"]
    known[0]["priority"] = 3.0
    classes(ClassesParams.model_validate({"project": place / "p", "classes": known}), Reporter())
    result = call(place)
    assert redone(result) == ["train", "mesh", "evaluate", "render"]
    assert result["redone"]["train"] == "changed: classes"


def test_the_region(place: Path) -> None:
    region(RegionParams(project=place / "p", bounds=[[-0.6] * 3, [0.6] * 3]), Reporter())
    result = call(place)
    assert result["redone"]["train"] == "changed: region"
    # In a world of another size it is the same region.
    align(AlignParams(project=place / "p", scale=("p00", "p01", 5.0)), Reporter())
    result = call(place)
    assert redone(result) == ["mesh", "evaluate", "render"]
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
    estimate._forget_changed(place / "p", records)
    result = call(place)
    assert "poses" in result["reused"]
    assert "earlier version" in result["redone"]["new"]
    assert result["redone"].get("train") == "trained in another project"
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
