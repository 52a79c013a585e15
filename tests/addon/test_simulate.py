"""The simulated capture: what a photographer would bring home, and the truth that belongs to it."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from fieldwork.nerfcore.bench.scenes import is_labelled, prepare
from fieldwork.nerfcore.blender.simulate import SCENES, simulate
from fieldwork.nerfcore.errors import Cancelled, InputError, SettingError
from fieldwork.nerfcore.geometry.cameras import Camera, flip_camera_axes, pixel_centers, rays
from fieldwork.nerfcore.params import SimulateParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_poses
from PIL import Image
from PIL.ExifTags import IFD, Base

SIZE, VIEWS = (180, 120), 5
CLASSES = {
    "museum": ["stone", "gilding", "wood", "textile", "ceramic", "floor", "wall"],
    "facade": ["stone", "moss", "black crust", "crack", "loss", "wood", "metal", "ground"],
    "fence": ["enamel", "metal", "leaf", "wood", "ground"],
    "vase": ["ceramic", "gilding", "stone", "textile", "wood"],
}


class Recorder(Reporter):
    """Counts photos; cancels after `stop_after` of them."""

    def __init__(self, stop_after: int = 10**9) -> None:
        super().__init__()
        self.photos, self.stop_after, self.cancelled_at = 0, stop_after, 0.0

    def event(self, kind, **data):
        if kind == "preview":
            self.photos += 1
            if self.photos == self.stop_after:
                self.cancelled_at = time.monotonic()
                self.cancel()


def params(out: Path, **changes) -> SimulateParams:
    return SimulateParams(**{"out": out, "views": VIEWS, "size": SIZE, "samples": 1, **changes})


def simulated(tmp_path_factory: pytest.TempPathFactory, scene: str) -> Path:
    pytest.importorskip("bpy", reason="needs the bpy package")
    out = tmp_path_factory.mktemp("simulated") / "Übung 1"  # a space and an umlaut in the path
    report = Recorder()
    result = simulate(params(out, scene=scene), report)
    assert result["images"] == report.photos == VIEWS
    assert result["classes"] == CLASSES[scene]
    return out


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    return simulated(tmp_path_factory, "museum")


@pytest.fixture(scope="module")
def facade(tmp_path_factory) -> Path:
    return simulated(tmp_path_factory, "facade")


@pytest.fixture(scope="module")
def fence(tmp_path_factory) -> Path:
    return simulated(tmp_path_factory, "fence")


@pytest.fixture(scope="module")
def vase(tmp_path_factory) -> Path:
    return simulated(tmp_path_factory, "vase")


@pytest.fixture(params=SCENES)
def each(request) -> Path:
    """The capture of each scene in turn."""
    return request.getfixturevalue("capture" if request.param == "museum" else request.param)


def views(capture: Path):
    """Per frame: camera, camera-to-world (OpenCV), label map, depth map."""
    truth = json.loads((capture / "ground_truth/transforms.json").read_text())
    assert truth["depth_unit_scale_factor"] == 1.0  # without it others would read millimetres
    camera = Camera(
        width=truth["w"], height=truth["h"], fx=truth["fl_x"], fy=truth["fl_y"], cx=truth["cx"], cy=truth["cy"]
    )
    for frame in truth["frames"]:
        folder = capture / "ground_truth"
        label = np.array(Image.open(folder / frame["label_path"]))
        depth = oiio.ImageBuf(str(folder / frame["depth_file_path"])).get_pixels(oiio.FLOAT)[..., 0]
        yield camera, flip_camera_axes(np.array(frame["transform_matrix"])), label, depth


def places(camera: Camera, pose: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Points (h, w, 3) in the world that a depth map shows."""
    directions, _ = rays(camera, pixel_centers(camera.width, camera.height).reshape(-1, 2))
    local = directions / directions[:, 2:] * depth.reshape(-1, 1)
    return (local @ pose[:3, :3].T + pose[:3, 3]).reshape(*depth.shape, 3)


def test_photos_are_jpegs_as_a_camera_writes_them(capture):
    photos = sorted((capture / "photos").iterdir())
    assert [p.name for p in photos] == [f"IMG_{i:04d}.jpg" for i in range(1, VIEWS + 1)]
    times = set()
    for path in photos:
        with Image.open(path) as photo:
            assert photo.format == "JPEG"
            assert photo.size == SIZE
            exif, pixels = photo.getexif(), np.asarray(photo)
        assert exif[Base.Make]
        assert exif[Base.Model]
        assert exif[Base.Orientation] == 1
        detail = exif.get_ifd(IFD.Exif)
        assert detail[Base.FocalLength] == detail[Base.FocalLengthIn35mmFilm] == 28
        times.add(detail[Base.DateTimeOriginal])
        assert pixels.std() > 20, "the photo shows next to nothing"
    assert len(times) == VIEWS


def test_every_class_is_seen_and_void_is_where_nothing_is(each):
    seen = set()
    for _, _, label, depth in views(each):
        assert label.dtype == np.uint8
        assert ((label == 0) == (depth == 0)).all()
        seen |= set(np.unique(label).tolist())
    known = {int(number) for number in json.loads((each / "classes.json").read_text())["classes"]}
    assert seen - {0} == known
    assert len(known) >= 5


def test_depth_labels_and_poses_agree_on_floor_and_walls(capture):
    """Pixels of the floor lie at z = 0, those of the walls on or near the planes of the room."""
    for camera, pose, label, depth in views(capture):
        world = places(camera, pose, depth)
        floor = world[label == 6]
        assert len(floor) > 100
        assert np.abs(floor[:, 2]).max() < 2e-3
        wall = np.abs(world[label == 7][:, :2]).max(-1)
        assert wall.min() > 2.0
        assert wall.max() < 2.3


def test_the_facade_stands_in_the_open_and_is_seen_from_one_side(facade):
    ids = {name: number for number, name in enumerate(CLASSES["facade"], 1)}
    angles, doors, cracks = [], [], []
    for camera, pose, label, depth in views(facade):
        world = places(camera, pose, depth)
        x, y, z = pose[:3, 3]
        angles.append(np.degrees(np.arctan2(x, -y)))
        assert 2.5 < np.hypot(x, y) < 4.5
        assert 0.5 < z < 2.7
        assert (label == 0).mean() > 0.02, "no sky"
        paved = world[(label == ids["ground"]) & (np.abs(world[..., 0]) < 4) & (np.abs(world[..., 1] + 1.2) < 3)]
        assert len(paved) > 100
        assert np.abs(paved[:, 2]).max() < 2e-3
        doors.append(world[label == ids["wood"]])
        cracks.append(world[label == ids["crack"]])
    assert np.abs(np.concatenate(doors)[:, 1] - 0.27).max() < 0.04
    assert np.abs(np.concatenate(cracks)[:, 1]).max() < 0.15
    assert 140 < max(angles) - min(angles) < 160


def test_each_scene_can_be_chosen_everywhere(bpy_script):
    root = Path(__file__).parents[2]
    code = (
        "sys.path.insert(0, root)\nimport fieldwork\nfrom fieldwork.addon.simulate.task import SCENES\n"
        "fieldwork.register()\nitems = bpy.ops.fieldwork.simulate.get_rna_type().properties['scene'].enum_items\n"
        "answer([list(SCENES), [item.identifier for item in items]])"
    )
    assert bpy_script(code, root=str(root.parent)) == [list(SCENES), list(SCENES)]


def test_true_surface_has_the_classes_of_the_label_maps(each):
    named = json.loads((each / "classes.json").read_text())["classes"]
    known = {int(number) for number in named}
    with np.load(each / "ground_truth/mesh.npz") as mesh:
        vertices, faces, classes = mesh["vertices"], mesh["faces"], mesh["face_class"]
    assert faces.max() < len(vertices)
    assert len(faces) == len(classes)
    assert set(np.unique(classes)) == known
    if named["2"]["name"] in ("gilding", "moss"):  # painted on the first class: they share vertices
        shared = np.intersect1d(faces[classes == 1], faces[classes == 2])
        assert len(shared) > 100
    header = (each / "ground_truth/mesh.ply").read_bytes()[:400]
    assert f"element face {len(faces)}".encode() in header


def test_a_benchmark_takes_each_scene_with_its_true_poses_and_labels(each, tmp_path, monkeypatch):
    """`prepare` asks for the scene by name; the photos stand in for the 48 it would take."""

    def taken(params: SimulateParams, report: Reporter) -> None:
        classes = json.loads((each / "classes.json").read_text())["classes"]
        assert [entry["name"] for entry in classes.values()] == CLASSES[params.scene]
        shutil.copytree(each, params.out)

    monkeypatch.setattr("fieldwork.nerfcore.bench.scenes.simulate", taken)
    scene = json.loads((each / "simulate.json").read_text())["scene"]
    project = prepare(scene, None, tmp_path, Reporter())
    assert is_labelled(project)
    assert len(load_poses(project).images) == VIEWS


def test_only_missing_photos_are_taken_again(capture):
    photos = sorted((capture / "photos").iterdir())
    before = {p: (p.stat().st_mtime_ns, np.asarray(Image.open(p))) for p in photos}
    photos[2].unlink()
    report = Recorder()
    simulate(params(capture), report)
    assert report.photos == 1
    for path, (time_ns, pixels) in before.items():
        assert (path.stat().st_mtime_ns == time_ns) == (path != photos[2])
        assert np.abs(np.asarray(Image.open(path)).astype(int) - pixels).max() <= 2
    assert not (capture / ".raw").exists()


def test_other_settings_or_foreign_files_are_refused(capture, tmp_path):
    with pytest.raises(InputError, match="other settings"):
        simulate(params(capture, seed=5), Reporter())
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="not empty"):
        simulate(params(tmp_path), Reporter())
    with pytest.raises(SettingError, match="no scene"):
        simulate(params(tmp_path / "x", scene="palace"), Reporter())
    with pytest.raises(SettingError, match="cannot show the whole"):
        simulate(params(tmp_path / "x", overviews=2), Reporter())
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("scene", SCENES)
def test_overviews_are_the_last_photos_and_taken_from_farther_away(scene, tmp_path):
    pytest.importorskip("bpy", reason="needs the bpy package")
    simulate(params(tmp_path / "c", scene=scene, views=6, overviews=2, size=(48, 32)), Reporter())
    frames = json.loads((tmp_path / "c/ground_truth/transforms.json").read_text())["frames"]
    place = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    away = np.linalg.norm(place, axis=1)
    assert len(away) == 6
    assert away[4:].min() > 1.3 * away[:4].max()


def test_cancel_is_prompt_and_the_next_run_goes_on(tmp_path):
    pytest.importorskip("bpy", reason="needs the bpy package")
    report = Recorder(stop_after=1)
    with pytest.raises(Cancelled):
        simulate(params(tmp_path / "c", views=4), report)
    assert time.monotonic() - report.cancelled_at < 2
    taken = len(list((tmp_path / "c/photos").iterdir()))
    assert taken == 1
    assert not (tmp_path / "c/.raw").exists()
    report = Recorder()
    assert simulate(params(tmp_path / "c", views=4), report)["images"] == 4
    assert report.photos == 3
