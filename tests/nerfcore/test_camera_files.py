"""Files of cameras as other programs write them, to render from and of data sets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.data.importer import read_dataset
from fieldwork.nerfcore.errors import InputError
from fieldwork.nerfcore.geometry.cameras import Camera, flip_camera_axes
from fieldwork.nerfcore.render.verb import look_at, read_cameras
from fieldwork.tests.nerfcore.support.writers import data_set
from PIL import Image

POSE = look_at(np.array([1.0, -2.0, 0.5]), np.zeros(3))
FRAME = {"file_path": "a", "transform_matrix": flip_camera_axes(POSE).tolist()}
LENS = {"w": 40, "h": 30, "fl_x": 35.0, "fl_y": 36.0, "cx": 21.0, "cy": 14.0}


def written(folder: Path, **changes: Any) -> Path:
    path = folder / "cameras.json"
    path.write_text(json.dumps({**LENS, "frames": [FRAME], **changes}))
    return path


@pytest.mark.parametrize(
    ("keys", "model", "distortion"),
    [
        ({}, "PINHOLE", ()),
        ({"camera_model": "OPENCV", "k1": 0.2, "k2": -0.1, "p1": 0.01}, "OPENCV", (0.2, -0.1, 0.01, 0.0)),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1}, "OPENCV_FISHEYE", (0.1, 0.0, 0.0, 0.0)),
    ],
)
def test_lenses_are_those_that_photos_may_have(tmp_path: Path, keys: dict, model: str, distortion: tuple) -> None:
    ((name, camera, pose),) = read_cameras(written(tmp_path, **keys))
    plain = {"width": 40, "height": 30, "fx": 35.0, "fy": 36.0, "cx": 21.0, "cy": 14.0}
    assert name == "a"
    assert camera == Camera(model=model, distortion=distortion, **plain)
    assert pose == pytest.approx(POSE)


def test_a_panorama_needs_no_focal_length(tmp_path: Path) -> None:
    ((_, camera, _),) = read_cameras(written(tmp_path, camera_model="EQUIRECTANGULAR", fl_x=None, fl_y=None))
    assert (camera.model, camera.width, camera.height) == ("EQUIRECTANGULAR", 40, 30)


def test_poses_may_be_three_rows_and_scaled(tmp_path: Path) -> None:
    """Directions through pixels must have unit length, or depths are wrong."""
    scaled = flip_camera_axes(POSE) @ np.diag([2.0, 2.0, 2.0, 1.0])
    ((_, _, pose),) = read_cameras(written(tmp_path, frames=[{**FRAME, "transform_matrix": scaled[:3].tolist()}]))
    assert pose == pytest.approx(POSE)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": []}, "no frames"),
        ({"frames": [{}]}, "“transform_matrix” is missing"),
        ({"frames": [{"transform_matrix": [[1, 2], [3, 4]]}]}, "not 4 × 4 numbers"),
        ({"frames": [FRAME, {"transform_matrix": np.eye(5).tolist()}]}, "not 4 × 4 numbers"),
        ({"frames": [{"transform_matrix": [[1, 2, 3, 4], [5]]}]}, "not 4 × 4 numbers"),
        ({"frames": [{"transform_matrix": "x"}]}, "not 4 × 4 numbers"),
        ({"frames": [{"transform_matrix": np.full((4, 4), np.nan).tolist()}]}, "not 4 × 4 numbers"),
        ({"frames": [{"transform_matrix": np.zeros((4, 4)).tolist()}]}, "scales to nothing"),
        ({"w": 0}, "“width”"),
        ({"fl_x": 0.0, "fl_y": 0.0}, "focal length"),
        ({"fl_x": None}, "no focal length"),
        ({"camera_model": "ODD"}, "ODD"),
    ],
)
def test_what_is_wrong_with_a_file_is_named(tmp_path: Path, changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_cameras(written(tmp_path, **changes))
    assert "cameras.json" in caught.value.message
    assert "pydantic" not in caught.value.message


def test_names_of_windows_are_names(tmp_path: Path) -> None:
    frames = [{**FRAME, "file_path": path} for path in ("left\\0.png", "right\\0.png")]
    assert [name for name, *_ in read_cameras(written(tmp_path, frames=frames))] == ["left_0", "right_0"]


def test_paths_of_windows_are_found(tmp_path: Path) -> None:
    folder = data_set(tmp_path / "d")
    (folder / "given").mkdir()
    for i in range(3):
        Image.new("L", (320, 200), 255).save(folder / "given" / f"m{i}.png")
    value = json.loads((folder / "transforms.json").read_text())
    for i, frame in enumerate(value["frames"]):
        frame["file_path"] = f".\\images\\f{i}.png"
        frame["mask_path"] = f"given\\m{i}.png"
    value |= {"train_filenames": ["images\\f0.png"], "test_filenames": ["images\\f1.png", ".\\images\\f2.png"]}
    (folder / "transforms.json").write_text(json.dumps(value))
    views = read_dataset(folder).views
    assert [view.image for view in views] == [folder / "images" / f"f{i}.png" for i in range(3)]
    assert [view.mask for view in views] == [folder / "given" / f"m{i}.png" for i in range(3)]
    assert [view.split for view in views] == ["train", "test", "test"]
