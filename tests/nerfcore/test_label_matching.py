"""Which photo the pictures of another labelling tool are matched with, and imports that fail."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.errors import InputError
from fieldwork.nerfcore.images.names import unique_names
from fieldwork.nerfcore.project.store import edit_project, load_project
from fieldwork.tests.nerfcore.support.label_files import HEIGHT, WIDTH, bring, named_map, project_of
from PIL import Image


def placed(folder: Path, places: list[str]) -> Path:
    """A project with photos from such places, called as `new` calls them."""
    names = unique_names([Path("photos") / place for place in places], Path("photos"))
    project_of(folder, names)
    with edit_project(folder) as project:
        for image, place in zip(project.images, places):
            image.source = f"photos/{place}"
    return folder


def coco_of(path: Path, places: list[str]) -> Path:
    """A file of pictures, each wholly of a class named like its place."""
    box = [0, 0, WIDTH, 0, WIDTH, HEIGHT, 0, HEIGHT]
    value = {
        "images": [{"id": i, "file_name": p, "width": WIDTH, "height": HEIGHT} for i, p in enumerate(places)],
        "categories": [{"id": i, "name": p} for i, p in enumerate(places)],
        "annotations": [
            {
                "id": i,
                "image_id": i,
                "category_id": i,
                "segmentation": [box],
                "bbox": [0, 0, WIDTH, HEIGHT],
                "iscrowd": 0,
            }
            for i in range(len(places))
        ],
    }
    path.write_text(json.dumps(value))
    return path


def labels_of(folder: Path) -> dict[str, str]:
    """The class of each photo that has labels."""
    return {i.name: str(named_map(folder, i.name)[0, 0]) for i in load_project(folder).images if i.label}


@pytest.mark.parametrize(
    ("photos", "pictures", "expected"),
    [
        (["left/0.jpg", "right/0.jpg"], ["left/0.jpg", "right/0.jpg"], {"left_0": "left/0.jpg", "right_0": "right/0.jpg"}),
        (["left/0.jpg", "right/0.jpg"], ["x/left/0.jpg"], {"left_0": "x/left/0.jpg"}),
        (["left/0.jpg", "0.jpg"], ["left/0.jpg", "0.jpg"], {"left_0": "left/0.jpg", "0": "0.jpg"}),
        (["left/0.jpg", "right/0.jpg"], ["0.jpg"], {}),
        (["left/0.jpg", "right/0.jpg", "left/1.jpg"], ["1.png"], {"left_1": "1.png"}),
        (["my photo 1.jpg"], ["my photo 1.jpg"], {"my_photo_1": "my photo 1.jpg"}),
        (["0.jpg"], ["left/0.jpg"], {"0": "left/0.jpg"}),
        (["0.jpg"], ["left/0.jpg", "right/0.jpg"], {}),
        (["0.jpg"], ["left/0.jpg", "0.jpg", "right/0.jpg"], {"0": "0.jpg"}),
        (["a.jpg", "a.png"], ["a.jpg", "a.png"], {"a_jpg": "a.jpg", "a_png": "a.png"}),
        (["shot.1.jpg"], ["shot.1.jpg"], {"shot.1": "shot.1.jpg"}),
        (["0.jpg"], ["0.jpg", "0.png"], {"0": "0.png"}),
    ],
)  # fmt: skip
def test_pictures_are_matched_by_their_whole_paths(
    tmp_path: Path, photos: list[str], pictures: list[str], expected: dict[str, str]
) -> None:
    folder = placed(tmp_path / "p", photos)
    path = coco_of(tmp_path / "given.json", pictures)
    if not expected:
        with pytest.raises(InputError, match="No picture in"):
            bring(folder, path)
        assert labels_of(folder) == {}
        assert not list((folder / "labels/imported").rglob("*.png"))
        return
    told, report = bring(folder, path)
    assert labels_of(folder) == expected
    assert told["photos"] == told["instances"] == len(expected)
    assert bool(report.warnings) == (len(pictures) > len(expected))
    if len(pictures) > len(expected):
        assert any(picture in " ".join(report.warnings) for picture in pictures)


def test_pictures_that_may_be_of_one_photo_are_told(tmp_path: Path) -> None:
    folder = placed(tmp_path / "p", ["0.jpg", "1.jpg"])
    told, report = bring(folder, coco_of(tmp_path / "given.json", ["left/0.jpg", "right/0.jpg", "1.jpg"]))
    assert labels_of(folder) == {"1": "1.jpg"}
    assert told["unknown"] == ["left/0.jpg", "right/0.jpg"]
    (warning,) = report.warnings
    assert "left/0.jpg, right/0.jpg may all be of the photo 0" in warning


def test_pictures_that_another_one_outdoes_are_told(tmp_path: Path) -> None:
    folder = placed(tmp_path / "p", ["0.jpg"])
    told, _ = bring(folder, coco_of(tmp_path / "given.json", ["left/0.jpg", "0.jpg", "right/0.jpg"]))
    assert labels_of(folder) == {"0": "0.jpg"}
    assert sorted(told["unknown"]) == ["left/0.jpg", "right/0.jpg"]


def test_an_import_that_fails_changes_no_label_map(tmp_path: Path) -> None:
    folder = project_of(tmp_path / "p", ["a", "b"])
    maps = tmp_path / "maps"
    maps.mkdir()
    for name in ("a", "b"):
        Image.fromarray(np.full((HEIGHT, WIDTH), 1, np.uint8)).save(maps / f"{name}.png")
    bring(folder, maps)
    before = {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()}
    Image.fromarray(np.full((HEIGHT, WIDTH), 2, np.uint8)).save(maps / "a.png")
    (maps / "b.png").write_bytes((maps / "b.png").read_bytes()[:40])
    with pytest.raises(InputError, match=r"b\.png cannot be read") as caught:
        bring(folder, maps, replace=True)
    assert "classes.json" not in caught.value.hint
    assert {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()} == before
