"""What goes to Blender and how Blender reads it: lenses, undistorted photos, small file formats. No Blender here."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from fieldwork.addon.photograph import orbit
from fieldwork.addon.photograph.pixels import read_exr, write_index_png
from fieldwork.addon.scene.package import SENSOR_MM, PackageError, blender_camera, read_package
from fieldwork.nerfcore.blender.package import (
    MESH_ARRAYS,
    photo_renders,
    stale,
    undistort,
    undistortion_grid,
    write_package,
)
from fieldwork.nerfcore.data.scene import ClassInfo, Scene, View
from fieldwork.nerfcore.geometry.cameras import Camera, flip_camera_axes, pixel_centers, project, rays
from fieldwork.nerfcore.geometry.points import Points
from fieldwork.nerfcore.images.picture import Picture
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.fingerprints import write_made
from fieldwork.nerfcore.project.runs import RENDER_RECORD
from fieldwork.nerfcore.project.schema import Project, step
from fieldwork.nerfcore.project.store import load_project, save_project
from fieldwork.tests.nerfcore.support.meshed import court
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image


def blender_projection(settings_, width: int, height: int, points: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) at which Blender shows points (N, 3) in its camera's axes.

    Written down from Blender's view plane with horizontal sensor fit: it is `width` pixels wide, `height` times the
    pixels' shape high, lies lens/sensor·width pixels away, and is shifted by `shift · width`.
    """
    tall = settings_.aspect[1] / settings_.aspect[0]
    distance = settings_.lens / SENSOR_MM * width
    x = points[:, 0] / -points[:, 2] * distance - settings_.shift_x * width
    y = points[:, 1] / -points[:, 2] * distance - settings_.shift_y * width
    return np.stack([width / 2 + x, height / 2 - y / tall], -1)


@settings(max_examples=60)
@given(
    width=st.integers(32, 4000),
    height=st.integers(32, 4000),
    fx=st.floats(0.4, 5),
    shape=st.floats(0.5, 2),
    cx=st.floats(0.1, 0.9),
    cy=st.floats(0.1, 0.9),
)
def test_blender_cameras_project_as_pinholes_do(width, height, fx, shape, cx, cy):
    camera = Camera(width=width, height=height, fx=fx * width, fy=fx * shape * width, cx=cx * width, cy=cy * height)
    made = blender_camera(camera.model_dump())
    assert min(made.aspect) == 1
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3)) - [0, 0, 2.5]
    opencv = flip_camera_axes(np.eye(4))[:3, :3] @ points.T
    np.testing.assert_allclose(
        blender_projection(made, width, height, points), project(camera, opencv.T), atol=1e-6 * width * fx
    )


LENSES = [
    Camera(model="OPENCV", width=120, height=80, fx=100, fy=104, cx=57, cy=43, distortion=(-0.2, 0.05, 0.003, -0.002)),
    Camera(
        model="OPENCV_FISHEYE", width=120, height=80, fx=70, fy=70, cx=60, cy=41, distortion=(0.03, -0.01, 0.0, 0.0)
    ),
]


@pytest.mark.parametrize("camera", LENSES, ids=lambda camera: camera.model)
def test_undistorted_photos_show_every_direction_where_a_pinhole_would(camera):
    def view(lens: Camera) -> np.ndarray:
        """A smooth picture painted on the directions, seen through a lens."""
        d, valid = rays(lens, pixel_centers(lens.width, lens.height).reshape(-1, 2))
        x, y = d[:, 0] / d[:, 2], d[:, 1] / d[:, 2]
        picture = np.stack([128 + 100 * np.sin(6 * x), 128 + 100 * np.sin(5 * y), 128 + 90 * np.cos(4 * (x + y))], -1)
        return np.where(valid[:, None], picture, 0).reshape(lens.height, lens.width, 3)

    got = undistort(Picture(np.rint(view(camera)).astype(np.uint8)), undistortion_grid(camera)).pixels
    want = view(camera.undistorted())
    inside = np.abs(undistortion_grid(camera)[0].numpy()).max(-1) < 0.95
    assert inside.mean() > 0.5
    assert np.abs(got - want)[inside].max() < 4
    assert np.abs(got - want)[inside].mean() < 0.6


def scene(folder: Path, lens: Camera) -> Scene:
    folder.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(1).integers(0, 255, (lens.height, lens.width, 3), np.uint8)
    Image.fromarray(pixels).save(folder / "a.png")
    pose = np.eye(4)
    pose[:3, 3] = [1, 2, 3]
    points = Points(np.array([[1.0, 2, 3]]), np.array([[9, 8, 7]], np.uint8), np.zeros(1))
    return Scene([View("a", lens, pose, folder / "a.png")], [0], [], [ClassInfo(1, "stone", (1, 0, 0))], points=points)


def test_a_package_is_read_as_it_was_written(tmp_path):
    lens = Camera(width=60, height=40, fx=50, fy=50, cx=29, cy=22)
    folder = write_package(tmp_path, "main", scene(tmp_path, lens), "Büste", Reporter())
    package = read_package(folder)
    assert package.name == "Büste"
    assert package.mesh is None
    assert package.classes == [{"id": 1, "name": "stone", "color": [1, 0, 0]}]
    np.testing.assert_array_equal(package.xyz, [[1, 2, 3]])
    np.testing.assert_array_equal(package.rgb, [[9, 8, 7]])
    (camera,) = package.cameras
    assert (camera["fx"], camera["cx"], camera["cy"]) == (50, 29, 22)
    # Blender's camera looks along its −z: the OpenCV camera's y and z axes are turned.
    np.testing.assert_array_equal(camera["camera_to_world"], [[1, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1]])
    assert (folder / camera["image"]).read_bytes() == (tmp_path / "a.png").read_bytes()


def test_a_package_says_of_which_project_it_is(tmp_path):
    lens = Camera(width=60, height=40, fx=50, fy=50, cx=29, cy=22)
    save_project(tmp_path, Project())
    folder = write_package(tmp_path, "main", scene(tmp_path, lens), "Büste", Reporter())
    assert read_package(folder).uuid == load_project(tmp_path).uuid


def test_textures_of_earlier_meshes_stay_in_the_package_for_a_while(tmp_path):
    """Scenes that were not updated since show them."""
    views = scene(tmp_path, Camera(width=60, height=40, fx=50, fy=50, cx=29, cy=22))
    exports = tmp_path / "exports/main"
    (exports / "package").mkdir(parents=True)
    (exports / "package/texture.png").write_bytes(b"of the first version")
    np.savez(exports / "mesh.npz", **{name: np.zeros((1, 3)) for name in (*MESH_ARRAYS, "uv")})
    names = []
    for number in (0, 1, 1, 2, 3):
        Image.new("RGB", (4, 4), (number, 0, 0)).save(exports / "texture.png")
        texture = read_package(write_package(tmp_path, "main", views, "p", Reporter())).texture
        assert texture.read_bytes() == (exports / "texture.png").read_bytes()
        os.utime(texture, (10**9 + number, 10**9 + number))
        names.append(texture.name)
        if number == 1:
            assert (exports / "package/texture.png").read_bytes() == b"of the first version"
    assert names[1] == names[2]
    assert len(set(names)) == 4
    kept = {path.name for path in (exports / "package").glob("texture*")}
    assert kept == {*names[2:], "texture.png"}, "the oldest is gone"


def test_renders_of_the_photos_that_are_of_another_run_are_told(tmp_path):
    made = tmp_path / "exports/renders/photos" / RENDER_RECORD  # where earlier versions put those of all runs
    made.parent.mkdir(parents=True)
    write_made(made, step("render", {"run": "second"}, {}))
    assert stale(tmp_path, "second") == []
    assert stale(tmp_path, "main") == ["The renders of the photos are of the run “second”, not of “main”."]


def test_photos_are_undistorted_again_only_when_the_lens_or_the_photo_changed(tmp_path):
    lens = LENSES[0]
    folder = write_package(tmp_path, "main", scene(tmp_path, lens), "p", Reporter())
    photo = folder / "images/a.jpg"
    os.utime(photo, ns=(10**18 * 2, 10**18 * 2))  # marks the file; far in the future, so newer than its source
    assert len(list((folder / "images").iterdir())) == 1
    write_package(tmp_path, "main", scene(tmp_path, lens), "p", Reporter())
    assert photo.stat().st_mtime_ns == 10**18 * 2
    changed = lens.model_copy(update={"distortion": (0.1, 0.0, 0.0, 0.0)})
    write_package(tmp_path, "main", scene(tmp_path, changed), "p", Reporter())
    assert photo.stat().st_mtime_ns != 10**18 * 2


def test_foreign_damaged_and_newer_packages_are_refused(tmp_path):
    with pytest.raises(PackageError, match="not a Fieldwork package"):
        read_package(tmp_path)
    lens = Camera(width=60, height=40, fx=50, fy=50, cx=29, cy=22)
    folder = write_package(tmp_path, "main", scene(tmp_path, lens), "p", Reporter())
    file = folder / "package.json"
    value = json.loads(file.read_text())
    file.write_text(json.dumps({**value, "version": 99}))
    with pytest.raises(PackageError, match="newer"):
        read_package(folder)
    file.write_text(file.read_text()[:40])
    with pytest.raises(PackageError, match="damaged"):
        read_package(folder)
    file.write_text(json.dumps(value))
    (folder / "points.npz").write_bytes(b"PK nonsense")
    with pytest.raises(PackageError, match=r"points\.npz"):
        read_package(folder)


def test_uncompressed_exr_is_read_channel_by_channel(tmp_path):
    pixels = np.random.default_rng(2).normal(0, 3, (7, 5, 3)).astype(np.float32)
    spec = oiio.ImageSpec(5, 7, 3, "float")
    spec.channelnames = ("L.Depth.V", "L.Index.V", "L.Normal.X")
    spec.attribute("compression", "none")
    out = oiio.ImageOutput.create(str(tmp_path / "a.exr"))
    assert out.open(str(tmp_path / "a.exr"), spec)
    assert out.write_image(pixels)
    out.close()
    channels = read_exr(tmp_path / "a.exr")
    for index, name in enumerate(spec.channelnames):
        np.testing.assert_array_equal(channels[name], pixels[..., index])
    (tmp_path / "b.exr").write_bytes(b"not an image at all")
    with pytest.raises(ValueError, match="not a scan-line"):
        read_exr(tmp_path / "b.exr")


def test_index_png_keeps_every_value(tmp_path):
    index = np.random.default_rng(3).integers(0, 256, (9, 13), np.uint8)
    write_index_png(tmp_path / "a.png", index)
    with Image.open(tmp_path / "a.png") as image:
        assert image.mode == "L"
        np.testing.assert_array_equal(np.asarray(image), index)


@given(position=st.tuples(*[st.floats(-5, 5)] * 3), target=st.tuples(*[st.floats(-1, 1)] * 3))
@example(position=(0.0, 0.0, 0.0), target=(1.192092896e-07, 0.0, 1.0))  # nearly straight up
@example(position=(0.0, 0.0, 3.0), target=(0.0, 0.0, 0.0))
def test_look_at_is_a_level_rotation_towards_the_target(position, target):
    position, target = np.array(position), np.array(target)
    if np.linalg.norm(position - target) < 1e-3:
        return
    pose = orbit.look_at(position, target)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(pose[:3, :3]) > 0
    forward = (target - position) / np.linalg.norm(target - position)
    np.testing.assert_allclose(-pose[:3, 2], forward, atol=1e-9)
    assert abs(pose[2, 0]) < 1e-9


def test_sphere_covers_all_sides_and_hemisphere_stays_above():
    center = np.array([1.0, 2, 3])
    for hemisphere in (False, True):
        poses = orbit.sphere(64, center, 2.0, hemisphere)
        offsets = np.array([pose[:3, 3] for pose in poses]) - center
        np.testing.assert_allclose(np.linalg.norm(offsets, axis=-1), 2, atol=1e-9)
        assert (offsets[:, 2] > 0).all() == hemisphere
        nearest = np.sort(np.linalg.norm(offsets[:, None] - offsets, axis=-1), axis=1)[:, 1]
        assert nearest.min() > 0.5 * nearest.max()


@pytest.mark.parametrize("distortion", [(), (0.2, -0.05, 0.0, 0.0)], ids=["straight", "distorted"])
def test_renders_of_photos_are_straightened_and_shown_by_their_camera(tmp_path, distortion, bpy_script):
    lens = Camera(model="OPENCV", width=60, height=40, fx=50, fy=50, cx=29, cy=22, distortion=distortion or (0.0,) * 4)
    taken = scene(tmp_path, lens)
    renders = tmp_path / "exports/renders/photos"
    renders.mkdir(parents=True)
    pixels = np.array(Image.open(tmp_path / "a.png"))[:20, :30]
    Image.fromarray(pixels).save(renders / "a.png")
    Image.fromarray(pixels).save(renders / "of_no_photo.png")
    folder = write_package(tmp_path, "main", taken, "p", Reporter())
    assert read_package(folder).cameras[0]["render"] == "renders/a.png"
    assert [path.name for path in (folder / "renders").iterdir()] == ["a.png"]
    got = np.array(Image.open(folder / "renders/a.png"))
    assert got.shape == pixels.shape
    assert (got == pixels).all() == (not distortion)
    if distortion:
        assert (got == undistort(Picture(pixels), undistortion_grid(lens.resized(30, 20))).pixels).all()
    slots = bpy_script(
        """
from fieldwork.addon.scene.package import read_package
from fieldwork.addon.scene.build import import_package
for _ in range(2):
    imported = import_package(bpy.context.scene, read_package(package))
answer([slot.image.filepath for slot in imported.cameras[0].data.background_images])
""",
        package=folder,
    )
    assert [str(Path(slot).relative_to(folder).parent) for slot in slots] == ["images", "renders"]
    (renders / "a.png").unlink()
    write_package(tmp_path, "main", taken, "p", Reporter())
    assert not list((folder / "renders").iterdir()), "what is gone from the project is gone from the package"


def test_renders_of_photos_are_those_of_the_run(tmp_path: Path) -> None:
    common = tmp_path / "exports/renders/photos"
    assert photo_renders(tmp_path, "b", None) == tmp_path / "exports/b/renders/photos"
    common.mkdir(parents=True)  # of an earlier version
    assert photo_renders(tmp_path, "b", None) == common
    (tmp_path / "exports/b/renders/photos").mkdir(parents=True)
    assert photo_renders(tmp_path, "b", None) == tmp_path / "exports/b/renders/photos"
    assert photo_renders(tmp_path, "main", None) == common
    assert photo_renders(tmp_path, "b", tmp_path / "mine") == tmp_path / "mine"


def test_a_mesh_from_before_the_project_was_aligned_anew_is_told(tmp_path):
    court(tmp_path)
    assert stale(tmp_path, "main") == []
    project = load_project(tmp_path)
    frame = project.frame.model_copy(update={"world_from_sfm": np.diag([2.5, 2.5, 2.5, 1]).tolist()})
    save_project(tmp_path, project.model_copy(update={"frame": frame}))
    (told,) = stale(tmp_path, "main")
    assert "aligned anew" in told
