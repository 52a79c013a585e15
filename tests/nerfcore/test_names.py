"""Names that become files and folders: refused where they would lead elsewhere or cannot exist on some platform."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from fieldwork.nerfcore.cli import main
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.engine import protocol as rpc
from fieldwork.nerfcore.files import name_problem
from fieldwork.nerfcore.images.names import LONGEST, frame_names, unique_names
from fieldwork.nerfcore.params import (
    Params,
    RenderParams,
    TrainParams,
)
from fieldwork.nerfcore.project.schema import ImageRecord
from fieldwork.nerfcore.project.store import load_points, load_poses, load_project, save_poses, save_project
from fieldwork.nerfcore.render.verb import chosen_cameras
from fieldwork.nerfcore.verbs import VERBS
from fieldwork.tests.nerfcore.support.ball import ball_project
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

WITH_RUN = [
    (verb.params, field)
    for verb in VERBS.values()
    for field in verb.params.model_fields
    if field in ("run", "other_run")
]
BAD = [
    "", ".", "..", ".new", "../../b/runs/main", "a/b", "a\\b", "/tmp/x", "C:", "a:b", "con", "NUL", "com1.x", "a.", "a ",
    " a", "x" * 65, "a\0b", "a\nb", "a?b", "\udce9",
]  # fmt: skip


@pytest.mark.parametrize(("params", "field"), WITH_RUN)
@pytest.mark.parametrize("name", BAD)
def test_names_of_runs_that_are_refused(params: type[Params], field: str, name: str) -> None:
    with pytest.raises(ValidationError) as caught:
        params.model_validate({"project": "p", field: name})
    (wrong,) = [detail for detail in caught.value.errors() if detail["loc"] == (field,)]
    assert wrong["type"] == "value_error"


@pytest.mark.parametrize("name", ["main", "a-1", "Läufe_2", "v1.2", "-x", "x" * 64, "console", "試行"])
def test_names_of_runs_that_are_taken(name: str) -> None:
    assert TrainParams(project=Path("p"), run=name).run == name


@given(st.text(max_size=80))
def test_a_name_that_is_taken_is_a_folder_right_here(name: str) -> None:
    if name_problem(name) is None:
        place = os.path.normpath(os.path.join("/runs", name))
        assert os.path.dirname(place) == "/runs"
        assert os.path.basename(place) == name
        assert not name.startswith(".")
        name.encode()


def test_the_command_line_says_what_a_name_may_be(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", str(tmp_path), "--run", "../../b/runs/main"]) == 2
    said = capfd.readouterr().err
    assert "“../../b/runs/main”" in said
    assert "letters, digits" in said
    assert "\\w" not in said


def test_the_engine_says_what_a_name_may_be() -> None:
    with pytest.raises(rpc.RpcError, match=r"mesh: “run”: “\.\.” is no name"):
        rpc.parse_params("mesh", {"project": "p", "run": ".."})


@pytest.mark.parametrize("field", ["name", "file", "label", "mask", "depth", "confidence"])
@pytest.mark.parametrize("value", ["../other/images/a", "/etc/a", "images/../../a", "..\\a"])
def test_a_project_file_names_only_files_of_its_own(field: str, value: str) -> None:
    with pytest.raises(ValidationError, match=r"outside the project|is no name"):
        ImageRecord.model_validate({"name": "a", field: value})


def test_paths_that_cannot_be_written_down_are_refused(tmp_path: Path) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    with pytest.raises(ValidationError, match="not UTF-8"):
        TrainParams(project=path)


def test_long_names_of_photos_are_cut_and_stay_apart(tmp_path: Path) -> None:
    names = unique_names([tmp_path / f"{'x' * 236}_{i}.jpg" for i in range(3)], tmp_path)
    assert len(set(names)) == 3
    assert all(len(name.encode()) <= LONGEST for name in names)
    wide = unique_names([tmp_path / f"{'ü' * 110}{i}.jpg" for i in range(3)], tmp_path)
    assert len(set(wide)) == 3
    assert all(len(name.encode()) <= LONGEST for name in wide)
    assert unique_names([tmp_path / "a.jpg"], tmp_path) == ["a"]


def test_names_of_photos_differ_by_more_than_capitals(tmp_path: Path) -> None:
    """They become files, which Windows and macOS do not tell apart by capitals."""
    assert unique_names([tmp_path / "left" / "A.jpg", tmp_path / "right" / "a.jpg"], tmp_path) == ["left_A", "right_a"]
    assert unique_names([tmp_path / "A.jpg", tmp_path / "a.jpg"], tmp_path) == ["A_jpg_0", "a_jpg_1"]
    assert frame_names(["left/A", "right/a"]) == ["left_A", "right_a"]


def test_names_of_photos_are_no_comments(tmp_path: Path) -> None:
    """COLMAP leaves out lines of a list of pairs that begin with "#"."""
    names = unique_names([tmp_path / name for name in ("#1 left.jpg", "#2.jpg", "_2.jpg", "a#3.jpg")], tmp_path)
    assert not any(name.startswith("#") for name in names)
    assert len({name.casefold() for name in names}) == 4


def test_json_of_a_wrong_name(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["train", str(tmp_path), "--run", "..", "--json"]) == 2
    error = json.loads(capfd.readouterr().out)["error"]
    assert error["code"] == "usage"
    assert "“..” is no name" in error["message"]


@pytest.mark.parametrize(
    ("places", "names"),
    [
        (["./train/r_0", "./train/r_1"], ["r_0", "r_1"]),
        (["images/f.001.png", "images/f.002.png"], ["f.001", "f.002"]),
        (["f.001", "f.002"], ["f.001", "f.002"]),
        (["left/0.jpg", "../right/0.jpg"], ["left_0", "right_0"]),
        (["a", "a"], ["a_0", "a_1"]),
    ],
)
def test_no_two_frames_of_a_cameras_file_share_a_name(places: list[str], names: list[str]) -> None:
    assert frame_names(places) == names


def test_renders_of_photos_with_dots_in_their_names_stay_apart(tmp_path: Path) -> None:
    project = ball_project(tmp_path / "p")
    data = load_project(project)
    poses = load_poses(project)
    for record, posed in zip(data.images, poses.images):
        record.name = posed.name = f"frame.{record.name}"
    save_project(project, data)
    save_poses(project, poses, load_points(project))
    cameras = chosen_cameras(RenderParams(project=project, out=tmp_path, all=True), load_scene(project))
    assert len({name for name, *_ in cameras}) == len(data.images)
