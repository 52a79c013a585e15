"""Fisheye and equirectangular photos all the way: read with their poses, trained on, rendered and measured."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.geometry.cameras import Camera, pixel_centers, rays
from fieldwork.nerfcore.params import EvaluateParams, ImportParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.render.verb import look_at
from fieldwork.nerfcore.verbs import run_verb
from PIL import Image

HALF = np.array([2.0, 1.6, 1.2])  # of the room
WALLS = np.array([[200, 70, 60], [60, 160, 80], [70, 90, 200], [210, 180, 60], [120, 110, 100], [190, 190, 200]])
LENSES = {
    # 190° across the picture
    "fisheye": Camera(
        model="OPENCV_FISHEYE", width=72, height=72, fx=24.0, fy=24.0, cx=36.0, cy=36.0,
        distortion=(-0.02, 0.004, 0.0, 0.0),
    ),
    "equirectangular": Camera(
        model="EQUIRECTANGULAR", width=96, height=48, fx=48.0, fy=48.0, cx=48.0, cy=24.0
    ),
}  # fmt: skip
SMALL = {
    "field.levels": "4",
    "field.finest": "64",
    "field.table_log2": "15",
    "field.width": "32",
    "sampling.resolution": "48",
    "train.batch_start": "4096",
    "train.batch_samples": "16384",
    "train.seed": "3",
}


def room(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Colours (N, 3) of the walls of a box, six colours in two shades of 0.8 m squares, seen from inside."""
    with np.errstate(divide="ignore"):
        reach = (np.sign(direction) * HALF - origin) / direction
    axis = reach.argmin(1)
    hit = origin + direction * reach.min(1)[:, None]
    others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    squares = np.floor((np.take_along_axis(hit, others, 1) + 10) / 0.8).sum(1) % 2
    side = 2 * axis + (np.take_along_axis(direction, axis[:, None], 1)[:, 0] > 0)
    return (WALLS[side] * np.where(squares, 1.0, 0.6)[:, None]).astype(np.uint8)


def write_dataset(folder: Path, camera: Camera, model: str) -> None:
    """24 photos of the room with transforms.json in nerfstudio's keys."""
    (folder / "images").mkdir(parents=True)
    frames = []
    directions, valid = rays(camera, pixel_centers(camera.width, camera.height).reshape(-1, 2))
    for i in range(24):
        angle = 2 * math.pi * i / 24
        place = np.array([0.8 * math.cos(angle), 0.7 * math.sin(angle), 0.5 * math.sin(5 * angle)])
        pose = look_at(place, np.array([1.5 * math.cos(3 * angle), 1.5 * math.sin(2 * angle), 0.3 * math.cos(angle)]))
        colors = room(pose[:3, 3], directions @ pose[:3, :3].T) * valid[:, None]
        name = f"images/{i:03d}.png"
        Image.fromarray(colors.reshape(camera.height, camera.width, 3).astype(np.uint8)).save(folder / name)
        frames.append({"file_path": name, "transform_matrix": (pose @ np.diag([1.0, -1, -1, 1])).tolist()})
    keys = {"w": camera.width, "h": camera.height, "camera_model": model, "frames": frames}
    if camera.model == "OPENCV_FISHEYE":
        keys |= {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
        keys |= {f"k{n}": value for n, value in enumerate(camera.distortion, 1)}
    (folder / "transforms.json").write_text(json.dumps(keys))


@pytest.mark.slow
@pytest.mark.parametrize("lens", ["fisheye", "equirectangular"])
def test_wide_lenses_end_to_end(tmp_path: Path, lens: str) -> None:
    camera, report = LENSES[lens], Reporter()
    write_dataset(tmp_path / "set", camera, {"fisheye": "OPENCV_FISHEYE"}.get(lens, "EQUIRECTANGULAR"))
    project = tmp_path / "p"
    assert run_verb("import", ImportParams(dataset=tmp_path / "set", project=project), report)["images"] == 24
    scene = load_scene(project)
    assert all(view.camera == camera for view in scene.views)
    run_verb("train", TrainParams(project=project, preset="draft", steps=600, set=SMALL), report)
    result = run_verb("evaluate", EvaluateParams(project=project), report)
    assert result["psnr"] > 20
