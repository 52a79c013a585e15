"""The capture project on disk: what it accepts, what it refuses, and in which words."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.data.load import load_scene, split_views
from fieldwork.nerfcore.errors import ProjectError
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.geometry.points import Points
from fieldwork.nerfcore.project.schema import Frame, ImageRecord, PosedImage, Poses, Project, SemanticClass
from fieldwork.nerfcore.project.store import (
    load_points,
    load_poses,
    load_project,
    load_visibility,
    save_poses,
    save_project,
)

pytestmark = pytest.mark.usefixtures("each_file_system")


def sample(folder: Path, count: int = 3) -> Project:
    """A project of `count` cameras on the x axis, with two points, in a frame scaled by two."""
    frame = np.diag([2.0, 2.0, 2.0, 1.0])
    project = Project(
        images=[ImageRecord(name=f"{i:03d}", file=f"images/{i:03d}.jpg", width=8, height=6) for i in range(count)],
        classes=[SemanticClass(id=1, name="Stein", color=(1, 0, 0))],
        frame=Frame(world_from_sfm=frame.tolist(), bounds=[[-1, -1, -1], [1, 1, 1]]),
    )
    poses = []
    for i in range(count):
        pose = np.eye(4)
        pose[0, 3] = i
        poses.append(PosedImage(name=f"{i:03d}", camera=0, camera_to_world=pose.tolist()))
    save_project(folder, project)
    points = Points(np.array([[0.0, 0, 5], [1, 0, 5]]), np.zeros((2, 3), np.uint8), np.array([0.1, 0.2]))
    camera = Camera(width=8, height=6, fx=8, fy=8, cx=4, cy=3)
    visibility = (np.array([0, 0, 2]), np.array([0, 1, 1]))
    save_poses(folder, Poses(source="test", cameras=[camera], images=poses), points, visibility)
    return project


def test_round_trip(tmp_path: Path) -> None:
    folder = tmp_path / "Mein Projekt äöü"
    project = sample(folder)
    project.record("new", {"photos": "x"}, {"images": 3})
    save_project(folder, project)
    assert load_project(folder) == project
    assert load_poses(folder).cameras[0].fx == 8


def test_scene_is_in_the_world(tmp_path: Path) -> None:
    sample(tmp_path, 9)
    scene = load_scene(tmp_path)
    assert scene.frame == "world"
    assert np.allclose(scene.views[3].camera_to_world[:3, 3], [6, 0, 0])  # the frame doubles lengths
    assert np.allclose(scene.views[3].camera_to_world[:3, :3], np.eye(3))
    assert np.allclose(scene.points.xyz, [[0, 0, 10], [2, 0, 10]])
    assert np.allclose(scene.bounds, [[-1, -1, -1], [1, 1, 1]])
    assert scene.test == [0, 8]
    assert scene.train == [1, 2, 3, 4, 5, 6, 7]


def test_rejected_images_are_no_views(tmp_path: Path) -> None:
    project = sample(tmp_path)
    project.images[1].status = "rejected"
    save_project(tmp_path, project)
    assert [view.name for view in load_scene(tmp_path).views] == ["000", "002"]


def test_visibility(tmp_path: Path) -> None:
    sample(tmp_path)
    seen = load_visibility(tmp_path)
    assert {name: indices.tolist() for name, indices in seen.items()} == {"000": [0, 1], "001": [], "002": [1]}


def test_missing(tmp_path: Path) -> None:
    with pytest.raises(ProjectError, match="is not a capture project"):
        load_project(tmp_path / "nowhere")
    save_project(tmp_path, Project())
    with pytest.raises(ProjectError, match=r"fieldwork poses"):
        load_poses(tmp_path)
    assert len(load_points(tmp_path)) == 0
    assert load_visibility(tmp_path) == {}


@pytest.mark.parametrize("text", ["", '{"format": "fieldwork-pro', "[1, 2", "\x00\x01"])
def test_truncated(tmp_path: Path, text: str) -> None:
    (tmp_path / "project.json").write_text(text)
    with pytest.raises(ProjectError, match="is damaged"):
        load_project(tmp_path)


@pytest.mark.parametrize("value", [[], {}, {"format": "something-else"}, 3, {"images": []}])
def test_foreign(tmp_path: Path, value: object) -> None:
    (tmp_path / "project.json").write_text(json.dumps(value))
    with pytest.raises(ProjectError, match="was not written by Fieldwork"):
        load_project(tmp_path)


def test_newer(tmp_path: Path) -> None:
    value = Project().model_dump(mode="json") | {"version": 99, "something": "new"}
    (tmp_path / "project.json").write_text(json.dumps(value))
    with pytest.raises(ProjectError, match=r"version 99.*Update Fieldwork"):
        load_project(tmp_path)


def test_wrong_value_is_named(tmp_path: Path) -> None:
    value = Project(images=[ImageRecord(name="a")]).model_dump(mode="json")
    value["images"][0]["width"] = "wide"
    (tmp_path / "project.json").write_text(json.dumps(value))
    with pytest.raises(ProjectError, match=r"images\.0\.width"):
        load_project(tmp_path)


def test_damaged_points(tmp_path: Path) -> None:
    sample(tmp_path)
    (tmp_path / "poses" / "points.npz").write_bytes(b"PK\x03\x04 nothing more")
    with pytest.raises(ProjectError, match="fieldwork poses"):
        load_scene(tmp_path)


def test_splits() -> None:
    assert split_views(["auto"] * 7) == (list(range(7)), [])
    assert split_views(["auto"] * 17)[1] == [0, 8, 16]
    assert split_views(["train", "test", "auto", "test"]) == ([0, 2], [1, 3])
    assert split_views(["train", "test", "auto", "test"], holdout=0) == ([0, 1, 2, 3], [])
