"""What an import refuses, and what it says about data sets that leave something open."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.data.dataset import Y_UP
from fieldwork.nerfcore.data.importer import import_dataset, read_dataset
from fieldwork.nerfcore.data.lens_check import lens_problem
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.errors import InputError
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.params import ImportParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project
from fieldwork.tests.nerfcore.support.writers import data_set
from PIL import Image


@pytest.mark.parametrize(
    "lens",
    [
        {"fl_x": float("nan")}, {"fl_x": 0}, {"fl_x": -300}, {"fl_y": float("inf"), "fl_x": 300}, {"k1": 1e6}, {"k1": -5},
        {"k1": float("nan")}, {"cx": float("nan")}, {"cx": 1e9}, {"fl_x": 1e-3}, {"fl_x": 1e9}, {"fl_x": "wide"},
        {"fl_x": None}, {"w": 0}, {"camera_model": "OPENCV_FISHEYE", "k1": 1e6},
    ],
    ids=str,
)  # fmt: skip
def test_impossible_lenses_are_refused_by_frame(tmp_path: Path, lens: dict[str, Any]) -> None:
    with pytest.raises(InputError) as caught:
        read_dataset(data_set(tmp_path / "d", **lens))
    assert "f1" in caught.value.message
    assert caught.value.hint


def test_a_flat_angle_is_refused(tmp_path: Path) -> None:
    folder = data_set(tmp_path / "d")
    value = json.loads((folder / "transforms.json").read_text())
    del value["fl_x"]
    (folder / "transforms.json").write_text(json.dumps({**value, "camera_angle_x": 0}))
    with pytest.raises(InputError, match="f0"):
        read_dataset(folder)


@pytest.mark.parametrize(
    "camera",
    [
        Camera(width=1600, height=1200, fx=800, fy=800, cx=800, cy=600),
        Camera(model="OPENCV", width=1600, height=1200, fx=700, fy=700, cx=800, cy=600, distortion=(-0.35, 0.15, 0, 0)),
        Camera(model="OPENCV", width=1600, height=1200, fx=900, fy=900, cx=780, cy=610, distortion=(0.2, -0.6, 0, 0, 0.5)),
        Camera(model="OPENCV_FISHEYE", width=1600, height=1200, fx=480, fy=480, cx=800, cy=600, distortion=(0.05, 0, 0, 0)),
        Camera(model="EQUIRECTANGULAR", width=2000, height=1000, fx=1000, fy=1000, cx=1000, cy=500),
        Camera(width=4000, height=3000, fx=120000, fy=120000, cx=2000, cy=1500),
        Camera(width=640, height=480, fx=200, fy=200, cx=-40, cy=240),
    ],
)  # fmt: skip
def test_lenses_that_exist_are_taken(camera: Camera) -> None:
    assert lens_problem(camera) is None


@pytest.mark.parametrize(
    ("head", "y_up", "silent"),
    [
        ({}, False, False),
        ({"camera_convention": "OpenGL, y up"}, True, True),
        ({"camera_convention": "OpenGL, z up, metres"}, False, True),
        ({"orientation_override": "none"}, False, True),
        ({"orientation_override": "up"}, True, False),
        ({"applied_transform": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]}, True, False),
        ({"aabb_scale": 16}, False, True),
        ({"up": [0, 1, 0]}, True, True),
        ({"up": [0, 0, 1]}, False, True),
    ],
    ids=str,
)
def test_which_way_is_up(tmp_path: Path, head: dict[str, Any], y_up: bool, silent: bool) -> None:
    dataset = read_dataset(data_set(tmp_path / "d", head))
    assert np.allclose(dataset.world_from_sfm, Y_UP if y_up else np.eye(4))
    told = [text for text in dataset.warnings if "up" in text]
    assert bool(told) != silent
    if told:
        assert "align --up" in told[0]


def ring(folder: Path, head: dict[str, Any]) -> Path:
    """Eight cameras around the y axis, looking inwards."""
    data_set(folder, head, count=8)
    value = json.loads((folder / "transforms.json").read_text())
    for i, frame in enumerate(value["frames"]):
        c, s = np.cos(i * np.pi / 4), np.sin(i * np.pi / 4)
        frame["transform_matrix"] = [[c, 0, s, 3 * s], [0, 1, 0, 0], [-s, 0, c, 3 * c], [0, 0, 0, 1]]
    (folder / "transforms.json").write_text(json.dumps(value))
    return folder


def test_cameras_say_which_way_is_up(tmp_path: Path) -> None:
    (warning,) = read_dataset(ring(tmp_path / "a", {})).warnings
    assert "align --up y`, which is up by how the cameras were held" in warning
    nerfstudio = read_dataset(ring(tmp_path / "b", {"applied_scale": 1.0}))
    assert nerfstudio.warnings == []
    assert np.allclose(nerfstudio.world_from_sfm, Y_UP)


def test_any_direction_may_be_up(tmp_path: Path) -> None:
    dataset = read_dataset(data_set(tmp_path / "d", {"up": [0, -3, 0]}))
    assert np.allclose(dataset.world_from_sfm[:3, :3] @ [0, -1, 0], [0, 0, 1])
    assert np.allclose(np.linalg.det(dataset.world_from_sfm[:3, :3]), 1)
    with pytest.raises(InputError, match="“up”"):
        read_dataset(data_set(tmp_path / "e", {"up": [0, float("nan"), 1]}))


def test_blender_scenes_have_z_up(tmp_path: Path) -> None:
    folder = data_set(tmp_path / "d")
    for split in ("train", "test"):
        (folder / f"transforms_{split}.json").write_text((folder / "transforms.json").read_text())
    (folder / "transforms.json").unlink()
    assert read_dataset(folder).warnings == []


def test_labels_and_masks_of_data_sets_are_judged_too(tmp_path: Path) -> None:
    folder = data_set(tmp_path / "d", {"aabb_scale": 1})
    for name, value in (("labels", 77), ("masks", 0)):
        (folder / name).mkdir()
        Image.new("L", (320, 200), value).save(folder / name / "f1.png")
    (folder / "classes.json").write_text('{"classes": {"1": "stone"}}')
    report = Reporter()
    import_dataset(ImportParams(dataset=folder, project=tmp_path / "p"), report)
    assert [c.name for c in load_project(tmp_path / "p").classes] == ["class 77"]
    assert any("77" in text and "f1.png" in text and "classes.json" in text for text in report.warnings)
    assert any("f1" in text and "black everywhere" in text for text in report.warnings)
    statuses = {record.name: record.status for record in load_project(tmp_path / "p").images}
    assert statuses == {"f0": "ok", "f1": "rejected", "f2": "ok"}
    assert [view.name for view in load_scene(tmp_path / "p").views] == ["f0", "f2"]


def test_a_set_whose_masks_leave_nothing_is_refused(tmp_path: Path) -> None:
    folder = data_set(tmp_path / "d", {"aabb_scale": 1})
    (folder / "masks").mkdir()
    for i in range(3):
        Image.new("L", (320, 200), 0).save(folder / "masks" / f"f{i}.png")
    with pytest.raises(InputError, match="leave nothing of any photo"):
        import_dataset(ImportParams(dataset=folder, project=tmp_path / "p"), Reporter())


def test_what_black_in_masks_means_can_be_said_of_a_data_set(tmp_path: Path) -> None:
    folder = data_set(tmp_path / "d", {"aabb_scale": 1})
    import_dataset(ImportParams(dataset=folder, project=tmp_path / "p", mask_mode="empty"), Reporter())
    assert load_project(tmp_path / "p").mask_mode == "empty"


@pytest.mark.parametrize(("white", "mode"), [((90, 40, 230, 160), "empty"), ((0, 60, 320, 200), "ignore")])
def test_masks_of_a_data_set_say_what_black_means(tmp_path: Path, white: tuple[int, int, int, int], mode: str) -> None:
    folder = data_set(tmp_path / "d", {"aabb_scale": 1})
    (folder / "masks").mkdir()
    for image in (folder / "images").iterdir():
        mask = Image.new("L", (320, 200), 0)
        mask.paste(255, white)
        mask.save(folder / "masks" / f"{image.stem}.png")
    import_dataset(ImportParams(dataset=folder, project=tmp_path / "p"), Reporter())
    assert load_project(tmp_path / "p").mask_mode == mode


def test_deeply_nested_json_is_no_data_set(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text("[" * 200_000)
    with pytest.raises(InputError, match="nested"):
        read_dataset(tmp_path)
