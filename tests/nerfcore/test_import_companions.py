"""What lies beside the photos of a posed data set and comes along with it: names of classes, labels, masks, points."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fieldwork.nerfcore.data.dataset import DatasetView
from fieldwork.nerfcore.data.importer import FORMATS, import_dataset, read_dataset
from fieldwork.nerfcore.errors import InputError
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.images.working import read_label
from fieldwork.nerfcore.params import ImportParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project
from fieldwork.tests.nerfcore.support import writers
from fieldwork.tests.nerfcore.support.ball import camera_poses
from PIL import Image

SIZE = (1000, 660)
CLASSES = {
    "ignore_id": 255,
    "classes": {"0": {"name": "stone", "color": [200, 10, 10]}, "7": {"name": "wood", "color": [10, 200, 10]}},
}
COLORS = [(200, 10, 10), (10, 200, 10), (0, 0, 0)]  # of columns of each label map; the last is unlabelled


def strecha(views: list[DatasetView], folder: Path) -> None:
    writers.link_images(views, folder)
    for view in views:
        c, pose = view.camera, view.camera_to_world
        rows = [[c.fx, 0, c.cx - 0.5], [0, c.fy, c.cy - 0.5], [0, 0, 1], [0, 0, 0], *pose[:3, :3], pose[:3, 3], SIZE]
        text = "\n".join(" ".join(map(str, row)) for row in rows)
        (folder / f"{view.image.name}.camera").write_text(text)


def middlebury(views: list[DatasetView], folder: Path) -> None:
    writers.link_images(views, folder)
    lines = [str(len(views))]
    for view in views:
        c, w2c = view.camera, np.linalg.inv(view.camera_to_world)
        k = [c.fx, 0, c.cx - 0.5, 0, c.fy, c.cy - 0.5, 0, 0, 1]
        lines.append(f"{view.image.name} {' '.join(map(str, [*k, *w2c[:3, :3].ravel(), *w2c[:3, 3]]))}")
    (folder / "set_par.txt").write_text("\n".join(lines))


WRITERS: dict[str, Callable[[list[DatasetView], Path], None]] = {
    "transforms": lambda views, folder: writers.write_transforms(views, folder, "instant-ngp"),
    "colmap": writers.write_colmap_text,
    "llff": writers.write_llff,
    "dtu": writers.write_dtu,
    "middlebury": middlebury,
    "strecha": strecha,
    "scannet": writers.write_scannet,
    "replica": writers.write_replica,
    "metashape": writers.write_metashape,
    "realityscan": writers.write_realityscan,
    "meshroom": writers.write_meshroom,
}


def photos(folder: Path) -> list[DatasetView]:
    """Three posed photos of nothing."""
    folder.mkdir()
    lens = Camera(
        model="OPENCV", width=1000, height=660, fx=905, fy=902, cx=493, cy=337, distortion=(-0.1, 0.02, 0.0, 0.0)
    )
    views = []
    for number, pose in enumerate(camera_poses(3)):
        path = folder / f"v{number}.png"
        Image.new("RGB", SIZE, (90 + number, 80, 70)).save(path)
        views.append(DatasetView(path.stem, path, lens, pose))
    return views


def coloured(path: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    columns = np.array(COLORS, np.uint8)[np.arange(SIZE[0]) * 3 // SIZE[0]]
    Image.fromarray(np.broadcast_to(columns, (*SIZE[::-1], 3))).save(path)


def bring(source: Path, project: Path, **settings: Any) -> list[str]:
    """Import a data set; what was warned of."""
    report = Reporter()
    import_dataset(ImportParams(dataset=source, project=project, **settings), report)
    return report.warnings


@pytest.mark.parametrize("name", FORMATS)
def test_classes_are_named_in_every_format(tmp_path: Path, name: str) -> None:
    WRITERS[name](photos(tmp_path / "photos"), tmp_path / "set")
    folder = tmp_path / "set" / ("office" if name == "replica" else "")
    for number in range(3):
        stem = f"frame{number:06d}" if name == "replica" else f"v{number}"
        coloured(folder / ("label-filt" if name == "scannet" else "labels") / f"{stem}.png")
    (folder / "classes.json").write_text(json.dumps(CLASSES))
    bring(folder, tmp_path / "p", format=name)
    project = load_project(tmp_path / "p")
    assert project.ignore_id == 255
    assert [(c.id, c.name) for c in project.classes] == [(0, "stone"), (7, "wood")]
    assert [tuple(round(part * 255) for part in c.color) for c in project.classes] == COLORS[:2]
    for record in project.images:
        ids = read_label(tmp_path / "p" / str(record.label))
        assert ids[0, [0, SIZE[0] // 2, -1]].tolist() == [0, 7, 255]


def test_a_classes_file_lies_with_the_labels_or_is_given(tmp_path: Path) -> None:
    folder = writers.data_set(tmp_path / "d", {"aabb_scale": 1})
    (folder / "labels").mkdir()
    Image.new("RGB", (320, 200), COLORS[1]).save(folder / "labels" / "f0.png")
    with pytest.raises(InputError, match="--classes"):
        bring(folder, tmp_path / "p")
    given = tmp_path / "names.json"
    given.write_text(json.dumps(CLASSES))
    bring(folder, tmp_path / "p", classes=given)
    assert [(c.id, c.name) for c in load_project(tmp_path / "p").classes] == [(7, "wood")]
    (folder / "labels" / "classes.json").write_text(json.dumps(CLASSES))
    bring(folder, tmp_path / "q")
    assert [(c.id, c.name) for c in load_project(tmp_path / "q").classes] == [(7, "wood")]
    (folder / "labels" / "classes.json").write_text("{")
    with pytest.raises(InputError, match="found by itself"):
        read_dataset(folder)
    assert read_dataset(folder, classes=given).ignore_id == 255, "what is given goes before what is found"


def test_a_model_brings_what_lies_with_its_photos(tmp_path: Path) -> None:
    """Where the folder of the model itself is given."""
    folder = tmp_path / "set"
    writers.write_colmap_text(photos(tmp_path / "photos"), folder)
    coloured(folder / "labels" / "v1.png")
    (folder / "masks").mkdir()
    Image.new("L", SIZE, 255).save(folder / "masks" / "v2_mask.png")
    (folder / "classes.json").write_text(json.dumps(CLASSES))
    whole, model = read_dataset(folder), read_dataset(folder / "sparse" / "0")
    for read in (whole, model):
        assert [view.name for view in read.views] == ["v0", "v1", "v2"]
        assert [view.label for view in read.views] == [None, folder / "labels" / "v1.png", None]
        assert [view.mask for view in read.views] == [None, None, folder / "masks" / "v2_mask.png"]
        assert read.class_names == {0: "stone", 7: "wood"}


def probabilities(path: Path) -> None:
    """That of class 1 is 0.8 in the left half, that of class 2 0.6 in the right one."""
    values = np.zeros((200, 320, 3), np.float32)
    values[:, :160, 1], values[:, 160:, 2] = 0.8, 0.6
    np.save(path, values)


def test_probability_maps_come_with_their_confidence(tmp_path: Path) -> None:
    folder = writers.data_set(tmp_path / "d", {"aabb_scale": 1}, count=5)
    (folder / "labels" / "confidence").mkdir(parents=True)
    np.save(folder / "labels" / "f4.npy", np.ones((200, 320), np.uint8))  # class ids, with no picture beside them
    probabilities(folder / "labels" / "f0.npy")
    probabilities(folder / "labels" / "f1.npy")
    for name in ("f1", "f2", "f3"):
        Image.new("L", (320, 200), 1).save(folder / "labels" / f"{name}.png")
    np.save(folder / "labels" / "f2.npy", np.ones((200, 320)))
    Image.new("L", (320, 200), 51).save(folder / "labels" / "confidence" / "f3.png")
    (warning,) = bring(folder, tmp_path / "p")
    assert "2 files among label maps are not used" in warning
    assert "f2.npy" in warning
    assert "f4.npy" in warning
    records = {record.name: record for record in load_project(tmp_path / "p").images}
    for name in ("f0", "f1"):
        assert read_label(tmp_path / "p" / str(records[name].label))[0, [0, -1]].tolist() == [1, 2]
        assert read_label(tmp_path / "p" / str(records[name].confidence))[0, [0, -1]].tolist() == [204, 153]
    assert records["f2"].confidence is None
    assert np.unique(read_label(tmp_path / "p" / str(records["f3"].confidence))).tolist() == [51]


def test_files_that_a_data_set_names_and_lacks_are_told(tmp_path: Path) -> None:
    folder = writers.data_set(
        tmp_path / "d",
        {"aabb_scale": 1, "ply_file_path": "gone.ply"},
        mask_path="masks/m.png",
        semantic_path="labels/l.png",
        depth_file_path="depth/d.exr",
    )
    said = read_dataset(folder).warnings
    assert said == [
        "1 label maps named in transforms.json are missing (first: labels/l.png).",
        "1 masks named in transforms.json are missing (first: masks/m.png).",
        "1 depth maps named in transforms.json are missing (first: depth/d.exr).",
        "The points gone.ply are missing.",
    ]
    for kind in ("labels/l.png", "masks/m.png", "depth/d.exr", "gone.ply"):
        (folder / kind).parent.mkdir(exist_ok=True)
        (folder / kind).touch()
    (folder / "gone.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    assert read_dataset(folder).warnings == []


@pytest.mark.parametrize("name", ["strecha", "realityscan", "scannet"])
def test_photos_and_poses_that_are_missing_are_told(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "set"
    WRITERS[name](photos(tmp_path / "photos"), folder)
    told = len(read_dataset(folder).warnings)
    (folder / ("pose/v0.txt" if name == "scannet" else "v0.png")).unlink()
    *_, warning = read_dataset(folder).warnings
    assert "v0" in warning
    assert "missing" in warning
    assert len(read_dataset(folder).warnings) == told + 1


def test_points_of_another_format_are_left_out(tmp_path: Path) -> None:
    folder = writers.data_set(tmp_path / "d", {"aabb_scale": 1, "ply_file_path": "c.pcd"})
    (folder / "c.pcd").write_text("# .PCD v0.7\n")
    dataset = read_dataset(folder)
    assert len(dataset.points.xyz) == 0
    assert dataset.warnings == ["The points c.pcd are not read: only PLY files are."]


@pytest.mark.parametrize(
    ("convention", "known"),
    [("OpenGL axes, z up, metres", True), ("Meters", True), ("z up, millimetres", False), ("centimeters", False)],
)
def test_only_metres_are_metres(tmp_path: Path, convention: str, known: bool) -> None:
    folder = writers.data_set(tmp_path / "d", {"aabb_scale": 1, "camera_convention": convention})
    assert read_dataset(folder).scale_known == known
