"""Cameras and class masks of a capture for other programs: COLMAP itself, an importer, a ray caster and label imports read
them back."""

from __future__ import annotations

import json
import zlib  # noqa: F401  (before pycolmap)
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import trimesh
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.data.scene import Scene
from fieldwork.nerfcore.errors import FieldworkError, SettingError
from fieldwork.nerfcore.export.cameras import write_colmap, write_transforms
from fieldwork.nerfcore.export.class_masks import write_masks
from fieldwork.nerfcore.geometry.cameras import Camera, pixel_centers, project, rays
from fieldwork.nerfcore.geometry.points import Points
from fieldwork.nerfcore.images.working import read_label
from fieldwork.nerfcore.params import ExportParams, ImportParams
from fieldwork.nerfcore.progress import Cancelled, Reporter
from fieldwork.nerfcore.project.schema import SemanticClass
from fieldwork.nerfcore.project.store import edit_project, load_poses, load_project
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support import painted_box as box
from fieldwork.tests.nerfcore.support.ball import ball_project
from fieldwork.tests.nerfcore.support.meshed import store_mesh
from PIL import Image

SIZE = {"width": 320, "height": 200, "fx": 260.0, "fy": 250.0, "cx": 150.0, "cy": 110.0}
LENSES = {
    "pinhole": Camera(**SIZE),
    "radial": Camera(model="OPENCV", **SIZE, distortion=(-0.1, 0.02, 0.001, -0.002)),
    "three terms": Camera(model="OPENCV", **SIZE, distortion=(-0.1, 0.02, 0.001, -0.002, 0.003)),
    "rational": Camera(model="OPENCV", **SIZE, distortion=(-0.1, 0.02, 0.001, -0.002, 0.003, 0.01, 0.02, -0.003)),
    "fisheye": Camera(model="OPENCV_FISHEYE", **SIZE, distortion=(0.02, -0.01, 0.002, 0.001)),
}
PLACES = np.random.default_rng(7).uniform(-0.6, 0.6, (40, 3)) + [0.2, 0.1, 0.3]


def scene(folder: Path, *lenses: Camera) -> Scene:
    """A photo with each lens, and sparse points."""
    (folder / "images").mkdir(parents=True)
    views = []
    for number, camera in enumerate(lenses):
        image = folder / "images" / f"IMG_{number}.png"
        Image.new("RGB", (camera.width, camera.height)).save(image)
        pose = box.VIEW.camera_to_world.copy()
        pose[:3, 3] += 0.1 * number
        views.append(replace(box.VIEW, name=image.stem, camera=camera, camera_to_world=pose, image=image))
    rgb = np.random.default_rng(8).integers(0, 256, (len(PLACES), 3)).astype(np.uint8)
    points = Points(PLACES, rgb, np.linspace(0, 1, len(PLACES)))
    return Scene(views, list(range(1, len(views))), [0], frame="world", points=points)


def seen(view, points: np.ndarray) -> np.ndarray:
    """Where our camera of a view sees points of the world."""
    pose = view.camera_to_world
    return project(view.camera, (points - pose[:3, 3]) @ pose[:3, :3])


def test_colmap_sees_what_our_cameras_see(tmp_path: Path) -> None:
    ours = scene(tmp_path / "p", *LENSES.values(), LENSES["radial"])
    files = write_colmap(tmp_path / "out", ours)
    assert {path.name for path in files} == {"cameras.txt", "images.txt", "points3D.txt"}
    model = pycolmap.Reconstruction(str(tmp_path / "out" / "sparse" / "0"))
    assert model.num_cameras() == len(LENSES)  # two photos share one
    images = {image.name: image for image in model.images.values()}
    assert set(images) == {view.image.name for view in ours.views}
    for view in ours.views:
        image = images[view.image.name]
        local = image.cam_from_world() * PLACES
        theirs = model.cameras[image.camera_id].img_from_cam(local)
        np.testing.assert_allclose(theirs, seen(view, PLACES), atol=1e-6)
    places = np.array([point.xyz for point in model.points3D.values()])
    np.testing.assert_allclose(places[np.lexsort(places.T)], PLACES[np.lexsort(PLACES.T)], atol=1e-12)
    assert sorted(map(tuple, (point.color for point in model.points3D.values()))) == sorted(
        map(tuple, ours.points.rgb.tolist())
    )


def test_transforms_say_what_our_cameras_see(tmp_path: Path) -> None:
    """By their definition: camera-to-world, looking along −z with y up, lenses by the keys that COLMAP's models have."""
    ours = scene(tmp_path / "p", *(LENSES[name] for name in ("pinhole", "radial", "fisheye")))
    out = tmp_path / "p" / "exports" / "transforms.json"
    write_transforms(out, ours, metres=True)
    tree = json.loads(out.read_text("utf-8"))
    assert tree["test_filenames"] == ["../images/IMG_0.png"]
    assert "metres" in tree["camera_convention"]
    for view, frame in zip(ours.views, tree["frames"]):
        assert (out.parent / frame["file_path"]).resolve() == view.image
        looking = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])
        local = (np.linalg.inv(looking) @ np.append(PLACES, np.ones((len(PLACES), 1)), 1).T)[:3].T
        keys = {"OPENCV": ("k1", "k2", "p1", "p2"), "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4")}
        names = ("fl_x", "fl_y", "cx", "cy", *keys.get(frame["camera_model"], ()))
        lens = pycolmap.Camera(
            model=frame["camera_model"],
            width=frame["w"],
            height=frame["h"],
            params=[frame[name] for name in names],
        )
        np.testing.assert_allclose(lens.img_from_cam(local), seen(view, PLACES), atol=1e-6)
    cloud = trimesh.load(out.parent / tree["ply_file_path"])
    np.testing.assert_allclose(cloud.vertices, PLACES, atol=1e-6)
    np.testing.assert_array_equal(np.asarray(cloud.colors)[:, :3], ours.points.rgb)


@pytest.mark.parametrize("lens", ["fisheye", "panorama"])
def test_nerfstudio_and_instant_ngp_find_what_they_look_for(tmp_path: Path, lens: str) -> None:
    """Which keys those are: nerfstudio_dataparser.py and nerf_loader.cu."""
    panorama = Camera(model="EQUIRECTANGULAR", width=320, height=160, fx=160, fy=160, cx=160, cy=80)
    camera = {**LENSES, "panorama": panorama}[lens]
    ours = scene(tmp_path / "p", camera, camera, camera)
    mask = tmp_path / "p" / "mask.png"
    Image.new("L", (camera.width, camera.height), 0).save(mask)
    ours.views[0] = replace(ours.views[0], mask=mask)
    out = tmp_path / "p" / "exports" / "transforms.json"
    files = write_transforms(out, ours, metres=False)
    tree = json.loads(out.read_text("utf-8"))
    assert tree["camera_model"] == camera.model, "nerfstudio knows one model, that of the whole file"
    assert tree["val_filenames"] == tree["test_filenames"] == ["../images/IMG_0.png"]
    assert all({"fl_x", "fl_y", "cx", "cy", "w", "h"} <= set(frame) for frame in tree["frames"])
    assert [frame.get("is_fisheye", False) for frame in tree["frames"]] == [lens == "fisheye"] * 3
    masks = [out.parent / frame["mask_path"] for frame in tree["frames"]]
    assert masks[0].resolve() == mask
    assert masks[1] == masks[2] in files
    with Image.open(masks[1]) as white:
        assert white.size == (camera.width, camera.height)
        assert white.getextrema() == (255, 255)
    write_transforms(out, replace(ours, train=[0, 1, 2], test=[]), metres=False)
    assert not any("filenames" in key for key in json.loads(out.read_text("utf-8"))), "it holds some out by itself"


@pytest.mark.parametrize(("to", "read"), [("transforms", "transforms.json"), ("colmap", "colmap")])
def test_a_capture_is_imported_as_it_was_exported(tmp_path: Path, to: str, read: str) -> None:
    folder = ball_project(tmp_path / "Kugel ü", views=6, points=30)
    files = run_verb("export", ExportParams.model_validate({"project": folder, "to": to}), Reporter())["files"]
    assert all(Path(path).is_file() for path in files)
    source = folder / "exports" / "main" / read
    if to == "colmap":  # a data set of that format has the model beside its images
        source = tmp_path / "data"
        (folder / "exports" / "main" / "colmap").rename(source)
        (source / "images").symlink_to(folder / "images")
    again = tmp_path / "again"
    run_verb("import", ImportParams.model_validate({"dataset": source, "project": again}), Reporter())
    ours, theirs = load_scene(folder), load_scene(again)
    assert [view.name for view in theirs.views] == [view.name for view in ours.views]
    for one, other in zip(ours.views, load_poses(again).images if to == "colmap" else theirs.views):
        # COLMAP's models know no up: how the file has it, before its cameras turned it.
        np.testing.assert_allclose(np.array(other.camera_to_world), one.camera_to_world, atol=1e-6)
    for one, other in zip(ours.views, theirs.views):
        assert other.camera == one.camera
    assert len(theirs.points) == len(ours.points) == 30


@pytest.mark.parametrize("mode", ["ignore", "empty"])
def test_transforms_say_what_labels_and_masks_mean(tmp_path: Path, mode: str) -> None:
    """Also where the id 0 is a class, and another one stands for void."""
    folder = ball_project(tmp_path / "p", views=6)
    (folder / "masks").mkdir()
    with edit_project(folder) as edited:
        edited.ignore_id, edited.mask_mode = 255, mode
        names = {0: ("stone", (0.2, 0.6, 1.0)), 1: ("wood", (1.0, 0.0, 0.4)), 2: ("gold", (0.8, 0.2, 0.0))}
        edited.classes = [SemanticClass(id=i, name=name, color=color) for i, (name, color) in names.items()]
        for record in edited.images:
            record.mask = f"masks/{record.name}.png"
            half = Image.new("L", (record.width, record.height), 255)
            half.paste(0, (0, 0, record.width, 5))
            half.save(folder / record.mask)
            label = Image.open(folder / record.label)
            label.paste(255, (0, 0, 4, 4))
            label.save(folder / record.label)
    files = run_verb("export", ExportParams(project=folder, to="transforms"), Reporter())["files"]
    assert str(folder / "exports" / "main" / "classes.json") in files
    source = folder / "exports" / "main" / "transforms.json"
    run_verb("import", ImportParams(dataset=source, project=tmp_path / "again"), Reporter())
    ours, theirs = load_project(folder), load_project(tmp_path / "again")
    assert theirs.classes == ours.classes
    assert (theirs.ignore_id, theirs.mask_mode) == (255, mode)
    for one, other in zip(load_scene(folder).views, load_scene(tmp_path / "again").views):
        np.testing.assert_array_equal(read_label(other.label), read_label(one.label))


def test_the_classes_file_of_a_data_set_is_not_written_over(tmp_path: Path) -> None:
    folder = ball_project(tmp_path / "p", views=3)
    out = tmp_path / "set" / "transforms.json"
    out.parent.mkdir()
    theirs = out.with_name("classes.json")
    theirs.write_text('["void", "mine"]')
    params = ExportParams(project=folder, to="transforms", out=out)
    with pytest.raises(SettingError, match=r"classes\.json is there already"):
        run_verb("export", params, Reporter())
    assert theirs.read_text() == '["void", "mine"]'
    assert not out.exists()
    theirs.unlink()
    run_verb("export", params, Reporter())
    with edit_project(folder) as edited:
        edited.classes[0].name = "another"
    run_verb("export", params, Reporter())  # its own
    assert "another" in theirs.read_text()


def test_lenses_that_a_format_does_not_know_are_told(tmp_path: Path) -> None:
    panorama = Camera(model="EQUIRECTANGULAR", width=320, height=160, fx=160, fy=160, cx=160, cy=80)
    with pytest.raises(FieldworkError, match="panoramas"):
        write_colmap(tmp_path / "out", scene(tmp_path / "a", panorama))
    with pytest.raises(SettingError, match="denominator"):
        write_transforms(tmp_path / "out.json", scene(tmp_path / "b", LENSES["rational"]), metres=False)
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "out.json").exists()


def first_hit(triangles: np.ndarray, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The triangle (N,) of (F, 3, 3) that rays (N, 3) meet first; −1 for none: all pairs, as linear equations."""
    a, b, c = triangles.transpose(1, 0, 2)
    edges = np.stack([b - a, c - a], -1)
    equations = np.concatenate(
        [np.broadcast_to(edges, (len(directions), *edges.shape)), np.empty((len(directions), len(a), 3, 1))], -1
    )
    equations[..., 2] = -directions[:, None]
    u, v, far = np.moveaxis(
        np.linalg.solve(equations, np.broadcast_to((origin - a)[None, :, :, None], (*equations.shape[:2], 3, 1)))[
            ..., 0
        ],
        -1,
        0,
    )
    far = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (far > 0), far, np.inf)
    return np.where(np.isfinite(far.min(1)), far.argmin(1), -1)


def test_masks_are_what_a_ray_meets_first(tmp_path: Path) -> None:
    camera = Camera(width=80, height=50, fx=65, fy=62.5, cx=37.5, cy=27.5)
    view = replace(box.VIEW, camera=camera)
    surface = box.surface()
    ids = np.array([[3, 7], [0, 3]], np.uint8)
    written = write_masks(tmp_path / "masks", surface, ids, [view], box.CLASSES, Reporter())
    assert {path.relative_to(tmp_path / "masks").as_posix() for path in written} == {
        "photos/Säule_1/IMG 1.png", "photos/gold/IMG 1.png", "texture/Säule_1.png", "texture/gold.png",
    }  # fmt: skip
    assert all(path.is_file() for path in written)
    directions, _ = rays(camera, pixel_centers(80, 50).reshape(-1, 2))
    turned = directions @ view.camera_to_world[:3, :3].T
    hit = first_hit(surface.vertices[surface.faces].astype(float), view.camera_to_world[:3, 3], turned)
    true = np.where(hit >= 0, box.FACE_CLASS[hit], -1).reshape(50, 80)
    for number, name in ((3, "Säule_1"), (7, "gold")):
        with Image.open(tmp_path / "masks" / "photos" / name / "IMG 1.png") as image:
            mask = np.array(image)
        assert set(np.unique(mask)) == {0, 255}
        assert ((mask == 255) != (true == number)).mean() < 0.002
        assert (true == number).sum() > 100
    with Image.open(tmp_path / "masks" / "texture" / "gold.png") as image:
        np.testing.assert_array_equal(np.array(image), [[0, 255], [0, 0]])


def test_masks_of_a_mesh_without_classes_are_warned_of(tmp_path: Path) -> None:
    folder = ball_project(tmp_path / "ball", views=9)
    ball = trimesh.creation.icosphere(1, 0.5)
    store_mesh(folder, ball, np.zeros(len(ball.faces), int), ball, 0.03)
    report = Reporter()
    run_verb("export", ExportParams(project=folder, to="masks"), report)
    assert any("no classes, so all masks are empty. Label some photos" in warning for warning in report.warnings)
    with edit_project(folder) as edited:
        edited.classes = []
    report = Reporter()
    assert run_verb("export", ExportParams(project=folder, to="masks"), report)["files"] == []
    assert any("so no masks are written" in warning for warning in report.warnings)


def test_masks_that_are_stopped_leave_those_that_were_there(tmp_path: Path) -> None:
    class Stopped(Reporter):
        asked = 0

        def check(self) -> None:
            self.asked += 1
            if self.asked > 4:
                raise Cancelled

    old = tmp_path / "photos" / "gold" / "IMG 1.png"
    old.parent.mkdir(parents=True)
    old.write_bytes(b"old")
    views = [replace(box.VIEW, name=name) for name in ("IMG 1", "IMG 2", "IMG 3")]
    with pytest.raises(Cancelled):
        write_masks(tmp_path, box.surface(), None, views, box.CLASSES, Stopped())
    assert old.read_bytes() == b"old"
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["IMG 1.png"]
