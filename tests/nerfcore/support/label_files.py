"""Files of labels as other tools write them, the same two areas of one picture in each, and bringing them into projects."""

from __future__ import annotations

import base64
import io
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from fieldwork.nerfcore.images.working import read_label
from fieldwork.nerfcore.labels.exchange import import_labels
from fieldwork.nerfcore.labels.formats import label_studio
from fieldwork.nerfcore.params import LabelImportParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project, save_project
from fieldwork.tests.nerfcore.support.ball import ball_project
from PIL import Image

WIDTH, HEIGHT = 7, 5
RING = np.zeros((HEIGHT, WIDTH), bool)
RING[1:4, 2:5] = True
RING[2, 3] = False
CORNER = np.zeros((HEIGHT, WIDTH), bool)
CORNER[0:2, 0:2] = True


def png(values: np.ndarray) -> bytes:
    out = io.BytesIO()
    Image.fromarray(values).save(out, "PNG")
    return out.getvalue()


# The compressed run lengths are what pycocotools 2.0.11 makes of the ring.
COCO = {
    "info": {"description": "", "version": "1.0", "year": 2024},
    "licenses": [{"id": 1, "name": "", "url": ""}],
    "images": [
        {"id": 4, "file_name": "train/a.jpg", "width": WIDTH, "height": HEIGHT, "license": 1, "coco_url": ""},
        {"id": 9, "file_name": "stranger.jpg", "width": 3, "height": 3},
    ],
    "annotations": [
        {
            "id": 1,
            "image_id": 4,
            "category_id": 18,
            "segmentation": {"size": [HEIGHT, WIDTH], "counts": ";32NO0129"},
            "area": 8,
            "bbox": [2, 1, 3, 3],
            "iscrowd": 0,
        },
        {
            "id": 2,
            "image_id": 4,
            "category_id": 3,
            "segmentation": [[0.0, 0.0, 2.0, 0.0, 2.0, 2.0, 0.0, 2.0]],
            "area": 4,
            "bbox": [0, 0, 2, 2],
            "iscrowd": 0,
        },
        {"id": 3, "image_id": 4, "category_id": 3, "bbox": [0, 0, 2, 2], "area": 4, "iscrowd": 0, "segmentation": []},
        {
            "id": 4,
            "image_id": 9,
            "category_id": 3,
            "segmentation": [[0, 0, 1, 0, 1, 1]],
            "iscrowd": 0,
            "bbox": [0, 0, 1, 1],
        },
    ],
    "categories": [
        {"id": 3, "name": "stone", "supercategory": "material"},
        {"id": 18, "name": "wood", "supercategory": "material"},
    ],
}


def write_coco(folder: Path) -> Path:
    path = folder / "instances_default.json"
    path.write_text(json.dumps(COCO))
    return path


def write_panoptic(folder: Path) -> Path:
    ids = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    ids[RING], ids[CORNER] = (1, 2, 0), (7, 0, 1)  # 513 and 65543
    (folder / "panoptic_val").mkdir()
    Image.fromarray(ids).save(folder / "panoptic_val/a.png")
    segments = [{"id": 513, "category_id": 2, "iscrowd": 0}, {"id": 65543, "category_id": 1, "iscrowd": 0}]
    value = {
        "images": [{"id": 1, "file_name": "a.jpg", "width": WIDTH, "height": HEIGHT}],
        "annotations": [{"image_id": 1, "file_name": "a.png", "segments_info": segments}],
        "categories": [
            {"id": 1, "name": "stone", "isthing": 0, "color": [1, 2, 3]},
            {"id": 2, "name": "wood", "isthing": 1, "color": [255, 0, 51]},
        ],
    }
    path = folder / "panoptic_val.json"
    path.write_text(json.dumps(value))
    return path


CVAT = f"""<?xml version="1.0" encoding="utf-8"?>
<annotations>
  <version>1.1</version>
  <meta>
    <task>
      <id>12</id><name>vase</name><size>1</size><mode>annotation</mode><overlap>0</overlap>
      <labels>
        <label><name>stone</name><color>#010203</color><type>any</type><attributes></attributes></label>
        <label><name>wood</name><color>#ff0033</color><type>any</type><attributes></attributes></label>
      </labels>
    </task>
    <dumped>2024-05-01 10:00:00.000000+00:00</dumped>
  </meta>
  <image id="0" name="photos/a.jpg" width="{WIDTH}" height="{HEIGHT}">
    <mask label="wood" source="manual" occluded="0" rle="0, 4, 1, 4" left="2" top="1" width="3" height="3" z_order="1">
      <attribute name="worn">false</attribute>
    </mask>
    <polygon label="stone" source="manual" occluded="0" points="0.00,0.00;2.00,0.00;2.00,2.00;0.00,2.00" z_order="0"/>
    <polyline label="wood" source="manual" occluded="0" points="0.00,0.00;6.00,4.00" z_order="0"/>
  </image>
</annotations>
"""


def write_cvat(folder: Path) -> Path:
    path = folder / "annotations.xml"
    path.write_text(CVAT)
    return path


def write_cvat_zip(folder: Path) -> Path:
    path = folder / "task_vase.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("annotations.xml", CVAT)
        archive.writestr("images/a.jpg", b"")
    return path


# What the converter of Label Studio's SDK 2.1.2 makes of a mask of 6×4 with two rows of three pixels.
BRUSH = [0, 0, 0, 96, 57, 27, 254, 31, 0, 183, 255, 108, 2, 223, 254, 27, 0, 0]


def write_label_studio(folder: Path) -> Path:
    size = {"original_width": WIDTH, "original_height": HEIGHT, "image_rotation": 0}
    name = {"from_name": "tag", "to_name": "image", "origin": "manual"}
    percent = lambda x, y: [100 * x / WIDTH, 100 * y / HEIGHT]  # noqa: E731
    ring = np.repeat(RING.reshape(-1).astype(np.uint8) * 255, 4)
    corner = [percent(0, 0), percent(2, 0), percent(2, 2), percent(0, 2)]
    results = [
        {
            **size,
            **name,
            "id": "x1",
            "type": "brushlabels",
            "value": {"format": "rle", "rle": label_studio.packed(ring), "brushlabels": ["wood"]},
        },
        {
            **size,
            **name,
            "id": "x2",
            "type": "polygonlabels",
            "value": {"points": corner, "closed": True, "polygonlabels": ["stone"]},
        },
        {"id": "x3", "type": "choices", "from_name": "quality", "to_name": "image", "value": {"choices": ["good"]}},
    ]
    earlier = [
        {
            **size,
            **name,
            "id": "old",
            "type": "rectanglelabels",
            "value": {"x": 0, "y": 0, "width": 100, "height": 100, "rectanglelabels": ["wood"]},
        }
    ]
    task = {
        "id": 1,
        "data": {"image": "/data/upload/3/0a1b2c3d-a.jpg"},
        "annotations": [
            {"id": 1, "was_cancelled": False, "result": earlier},
            {"id": 2, "was_cancelled": False, "result": results},
            {"id": 3, "was_cancelled": True, "result": earlier},
        ],
        "predictions": [],
    }
    path = folder / "project-3-at-2024-05-01.json"
    path.write_text(json.dumps([task]))
    return path


def write_labelme(folder: Path) -> Path:
    patch = png(RING[1:4, 2:5].astype(np.uint8) * 255)
    shapes = [
        {
            "label": "wood",
            "points": [[2.0, 1.0], [4.0, 3.0]],
            "group_id": None,
            "description": "",
            "shape_type": "mask",
            "flags": {},
            "mask": base64.b64encode(patch).decode(),
        },
        {"label": "stone", "points": [[0.0, 0.0], [2.0, 2.0]], "group_id": 4, "shape_type": "rectangle", "flags": {}},
        {"label": "wood", "points": [[1.0, 1.0]], "group_id": None, "shape_type": "point", "flags": {}},
    ]
    value = {
        "version": "5.4.1",
        "flags": {},
        "shapes": shapes,
        "imagePath": "..\\photos\\a.jpg",
        "imageData": None,
        "imageHeight": HEIGHT,
        "imageWidth": WIDTH,
    }
    (folder / "a.json").write_text(json.dumps(value))
    return folder


def write_segments(folder: Path) -> Path:
    ids = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    ids[..., 3] = 255
    ids[RING, :3], ids[CORNER, :3] = (1, 0, 0), (0, 1, 0)  # 1 and 256
    Image.fromarray(ids).save(folder / "5e2b.png")
    address = "https://segmentsai-prod.s3.eu-west-2.amazonaws.com/assets/me/5e2b.png"
    label = {
        "label_status": "REVIEWED",
        "attributes": {
            "format_version": "0.1",
            "annotations": [{"id": 1, "category_id": 2}, {"id": 256, "category_id": 1}],
            "segmentation_bitmap": {"url": address},
        },
    }
    categories = [
        {"id": 1, "name": "stone", "color": [1, 2, 3], "has_instances": False},
        {"id": 2, "name": "wood", "color": [255, 0, 51], "has_instances": True},
    ]
    samples = [
        {"name": "a.jpg", "attributes": {"image": {"url": "https://…/a.jpg"}}, "labels": {"ground-truth": label}},
        {"name": "b.jpg", "attributes": {"image": {"url": "https://…/b.jpg"}}, "labels": {"ground-truth": None}},
    ]
    attributes = {"format_version": "0.1", "categories": categories}
    dataset = {"name": "vase", "task_type": "segmentation-bitmap", "task_attributes": attributes, "samples": samples}
    path = folder / "vase-v1.json"
    path.write_text(json.dumps({"name": "v1", "dataset": dataset}))
    return path


def write_supervisely(folder: Path) -> Path:
    classes = [
        {"title": "stone", "shape": "polygon", "color": "#010203", "id": 1},
        {"title": "wood", "shape": "bitmap", "color": "#FF0033", "id": 2},
    ]
    (folder / "meta.json").write_text(json.dumps({"classes": classes, "tags": []}))
    patch = Image.fromarray(RING[1:4, 2:5].astype(np.uint8)).convert("P")
    patch.putpalette([0, 0, 0, 255, 255, 255])
    out = io.BytesIO()
    patch.save(out, "PNG", transparency=0, bits=1)
    data = base64.b64encode(zlib.compress(out.getvalue())).decode()
    objects = [
        {"classTitle": "wood", "geometryType": "bitmap", "tags": [], "bitmap": {"data": data, "origin": [2, 1]}},
        {
            "classTitle": "stone",
            "geometryType": "polygon",
            "tags": [],
            "points": {"exterior": [[0, 0], [2, 0], [2, 2], [0, 2]], "interior": []},
        },
    ]
    value = {"description": "", "tags": [], "size": {"height": HEIGHT, "width": WIDTH}, "objects": objects}
    (folder / "ds0/ann").mkdir(parents=True)
    (folder / "ds0/img").mkdir()
    (folder / "ds0/ann/a.jpg.json").write_text(json.dumps(value))
    return folder


def write_colors(folder: Path) -> Path:
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    rgb[RING], rgb[CORNER] = (255, 0, 51), (1, 2, 3)
    Image.fromarray(rgb).save(folder / "a.png")
    table = {"1": {"name": "stone", "color": [1, 2, 3]}, "2": {"name": "wood", "color": [255, 0, 51]}}
    (folder / "classes.json").write_text(json.dumps({"ignore_id": 0, "classes": table}))
    return folder


WRITTEN = {
    "coco": write_coco,
    "panoptic": write_panoptic,
    "cvat": write_cvat,
    "cvat zip": write_cvat_zip,
    "label studio": write_label_studio,
    "labelme": write_labelme,
    "segments": write_segments,
    "supervisely": write_supervisely,
    "colors": write_colors,
}


def project_of(folder: Path, names: list[str], size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    """A project with photos of these names, without classes and labels."""
    ball_project(folder, views=len(names), side=8)
    project = load_project(folder)
    project.classes = []
    for image, name in zip(project.images, names):
        image.name, image.label, (image.width, image.height) = name, None, size
        image.file = f"images/{name}.jpg"
    save_project(folder, project)
    return folder


def bring(folder: Path, file: Path, **values: Any) -> tuple[dict[str, Any], Reporter]:
    report = Reporter()
    return import_labels(LabelImportParams.model_validate({"project": folder, "file": file, **values}), report), report


def named_map(folder: Path, photo: str) -> np.ndarray:
    """The label map of a photo with the names of the classes, "" for unlabelled."""
    project = load_project(folder)
    label = next(image.label for image in project.images if image.name == photo)
    assert label is not None
    names = {project.ignore_id: "", **{c.id: c.name for c in project.classes}}
    return np.vectorize(names.__getitem__)(read_label(folder / label))
