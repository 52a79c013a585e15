"""Photos and lenses within a budget of memory: the same batches, wherever the photos are and however rays are found."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.config import make_config
from fieldwork.nerfcore.data.camera_rays import CameraRays
from fieldwork.nerfcore.data.lenses import Lenses
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.data.pixels import PixelStore, home_of
from fieldwork.nerfcore.geometry.cameras import Camera, pixel_centers, rays
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project, save_project
from fieldwork.nerfcore.sampling.outlines import Outlines
from fieldwork.nerfcore.train.prepare import photo_budget
from fieldwork.tests.nerfcore.support.ball import ball_project
from fieldwork.tests.nerfcore.support.settings import trainer_of
from PIL import Image

CPU = torch.device("cpu")
SIZE = {"width": 60, "height": 44, "fx": 41.0, "fy": 43.0, "cx": 29.0, "cy": 23.5}
CAMERAS = {
    "pinhole": Camera(**SIZE),
    "opencv": Camera(model="OPENCV", distortion=(-0.1, 0.02, 0.001, -0.002), **SIZE),
    "full opencv": Camera(model="OPENCV", distortion=(0.2, -0.1, 0.001, 0.002, 0.03, 0.15, -0.05, 0.01), **SIZE),
    "opencv without distortion": Camera(model="OPENCV", distortion=(0.0, 0.0, 0.0, 0.0), **SIZE),
    "folding opencv": Camera(model="OPENCV", distortion=(-0.9, 0.1, 0.0, 0.0), **SIZE),
    "fisheye": Camera(model="OPENCV_FISHEYE", distortion=(-0.02, 0.004, 0.0, 0.0), **{**SIZE, "fx": 14.0, "fy": 14.0}),
    "folding fisheye": Camera(model="OPENCV_FISHEYE", distortion=(-0.2, 0.0, 0.0, 0.0), **{**SIZE, "fx": 14.0}),
    "equirectangular": Camera(model="EQUIRECTANGULAR", **SIZE),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_lenses_are_inverted_as_by_the_camera(name: str) -> None:
    camera = CAMERAS[name]
    pixels = pixel_centers(camera.width, camera.height).reshape(-1, 2)
    expected, valid = rays(camera, pixels)
    if "folding" in name:
        assert 0 < valid.sum() < len(valid)
    others = [CAMERAS["fisheye"], camera, CAMERAS["full opencv"]]  # of the same batch, which must not matter
    image = torch.ones(len(pixels), dtype=torch.long)
    found = Lenses(others, CPU).directions(image, torch.from_numpy(pixels).float())
    assert torch.equal(found[:, 0].isnan(), torch.from_numpy(~valid))
    assert np.abs(found[valid].numpy() - expected[valid]).max() < 1e-6


@pytest.mark.parametrize("name", CAMERAS)
def test_a_camera_alone_has_the_rays_it_has_among_others(name: str) -> None:
    cameras = [CAMERAS["fisheye"], CAMERAS[name], CAMERAS["pinhole"]]
    poses = np.stack([np.eye(4)] * 3)
    poses[:, :3, :3] = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3, 3)))[0]
    poses[:, :3, 3] = np.arange(9).reshape(3, 3)
    pixel = torch.arange(cameras[1].width * cameras[1].height)
    origins, directions = CameraRays(cameras[1:2], poses[1:2], CPU)(torch.zeros_like(pixel), pixel)
    expected = CameraRays(cameras, poses, CPU)(torch.ones_like(pixel), pixel)
    assert torch.equal(origins, expected[0])
    assert torch.allclose(directions, expected[1], rtol=0, atol=1e-6, equal_nan=True)
    assert origins.is_contiguous()
    assert directions.is_contiguous()


def test_directions_are_the_same_from_a_table_and_for_each_batch() -> None:
    cameras = list(CAMERAS.values()) * 2
    poses = np.tile(np.eye(4), (len(cameras), 1, 1))
    poses[:, :3, 3] = np.random.default_rng(0).normal(size=(len(cameras), 3))
    table, each = CameraRays(cameras, poses, CPU), CameraRays(cameras, poses, CPU, budget=100.0)
    assert table.table is not None
    assert len(table.table) == (len(CAMERAS) - 1) * SIZE["width"] * SIZE["height"]  # equal lenses share
    assert each.table is None
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(0, len(cameras), (4000,), generator=generator)
    pixel = torch.randint(0, int(SIZE["width"] * SIZE["height"]), (4000,), generator=generator)
    for ours, theirs in zip(each(image, pixel), table(image, pixel)):
        assert torch.allclose(ours, theirs, atol=1e-7, equal_nan=True)


@pytest.fixture
def masked(tmp_path: Path) -> Path:
    """The ball through a lens that folds over at its corners, with labels, confidence and masks."""
    project = ball_project(tmp_path / "ball", views=6, side=40)
    for kind in ("masks", "confidence"):
        (project / kind).mkdir()
    loaded = load_project(project)
    for index, record in enumerate(loaded.images):
        mask = np.full((40, 40), 255, np.uint8)
        mask[:5] = 0
        Image.fromarray(mask).save(project / "masks" / f"{record.name}.png")
        Image.fromarray(np.full((40, 40), 40 * index, np.uint8)).save(project / "confidence" / f"{record.name}.png")
        record.mask, record.confidence = f"masks/{record.name}.png", f"confidence/{record.name}.png"
    save_project(project, loaded)
    path = project / "poses" / "poses.json"
    poses = json.loads(path.read_text("utf-8"))
    poses["cameras"][0].update(model="OPENCV", distortion=[-0.9, 0.1, 0.0, 0.0])
    path.write_text(json.dumps(poses), "utf-8")
    return project


def store_of(project: Path, budget: float) -> PixelStore:
    scene = dataclasses.replace(load_scene(project), mask_mode="ignore")
    return PixelStore(scene, list(range(6)), [1, 2], np.eye(4), 40, CPU, Reporter(), budget)


def test_a_tiny_budget_gives_the_same_batches(masked: Path) -> None:
    plenty, tiny = store_of(masked, math.inf), store_of(masked, 10.0)
    assert plenty.rays.table is not None
    assert tiny.rays.table is None
    assert plenty.usable is not None
    assert tiny.usable is not None
    assert torch.equal(plenty.usable, tiny.usable)
    assert len(plenty.usable) < 6 * 40 * 35  # masked, and where the lens folds over
    drawn = [store.random_pixels(500, torch.Generator().manual_seed(1)) for store in (plenty, tiny)]
    assert torch.equal(*drawn)
    one, other = (store.batch(places) for store, places in zip((plenty, tiny), drawn))
    for field in dataclasses.fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if a is None or b is None:
            assert a is b, field.name
            continue
        assert torch.allclose(a, b, atol=1e-7) if field.name in ("origins", "directions") else torch.equal(a, b)
    lines = [Outlines(store, 0.2) for store in (plenty, tiny)]
    picked = [o.draw(100, torch.Generator().manual_seed(2)) for o in lines]
    assert torch.equal(*picked)
    assert torch.equal(lines[0].weight(drawn[0]), lines[1].weight(drawn[1]))


def test_photos_stay_with_the_host_where_the_device_has_no_room() -> None:
    gpu = torch.device("cuda")
    assert home_of(1000, 1000.0, gpu) == gpu
    assert home_of(1001, 1000.0, gpu) == CPU
    assert home_of(1001, 1000.0, CPU) == CPU


def test_a_store_larger_than_its_budget_keeps_its_photos_with_the_host(tmp_path: Path) -> None:
    scene = load_scene(ball_project(tmp_path / "ball", views=6, side=40))
    elsewhere, size = torch.device("meta"), 2 * 40 * 40 * 5  # a device that holds no numbers; colours, alpha and labels
    for budget, home in ((size, elsewhere), (size - 1, CPU)):
        store = PixelStore(scene, [0, 1], [1, 2], np.eye(4), 40, elsewhere, Reporter(), budget)
        assert {store.home, store.rgba.device, store.label.device} == {home}


@pytest.mark.setting("scene.photo_memory")
def test_the_setting_is_the_budget(masked: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from fieldwork.nerfcore.train import prepare

    monkeypatch.setattr(prepare, "free_memory", lambda device: 6_000_000_000)
    assert photo_budget(make_config("draft"), CPU) == 3e9
    assert photo_budget(make_config("draft", {"scene.photo_memory": "0.5"}), CPU) == 5e8
    assert trainer_of(masked).store.rays.table is not None
    trainer = trainer_of(masked, **{"scene.photo_memory": "0"})
    assert trainer.store.rays.table is None
    for step in range(3):
        trainer.step(step / 3)
    assert math.isfinite(trainer.take_measured().psnr)


READ = """
import resource, sys
from pathlib import Path
import numpy as np, torch
from fieldwork.nerfcore.data.pixels import PixelStore
from fieldwork.nerfcore.data.scene import Scene, View
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.progress import Reporter
camera = Camera(width=800, height=600, fx=700, fy=700, cx=400, cy=300)
views = [View(str(i), camera, np.eye(4), Path(sys.argv[1])) for i in range(80)]
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
def read(some):
    indices = list(range(len(some)))
    return PixelStore(Scene(some, indices, []), indices, [], np.eye(4), 800, torch.device("cpu"), Reporter())
read(views[:2])
before = peak()
store = read(views)
print((peak() - before) / (store.rgba.nbytes + store.label.nbytes))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the unit of ru_maxrss is that of Linux")
def test_photos_are_read_into_the_memory_where_they_stay(tmp_path: Path) -> None:
    Image.new("RGB", (800, 600), (90, 120, 200)).save(tmp_path / "a.jpg")
    done = subprocess.run(
        [sys.executable, "-c", READ, str(tmp_path / "a.jpg")], capture_output=True, text=True, check=True
    )
    assert float(done.stdout) < 1.5, "times what is kept"
