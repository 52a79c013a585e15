"""Readers of posed data sets: matches between photos must lie on the epipolar lines that the poses and lenses predict.

Sets that are not at hand are written by the test from the fountain's cameras, in the words of each format's
documentation, and read back.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import zlib  # noqa: F401  (before pycolmap)
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from fieldwork.nerfcore.data.dataset import Dataset, DatasetView
from fieldwork.nerfcore.data.importer import import_dataset, read_dataset
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.errors import FieldworkError, InputError, ProjectError
from fieldwork.nerfcore.geometry.similarity import transform_points
from fieldwork.nerfcore.images.encode import write_depth
from fieldwork.nerfcore.params import ImportParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project
from fieldwork.tests.nerfcore.support.matches import Matches, epipolar_error, find_matches
from fieldwork.tests.nerfcore.support.writers import (
    bend,
    write_colmap_binary,
    write_colmap_text,
    write_dtu,
    write_llff,
    write_meshroom,
    write_metashape,
    write_realityscan,
    write_replica,
    write_scannet,
    write_transforms,
)
from PIL import Image

Data = Callable[[str], Path]


@pytest.mark.parametrize(
    ("name", "format", "picked"),
    [
        ("fox", "transforms", range(0, 24, 4)),
        ("lego_400", "transforms", [17, 26, 54, 60, 74, 83, 85, 96]),
        ("replica_room", "transforms", range(30, 42, 2)),
        ("mary_rose_tankard", "llff", range(0, 12, 2)),
        ("fountain_p11", "strecha", range(3, 9)),
        ("temple_ring", "middlebury", [30, 31, 32, 33, 38, 39, 11, 10]),
    ],
)
def test_real_sets_agree_with_their_photos(
    shared_data: Data, tmp_path: Path, name: str, format: str, picked: list[int]
) -> None:
    dataset = read_dataset(shared_data(name))
    assert dataset.format == format
    views = [dataset.views[i] for i in picked]
    if name == "lego_400":  # photographs have no transparent pixels: show the object on grey
        views = [on_grey(view, tmp_path) for view in views]
    matches = find_matches(views, tmp_path / "work")
    assert epipolar_error(views, matches) < 1.5
    # The test can fail: world-to-camera taken for camera-to-world is off by far.
    wrong = [replace(view, camera_to_world=np.linalg.inv(view.camera_to_world)) for view in views]
    assert epipolar_error(wrong, matches) > 3


def on_grey(view: DatasetView, folder: Path) -> DatasetView:
    with Image.open(view.image) as image:
        flat = Image.new("RGB", image.size, (128, 128, 128))
        flat.paste(image, mask=image.getchannel("A"))
    path = folder / f"{view.name}.png"
    flat.save(path)
    return replace(view, image=path)


def test_upright_worlds(shared_data: Data) -> None:
    """After `world_from_sfm` the photographers stand upright: their cameras' up axes point to +z."""
    for name in ("fox", "lego_400", "replica_room", "fountain_p11"):
        dataset = read_dataset(shared_data(name))
        up = np.mean([dataset.world_from_sfm[:3, :3] @ -view.camera_to_world[:3, 1] for view in dataset.views], axis=0)
        assert up[2] > 0.5, name


def test_turned_photos_of_the_temple_are_noticed(shared_data: Data) -> None:
    dataset = read_dataset(shared_data("temple_ring"))
    assert any("upside down" in warning for warning in dataset.warnings)
    # They lie on their side, too: the world has the ring of cameras level, a little above the subject.
    centres = np.stack([(dataset.world_from_sfm @ view.camera_to_world)[:3, 3] for view in dataset.views])
    ahead = np.stack([dataset.world_from_sfm[:3, :3] @ view.camera_to_world[:3, 2] for view in dataset.views])
    assert np.ptp(centres[:, 2]) < 0.1 * np.ptp(centres[:, 0])
    assert -0.2 < ahead[:, 2].max() < 0


# --- formats written by the test ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def truth(shared_data: Data, tmp_path_factory: pytest.TempPathFactory) -> tuple[list[DatasetView], Matches]:
    """Six views of the fountain with a distorted, off-centre lens, shown by warped photos, and matches between them."""
    views = read_dataset(shared_data("fountain_p11")).views[3:9]
    folder = tmp_path_factory.mktemp("truth")
    bent = [bend(view, folder) for view in views]
    return bent, find_matches(bent, folder / "work")


WITH_LENS = {
    "instant-ngp": (lambda v, f: write_transforms(v, f, "instant-ngp"), "transforms"),
    "nerfstudio": (lambda v, f: write_transforms(v, f, "nerfstudio"), "transforms"),
    "colmap text": (write_colmap_text, "colmap"),
    "colmap binary with rigs": (write_colmap_binary, "colmap"),
    "metashape": (write_metashape, "metashape"),
    "metashape geographic": (lambda v, f: write_metashape(v, f, True), "metashape"),
    "realityscan": (write_realityscan, "realityscan"),
    "meshroom": (write_meshroom, "meshroom"),
}


@pytest.mark.parametrize("name", list(WITH_LENS))
def test_formats_with_distortion(name: str, truth: tuple[list[DatasetView], Matches], tmp_path: Path) -> None:
    views, matches = truth
    folder = tmp_path / "Datensatz mit Leerzeichen"
    folder.mkdir()
    write, format = WITH_LENS[name]
    write(views, folder)
    dataset = read_dataset(folder)
    assert dataset.format == format
    assert [view.name for view in dataset.views] == [view.name for view in views]
    assert epipolar_error(dataset.views, matches) < 0.6
    for read, true in zip(dataset.views, views):
        assert np.allclose(read.camera_to_world, true.camera_to_world, atol=1e-6)
        assert read.camera.model == "OPENCV"
        values = [read.camera.fx, read.camera.fy, read.camera.cx, read.camera.cy, *read.camera.distortion]
        assert values == pytest.approx([905, 902, 493, 337, -0.3, 0.08, 0.002, -0.003], abs=1e-6)
    # The test can fail: without the distortion the matches miss their lines.
    plain = [replace(view, camera=view.camera.undistorted()) for view in dataset.views]
    assert epipolar_error(plain, matches) > 3 * epipolar_error(dataset.views, matches)
    if name == "nerfstudio":
        assert [view.split for view in dataset.views] == ["auto", "test", *["auto"] * 4]
    if name.startswith("colmap"):
        assert dataset.points.xyz.tolist() == [[1.5, 2.5, 3.5]]
        assert dataset.points.rgb.tolist() == [[10, 20, 30]]
    if name == "metashape geographic":
        assert dataset.scale_known
        centres = np.stack([view.camera_to_world[:3, 3] for view in dataset.views])
        world = transform_points(dataset.world_from_sfm, centres)
        assert np.abs(world).max() < 100  # near the origin, not at the centre of the earth
        ratio = np.linalg.norm(np.ptp(world, axis=0)) / np.linalg.norm(np.ptp(centres, axis=0))
        assert 2 < ratio < 3
        # The plumb line is up, not the way from the middle of the flattened earth, from which it is 0.19° off.
        away = np.array([4.0, 0.8, 4.9 / (1 - 1 / 298.257223563) ** 2])
        assert np.allclose(dataset.world_from_sfm[:3, :3] @ away / np.linalg.norm(away) / 2.5, [0, 0, 1], atol=1e-4)


def test_photos_of_two_folders_keep_their_labels_apart(tmp_path: Path) -> None:
    """`left/0001` and `right/0001` of a rig."""
    matrix = " ".join(map(str, np.eye(4).ravel()))
    size = '<resolution width="8" height="6"/>'
    cameras = ""
    for side in ("left", "right"):
        for kind, value in (("", 90), ("labels", 1 if side == "left" else 2), ("masks", 255)):
            (tmp_path / kind / side).mkdir(parents=True)
            Image.new("L" if kind else "RGB", (8, 6), value if kind else (value,) * 3).save(
                tmp_path / kind / side / "0001.png"
            )
        cameras += (
            f'<camera id="{len(cameras)}" sensor_id="0" label="{side}/0001"><transform>{matrix}</transform></camera>'
        )
    export = (
        f'<document version="1.5.0"><chunk><sensors><sensor id="0" type="frame">{size}<calibration type="frame">{size}'
        "<f>10</f></calibration></sensor></sensors><cameras>{}</cameras></chunk></document>"
    )
    (tmp_path / "cameras.xml").write_text(export.format(cameras))
    dataset = read_dataset(tmp_path)
    assert [view.name for view in dataset.views] == ["left_0001", "right_0001"]
    for view, side in zip(dataset.views, ("left", "right")):
        assert view.image == tmp_path / side / "0001.png"
        assert view.label == tmp_path / "labels" / side / "0001.png"
        assert view.mask == tmp_path / "masks" / side / "0001.png"
    # Without folders nobody knows whose pose is whose.
    (tmp_path / "cameras.xml").write_text(export.format(cameras.replace("right/", "left/")))
    with pytest.raises(InputError, match="two cameras that are called left/0001"):
        read_dataset(tmp_path)


WITHOUT_LENS = {"scannet": write_scannet, "replica": write_replica, "dtu": write_dtu, "llff": write_llff}


@pytest.mark.parametrize("name", list(WITHOUT_LENS))
def test_formats_of_pinhole_cameras(name: str, truth: tuple[list[DatasetView], Matches], tmp_path: Path) -> None:
    """Poses and the position of the principal point, compared with what was written."""
    views, _ = truth
    WITHOUT_LENS[name](views, tmp_path)
    folder = tmp_path / "office" if name == "replica" else tmp_path
    dataset = read_dataset(folder)
    assert dataset.format == name
    kept = views[:-1] if name == "scannet" else views  # its last pose is not finite
    assert len(dataset.views) == len(kept)
    for read, true in zip(dataset.views, kept):
        assert np.allclose(read.camera_to_world, true.camera_to_world, atol=1e-6)
        expected = (905, 905, 500, 330) if name == "llff" else (905, 902, 493, 337)
        assert (read.camera.fx, read.camera.fy, read.camera.cx, read.camera.cy) == pytest.approx(expected)
    if name == "dtu":
        corner = np.linalg.inv(dataset.world_from_sfm) @ [*dataset.bounds.mean(0), 1]
        assert np.allclose(corner[:3], [1, 2, 3], atol=1e-6)
    if name == "scannet":
        result = import_dataset(ImportParams(dataset=folder, project=tmp_path / "p"), Reporter())
        assert result["labelled"] == 5
        assert result["classes"] == ["class 3"]
        view = load_scene(tmp_path / "p").views[0]
        depth = oiio.ImageBuf(str(view.depth)).get_pixels(oiio.FLOAT)
        assert depth[100, 100, 0] == pytest.approx(2.5)
        assert depth[0, 0, 0] == 0
    if name == "replica":
        assert dataset.views[0].depth_scale * 13107 == pytest.approx(2.0)


# --- importing ------------------------------------------------------------------------------------------------------


def test_lego_import(shared_data: Data, tmp_path: Path) -> None:
    folder = tmp_path / "Projekt ü"
    result = import_dataset(ImportParams(dataset=shared_data("lego_400"), project=folder), Reporter())
    assert result == {"format": "transforms", "images": 140, "labelled": 0, "classes": []}
    scene = load_scene(folder)
    assert (len(scene.train), len(scene.test)) == (100, 40)
    train = {scene.views[i].name for i in scene.train}
    assert {"train_r_0", "train_r_99"} <= train
    assert not train & {scene.views[i].name for i in scene.test}
    with Image.open(scene.views[0].image) as image:
        assert image.mode == "RGBA"
        assert image.size == (400, 400)
    # Importing the same set again is fine, another one into the same folder is not.
    import_dataset(ImportParams(dataset=shared_data("lego_400"), project=folder), Reporter())
    with pytest.raises(ProjectError, match="already holds another capture"):
        import_dataset(ImportParams(dataset=shared_data("fox"), project=folder), Reporter())


def test_replica_room_import(shared_data: Data, tmp_path: Path) -> None:
    result = import_dataset(ImportParams(dataset=shared_data("replica_room"), project=tmp_path / "p"), Reporter())
    assert (result["images"], result["labelled"]) == (100, 100)
    assert "wall" in result["classes"]
    project_ = load_project(tmp_path / "p")
    assert project_.ignore_id == 0
    assert 0 not in {c.id for c in project_.classes}
    assert len({c.color for c in project_.classes}) == len(project_.classes)
    assert project_.frame.scale_known
    record = project_.images[0]
    with (
        Image.open(tmp_path / "p" / record.label) as copy,
        Image.open(shared_data("replica_room") / "labels_class" / Path(record.source).name) as original,
    ):
        assert np.array_equal(np.asarray(copy), np.asarray(original))


def test_sparse_points_come_along(truth: tuple[list[DatasetView], Matches], tmp_path: Path) -> None:
    write_colmap_binary(truth[0], tmp_path / "set")
    import_dataset(ImportParams(dataset=tmp_path / "set", project=tmp_path / "p", format="colmap"), Reporter())
    scene = load_scene(tmp_path / "p")
    frame = np.array(load_project(tmp_path / "p").frame.world_from_sfm)
    assert np.allclose(scene.points.xyz, transform_points(frame, np.array([[1.5, 2.5, 3.5]])))


def test_panoramas_of_metashape_are_imported(tmp_path: Path) -> None:
    """Its spherical sensors have no calibration."""
    folder = tmp_path / "set"
    folder.mkdir()
    cameras = ""
    for number in range(3):
        Image.new("RGB", (200, 100), (90, 80, 70)).save(folder / f"p{number}.png")
        matrix = np.eye(4)
        matrix[0, 3] = number
        pose = " ".join(map(str, matrix.ravel()))
        cameras += f'<camera id="{number}" sensor_id="0" label="p{number}"><transform>{pose}</transform></camera>'
    (folder / "cameras.xml").write_text(
        '<document version="1.5.0"><chunk label="Chunk 1"><sensors><sensor id="0" type="spherical">'
        f'<resolution width="200" height="100"/></sensor></sensors><cameras>{cameras}</cameras></chunk></document>'
    )
    import_dataset(ImportParams(dataset=folder, project=tmp_path / "p"), Reporter())
    camera = load_scene(tmp_path / "p").views[0].camera
    assert (camera.model, camera.width, camera.height) == ("EQUIRECTANGULAR", 200, 100)
    assert camera.undistorted().fx == 100, "an orbit sees 90° of it"


def test_rotated_photo_keeps_the_pixels_its_pose_is_for(shared_data: Data, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    photo = Image.fromarray(np.random.default_rng(0).integers(0, 255, (60, 90, 3), np.uint8))
    exif = Image.Exif()
    exif[0x0112] = 6
    photo.save(folder / "a.png", exif=exif)
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), "fl_x": 80}
    (folder / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    import_dataset(ImportParams(dataset=folder, project=tmp_path / "p"), Reporter())
    with Image.open(load_scene(tmp_path / "p").views[0].image) as copy:
        assert copy.getexif().get(0x0112, 1) == 1
        assert np.array_equal(np.asarray(copy), np.asarray(photo))


# --- damage ---------------------------------------------------------------------------------------------------------


def test_video_with_poses(shared_data: Data, tmp_path: Path) -> None:
    """71 poses of a video of 706 frames: every tenth. One frame off would miss the epipolar lines by 20 pixels."""
    dataset = read_dataset(shared_data("can_video"))
    assert len(dataset.views) == 71
    assert any("every 10th frame" in warning for warning in dataset.warnings)
    views = dataset.views[20:41:4]
    assert epipolar_error(views, find_matches(views, tmp_path / "work")) < 1.5


DAMAGE: list[tuple[str, Callable[[list[DatasetView], Path], None], str, Callable[[bytes], bytes]]] = [
    ("transforms cut", WITH_LENS["instant-ngp"][0], "transforms.json", lambda data: data[: len(data) // 2]),
    ("transforms without frames", WITH_LENS["instant-ngp"][0], "transforms.json", lambda data: b"{}"),
    ("transforms without focal", WITH_LENS["instant-ngp"][0], "transforms.json", lambda d: d.replace(b"fl_x", b"f")),
    ("transforms with odd pose", WITH_LENS["instant-ngp"][0], "transforms.json", lambda d: d.replace(b"[[", b"[[9,")),
    ("colmap binary cut", write_colmap_binary, "sparse/0/images.bin", lambda data: data[: len(data) // 2]),
    ("colmap points cut", write_colmap_binary, "sparse/0/points3D.bin", lambda data: data[:-5]),
    ("colmap text cut", write_colmap_text, "sparse/0/images.txt", lambda data: data[:60]),
    ("colmap odd model", write_colmap_text, "sparse/0/cameras.txt", lambda d: d.replace(b"OPENCV", b"FOV")),
    ("metashape cut", write_metashape, "cameras.xml", lambda data: data[: len(data) // 2]),
    ("metashape k4", write_metashape, "cameras.xml", lambda d: d.replace(b"<p1>", b"<k4>0.1</k4><p1>")),
    ("meshroom cut", write_meshroom, "cameras.sfm", lambda data: data[: len(data) // 2]),
    ("meshroom lens", write_meshroom, "cameras.sfm", lambda d: d.replace(b'"brown"', b'"3deanamorphic4"')),
    ("dtu cut", write_dtu, "cameras.npz", lambda data: data[: len(data) // 2]),
    ("llff cut", write_llff, "poses_bounds.npy", lambda data: data[: len(data) // 2]),
    ("replica cut", write_replica, "office/traj.txt", lambda data: data[: len(data) // 2 + 7]),
    ("scannet matrix", write_scannet, "intrinsic/intrinsic_color.txt", lambda data: b"1 2\n3\n"),
]


@pytest.mark.parametrize(("what", "write", "file", "damage"), DAMAGE, ids=[entry[0] for entry in DAMAGE])
def test_damaged_files_are_named(
    what: str,
    write: Callable[[list[DatasetView], Path], None],
    file: str,
    damage: Callable[[bytes], bytes],
    truth: tuple[list[DatasetView], Matches],
    tmp_path: Path,
) -> None:
    write(truth[0], tmp_path)
    path = tmp_path / file
    path.write_bytes(damage(path.read_bytes()))
    format = WITH_LENS.get(what, (None, what.split()[0]))[1]
    folder = tmp_path / "office" if format == "replica" else tmp_path
    with pytest.raises(FieldworkError) as caught:
        read_dataset(folder, format)
    assert len(str(caught.value)) > 20
    assert not isinstance(caught.value, AssertionError)


def test_truncated_photo_is_named(truth: tuple[list[DatasetView], Matches], tmp_path: Path) -> None:
    """Its header is whole: reading the data set finds nothing wrong."""
    write_transforms(truth[0], tmp_path, "instant-ngp")
    path = tmp_path / "images" / truth[0][2].image.name
    whole = path.read_bytes()
    path.unlink()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=rf"{path.name} cannot be used.*truncated"):
        import_dataset(ImportParams(dataset=tmp_path, project=tmp_path / "p"), Reporter())
    path.write_bytes(whole)
    assert import_dataset(ImportParams(dataset=tmp_path, project=tmp_path / "p"), Reporter())["images"] == 6


def test_nerfstudio_masks_depth_and_lenses_of_their_own(tmp_path: Path) -> None:
    """Each frame has its own size and lens, a mask and a depth map: in millimetres, or as EXR in the poses' units."""
    folder = tmp_path / "set"
    (folder / "images").mkdir(parents=True)
    frames = []
    for i, (width, height) in enumerate([(90, 60), (60, 90), (80, 80)]):
        pixels = np.random.default_rng(i).integers(0, 255, (height, width, 3), np.uint8)
        Image.fromarray(pixels).save(folder / "images" / f"{i}.png")
        Image.fromarray(np.pad(np.full((height - 20, width), 255, np.uint8), ((20, 0), (0, 0)))).save(
            folder / f"mask_{i}.png"
        )
        depth_file = f"depth_{i}.exr" if i == 2 else f"depth_{i}.png"
        if i == 2:
            write_depth(folder / depth_file, np.full((height, width), 1.502, np.float32))
        else:
            Image.fromarray(np.full((height, width), 1500 + i, np.uint16)).save(folder / depth_file)
        pose = np.eye(4)
        pose[0, 3] = i
        frames.append(
            {
                "file_path": f"images/{i}.png", "mask_path": f"mask_{i}.png", "depth_file_path": depth_file,
                "transform_matrix": pose.tolist(), "w": width, "h": height, "fl_x": 70 + i, "fl_y": 71 + i,
                "cx": width / 2 + i, "cy": height / 2, "k1": 0.01 * i,
            }
        )  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}))
    import_dataset(ImportParams(dataset=folder, project=tmp_path / "p"), Reporter())
    scene = load_scene(tmp_path / "p")
    for i, view in enumerate(scene.views):
        camera = view.camera
        size = frames[i]["w"], frames[i]["h"]
        assert (camera.width, camera.height, camera.fx, camera.fy) == (*size, 70 + i, 71 + i)
        assert camera.cx == pytest.approx(size[0] / 2 + i)
        assert (camera.distortion[0] if camera.distortion else 0) == pytest.approx(0.01 * i)
        with Image.open(view.mask) as mask:
            assert mask.size == size
            assert np.asarray(mask)[:20].max() == 0 < np.asarray(mask)[20:].min()
        depth = oiio.ImageBuf(str(view.depth)).get_pixels(oiio.FLOAT)
        assert depth == pytest.approx(1.5 + i / 1000)


def test_missing_photos_are_counted(truth: tuple[list[DatasetView], Matches], tmp_path: Path) -> None:
    write_transforms(truth[0], tmp_path, "instant-ngp")
    (tmp_path / "images" / truth[0][2].image.name).unlink()
    dataset: Dataset = read_dataset(tmp_path)
    assert len(dataset.views) == 5
    assert any("1 images" in warning for warning in dataset.warnings)
    shutil.rmtree(tmp_path / "images")
    with pytest.raises(InputError, match="none of its images exists"):
        read_dataset(tmp_path)


def test_reading_needs_no_pycolmap(tmp_path: Path) -> None:
    """Readers run in the engine's main process, which must stay clear of pycolmap's libraries."""
    code = "import fieldwork.nerfcore.data.importer, fieldwork.nerfcore.poses.estimate, sys; print('pycolmap' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
