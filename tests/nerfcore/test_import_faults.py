"""Data sets that are not there or say too little, and imports that are killed."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from fieldwork.nerfcore.data.copying import copy_depth
from fieldwork.nerfcore.data.importer import FORMATS, import_dataset, read_dataset
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.errors import InputError
from fieldwork.nerfcore.params import ImportParams
from fieldwork.nerfcore.progress import Reporter
from PIL import Image

Data = Callable[[str], Path]


def test_video_whose_frames_cannot_be_told(shared_data: Data, tmp_path: Path) -> None:
    shutil.copy(shared_data("can_video") / "can.mp4", tmp_path)
    np.save(tmp_path / "poses_bounds.npy", np.load(shared_data("can_video") / "poses_bounds.npy")[:5])
    with pytest.raises(InputError, match=r"only can\.mp4.*fieldwork new"):
        read_dataset(tmp_path)


def test_unknown_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no posed data set"):
        read_dataset(tmp_path)
    with pytest.raises(InputError, match="does not exist"):
        read_dataset(tmp_path / "nowhere")


@pytest.mark.parametrize("format", FORMATS)
def test_asking_for_a_format_that_is_not_there(tmp_path: Path, format: str) -> None:
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path, format)
    assert str(tmp_path) in str(caught.value)


def test_import_killed_and_run_again(shared_data: Data, tmp_path: Path) -> None:
    dataset, project = shared_data("lego_400"), tmp_path / "p"
    code = (
        "from pathlib import Path; from fieldwork.nerfcore.data.importer import import_dataset\n"
        "from fieldwork.nerfcore.params import ImportParams; from fieldwork.nerfcore.progress import Reporter\n"
        f"import_dataset(ImportParams(dataset=Path({str(dataset)!r}), project=Path({str(project)!r})), Reporter())\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code])
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and len(list(project.glob("images/*.png"))) < 5:
        time.sleep(0.005)
    process.kill()
    process.wait()
    assert list(project.glob("images/*.png"))
    assert not (project / "project.json").exists()
    assert import_dataset(ImportParams(dataset=dataset, project=project), Reporter())["images"] == 140
    for view in load_scene(project).views:
        with Image.open(view.image) as image:
            image.load()


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e308])
def test_a_pose_that_is_no_place(tmp_path: Path, value: float) -> None:
    """It is told before the direction up is sought among all poses."""
    Image.new("RGB", (40, 30)).save(tmp_path / "a.png")
    pose = np.eye(4)
    pose[0, 3] = value
    frame = {"file_path": "a.png", "transform_matrix": pose.tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 40, "ply_file_path": "", "frames": [frame]}))
    with pytest.raises(InputError, match=r"pose of a .* is no rotation and position"):
        read_dataset(tmp_path)


def test_an_image_whose_camera_is_not_there(tmp_path: Path) -> None:
    Image.new("RGB", (40, 30)).save(tmp_path / "a.png")
    (tmp_path / "cameras.txt").write_text("7 PINHOLE 40 30 40 40 20 15\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    with pytest.raises(InputError, match=r"cameras\.txt is damaged: it lacks camera 1 of a\.png"):
        read_dataset(tmp_path)


def test_photos_that_a_model_does_not_place_are_named(tmp_path: Path) -> None:
    """They were not placed, or the model is cut short."""
    (tmp_path / "images").mkdir()
    for name in "abc":
        Image.new("RGB", (40, 30)).save(tmp_path / "images" / f"{name}.png")
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 40 30 40 40 20 15\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 0 0 1 1 b.png\n\n")
    (warning,) = read_dataset(tmp_path).warnings
    assert "1 photo has no pose" in warning
    assert "c.png" in warning


@pytest.mark.parametrize("format", ["transforms", "colmap"])
def test_a_photo_that_was_turned_after_its_pose_was_found(tmp_path: Path, format: str) -> None:
    """Its lens, stretched to the other proportions, would be that of no camera. Smaller photos are fine."""
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    lens = {"w": 40, "h": 30, "fl_x": 40, "cx": 20, "cy": 15}
    if format == "colmap":
        (tmp_path / "cameras.txt").write_text("1 PINHOLE 40 30 40 40 20 15\n")
        (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    else:
        (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": [frame]}))
    Image.new("RGB", (20, 15)).save(tmp_path / "a.png")
    assert read_dataset(tmp_path).views[0].camera.fx == 20
    Image.new("RGB", (30, 40)).save(tmp_path / "a.png")
    with pytest.raises(InputError, match=r"a\.png is 30×40 pixels, but its lens is that of 40×30: it was turned"):
        read_dataset(tmp_path)


def test_a_photo_that_was_exchanged_for_an_older_one(tmp_path: Path) -> None:
    """Its time says nothing about which of the two the copy is of."""
    source = tmp_path / "set" / "a.tif"
    source.parent.mkdir()
    frame = {"file_path": "a.tif", "transform_matrix": np.eye(4).tolist()}
    (source.parent / "transforms.json").write_text(json.dumps({"fl_x": 80, "frames": [frame]}))
    for color, seconds in (((200, 10, 10), 2000), ((10, 10, 200), 1000)):
        Image.new("RGB", (80, 60), color).save(source)
        os.utime(source, (seconds, seconds))
        import_dataset(ImportParams(dataset=source.parent, project=tmp_path / "p"), Reporter())
        with Image.open(load_scene(tmp_path / "p").views[0].image) as copy:
            assert copy.getpixel((0, 0)) == color


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_depth_maps_of_whole_numbers(tmp_path: Path, kind: type) -> None:
    Image.fromarray(np.full((30, 40), 150, kind)).save(tmp_path / "d.png")
    path = copy_depth(tmp_path / "d.png", tmp_path, "a", 0.01)
    assert oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT) == pytest.approx(1.5)


def test_names_of_colmap_keep_their_spaces(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    Image.new("RGB", (40, 30)).save(tmp_path / "images" / "left  wall 1.png")
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 40 30 40 40 20 15\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 left  wall 1.png\n\n")
    assert read_dataset(tmp_path).views[0].image.name == "left  wall 1.png"


@pytest.mark.parametrize(("p1", "known"), [(1e-4, True), (0.01, False)])
def test_fisheye_lenses_of_metashape_with_tangential_terms(tmp_path: Path, p1: float, known: bool) -> None:
    """Ours have none: terms that move pixels are refused, others do not matter."""
    Image.new("RGB", (40, 30)).save(tmp_path / "a.png")
    pose = " ".join(map(str, np.eye(4).ravel()))
    size = '<resolution width="40" height="30"/>'
    (tmp_path / "cameras.xml").write_text(
        f'<document version="1.5.0"><chunk><sensors><sensor id="0" type="fisheye">{size}<calibration type="fisheye">{size}'
        f"<f>15</f><k1>0.01</k1><p1>{p1}</p1></calibration></sensor></sensors><cameras>"
        f'<camera id="0" sensor_id="0" label="a"><transform>{pose}</transform></camera></cameras></chunk></document>'
    )
    if known:
        assert read_dataset(tmp_path).views[0].camera.model == "OPENCV_FISHEYE"
        return
    with pytest.raises(InputError, match="fits p1 and p2 of a fisheye lens"):
        read_dataset(tmp_path)


@pytest.mark.parametrize(("version", "fy"), [(["1", "2", "4"], 96.0), (["1", "2", "5"], 150.0)])
def test_upright_photos_of_meshroom(tmp_path: Path, version: list[str], fy: float) -> None:
    """Its sensors are as wide as their photos, also where those are higher; what its ratio is of has changed."""
    Image.new("RGB", (60, 90)).save(tmp_path / "a.png")
    lens = {
        "intrinsicId": "1",
        "width": "60",
        "height": "90",
        "sensorWidth": "24",
        "focalLength": "48",
        "type": "pinhole",
    }
    pose = {"rotation": [str(v) for v in np.eye(3).ravel()], "center": ["0", "0", "0"]}
    value = {
        "version": version,
        "views": [{"viewId": "1", "poseId": "1", "intrinsicId": "1", "path": "/gone/a.png"}],
        "intrinsics": [lens | {"pixelRatio": "1.25", "principalPoint": ["0", "0"]}],
        "poses": [{"poseId": "1", "pose": {"transform": pose}}],
    }
    (tmp_path / "cameras.sfm").write_text(json.dumps(value))
    camera = read_dataset(tmp_path).views[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (120, fy, 30, 45)


@pytest.mark.parametrize("said", [{"isPoseIndependant": "false"}, {}])
def test_photos_of_a_meshroom_rig_stand_where_its_cameras_do(tmp_path: Path, said: dict[str, str]) -> None:
    """Two cameras, the second 2 to the right of the first and turned by 90° about y; the rig twice, and a photo by itself."""
    turn, back = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.diag([-1.0, 1, -1])

    def pose(rotation: np.ndarray, center: list[float]) -> dict[str, list[str]]:
        """Columns of world-to-camera are rows of camera-to-world."""
        return {"rotation": [str(v) for v in rotation.ravel()], "center": [str(v) for v in center]}

    views = [
        {"poseId": str(i), "rigId": "9", "subPoseId": str(k), "path": f"/gone/{i}{k}.png", **said}
        for i in (1, 2)
        for k in (0, 1)
    ]
    views.append({"poseId": "3", "rigId": "9", "subPoseId": "1", "path": "/gone/30.png"})
    for view in views:
        Image.new("RGB", (60, 40)).save(tmp_path / Path(view["path"]).name)
    lens = {"intrinsicId": "1", "width": "60", "height": "40", "pxFocalLength": "50", "type": "pinhole"}
    ahead = np.eye(3)
    rig = {
        "rigId": "9",
        "subPoses": [{"status": "estimated", "pose": pose(r, c)} for r, c in ((ahead, [0, 0, 0]), (turn, [2, 0, 0]))],
    }
    poses = [pose(ahead, [0, 0, 0]), pose(back, [0, 0, 5]), pose(back, [7, 7, 7])]
    value = {
        "version": ["1", "2", "6"],
        "views": [{"viewId": str(i), "intrinsicId": "1", **view} for i, view in enumerate(views)],
        "intrinsics": [lens],
        "poses": [{"poseId": str(i), "pose": {"transform": p}} for i, p in enumerate(poses, 1)],
        "rigs": [rig],
    }
    (tmp_path / "cameras.sfm").write_text(json.dumps(value))
    found = {view.name: view.camera_to_world for view in read_dataset(tmp_path).views}
    expected = {
        "10": (ahead, [0, 0, 0]),
        "11": (turn, [2, 0, 0]),
        "20": (back, [0, 0, 5]),
        "21": (back @ turn, [-2, 0, 5]),
        "30": (back, [7, 7, 7]),
    }
    assert found.keys() == expected.keys()
    for name, (rotation, center) in expected.items():
        np.testing.assert_allclose(found[name][:3, :3], rotation, atol=1e-12)
        np.testing.assert_allclose(found[name][:3, 3], center, atol=1e-12)
    rig["subPoses"][1]["status"] = "uninitialized"
    (tmp_path / "cameras.sfm").write_text(json.dumps(value))
    rest = read_dataset(tmp_path)
    assert [view.name for view in rest.views] == ["10", "20", "30"]
    assert rest.warnings[0].endswith("and were not imported: 11.png; 21.png.")


@pytest.mark.parametrize("count", [3, 2])
def test_masks_of_dtu_that_are_not_used_are_told(tmp_path: Path, count: int) -> None:
    """They belong to the photos in their order, which one that is missing would shift."""
    projection = np.array([[50.0, 0, 20, 0], [0, 50, 15, 0], [0, 0, 1, 4], [0, 0, 0, 1]])
    np.savez(tmp_path / "cameras.npz", **{f"world_mat_{i}": projection for i in range(3)})
    for folder, names in (("image", 3), ("mask", count)):
        (tmp_path / folder).mkdir()
        for i in range(names):
            Image.new("RGB", (40, 30), (255, 255, 255)).save(tmp_path / folder / f"{i:03d}.png")
    dataset = read_dataset(tmp_path)
    assert all((view.mask is not None) == (count == 3) for view in dataset.views)
    assert any("2 masks for 3 photos" in text for text in dataset.warnings) == (count == 2)


def test_a_meshroom_file_with_numbers_for_photos_is_damaged(tmp_path: Path) -> None:
    value = {"views": [{"viewId": "1"}, 3], "intrinsics": [], "poses": []}
    (tmp_path / "cameras.sfm").write_text(json.dumps(value))
    with pytest.raises(InputError, match="is a damaged data set"):
        read_dataset(tmp_path)


XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description xcr:PrincipalPointU="{u}" xcr:AspectRatio="1"
xcr:FocalLength35mm="35"><xcr:Rotation>1 0 0 0 1 0 0 0 1</xcr:Rotation><xcr:Position>0 0 0</xcr:Position>
</rdf:Description></x:xmpmeta>"""
SENSOR = """<document><chunk><sensors><sensor id="0" type="frame"><resolution width="{u}" height="30"/>
<calibration><f>40</f></calibration></sensor></sensors><cameras><camera id="0" sensor_id="0" label="a">
<transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera></cameras></chunk></document>"""


@pytest.mark.parametrize(("metric", "names"), [("", ["b", "c"]), ("abc", ["a", "b", "c"]), ("a", ["a"])])
def test_components_of_realityscan_are_worlds_of_their_own(tmp_path: Path, metric: str, names: list[str]) -> None:
    for name, component in zip("abc", "122"):
        Image.new("RGB", (40, 30)).save(tmp_path / f"{name}.png")
        coordinates = "absolute" if name in metric else "relative"
        said = f'xcr:Coordinates="{coordinates}" xcr:ComponentId="{{{component}}}" xcr:AspectRatio'
        (tmp_path / f"{name}.xmp").write_text(XMP.format(u="0").replace("xcr:AspectRatio", said))
    dataset = read_dataset(tmp_path)
    assert [view.name for view in dataset.views] == names
    apart = "; ".join(name for name in "abc" if name not in names)
    assert [text.partition(":")[2] for text in dataset.warnings] == (
        [f" they are of other components, and nothing says how these lie to each other: {apart}."] if apart else []
    )


def test_photos_that_metashape_did_not_place_are_named(tmp_path: Path) -> None:
    """Nothing else says that some are left out, such as those of the further cameras of a rig; of ones that are off nobody asks."""
    Image.new("RGB", (40, 30)).save(tmp_path / "a.png")
    more = '<camera id="1" sensor_id="0" master_id="0" label="b"/><camera id="2" label="c" enabled="0"/></cameras>'
    (tmp_path / "cameras.xml").write_text(SENSOR.format(u=40).replace("</cameras>", more))
    (text,) = read_dataset(tmp_path).warnings
    assert text == f"1 photo has no pose in {tmp_path / 'cameras.xml'} and was not imported: b."


def test_photos_that_meshroom_did_not_place_are_named(tmp_path: Path) -> None:
    Image.new("RGB", (60, 40)).save(tmp_path / "a.png")
    pose = {"rotation": [str(v) for v in np.eye(3).ravel()], "center": ["0", "0", "0"]}
    value = {
        "views": [{"viewId": i, "poseId": i, "intrinsicId": "1", "path": rf"C:\gone\{i}.png"} for i in "abc"],
        "intrinsics": [{"intrinsicId": "1", "width": "60", "height": "40", "pxFocalLength": "50", "type": "pinhole"}],
        "poses": [{"poseId": "a", "pose": {"transform": pose}}],
    }
    (tmp_path / "cameras.sfm").write_text(json.dumps(value))
    (text,) = read_dataset(tmp_path).warnings
    assert text == f"2 photos have no pose in {tmp_path / 'cameras.sfm'} and were not imported: b.png; c.png."


@pytest.mark.parametrize(
    ("file", "text", "good", "bad"), [("a.xmp", XMP, "0", "0.1.2"), ("cameras.xml", SENSOR, "40", "0")]
)
def test_numbers_that_are_none(tmp_path: Path, file: str, text: str, good: str, bad: str) -> None:
    Image.new("RGB", (40, 30)).save(tmp_path / "a.png")
    (tmp_path / file).write_text(text.format(u=good))
    assert read_dataset(tmp_path).views[0].camera.cx == 20
    (tmp_path / file).write_text(text.format(u=bad))
    with pytest.raises(InputError, match="is a damaged data set"):
        read_dataset(tmp_path)
