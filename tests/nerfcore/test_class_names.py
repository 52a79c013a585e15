"""Where the classes file is found, what is wrong with it, and labels that it does not name."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.capture.ingest import ingested, new
from fieldwork.nerfcore.errors import InputError
from fieldwork.nerfcore.params import NewParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.classes import read_classes
from fieldwork.nerfcore.project.edit import read_class_values
from fieldwork.nerfcore.project.store import load_project
from fieldwork.tests.nerfcore.support.photos import folder_of
from PIL import Image

CLASSES = {"ignore_id": 0, "classes": {"1": "stone", "2": "wood"}}


def labelled(folder: Path, value: int = 1) -> Path:
    """Three photos with labels in a folder beside them; `value` is that of some pixels of the second one."""
    photos = folder_of(folder / "capture", 3)
    (photos / "labels").mkdir()
    for i in range(3):
        pixels = np.ones((200, 320), np.uint8)
        if i == 1:
            pixels[:10, :10] = value
        Image.fromarray(pixels).save(photos / "labels" / f"p{i}.png")
    return photos


@pytest.mark.parametrize("given", [True, False], ids=["labels given", "labels found"])
@pytest.mark.parametrize("where", ["labels/classes.json", "classes.json"])
def test_the_classes_file_is_found(tmp_path: Path, given: bool, where: str) -> None:
    photos = labelled(tmp_path)
    (photos / where).write_text(json.dumps(CLASSES))
    params = NewParams(photos=photos, project=tmp_path / "p", labels=photos / "labels" if given else None)
    report = Reporter()
    assert new(params, report)["classes"] == ["stone", "wood"]
    assert report.warnings == []
    (photos / where).write_text(json.dumps({"classes": {"1": "marble"}}))
    assert "classes file" in ingested(params).reason


@pytest.mark.parametrize("given", [True, False], ids=["labels given", "labels found"])
def test_a_malformed_classes_file_that_was_found_is_told(tmp_path: Path, given: bool) -> None:
    photos = labelled(tmp_path)
    (photos / "labels" / "classes.json").write_text("{")
    with pytest.raises(InputError, match=r"labels/classes\.json cannot be read.*found by itself"):
        new(
            NewParams(photos=photos, project=tmp_path / "p", labels=photos / "labels" if given else None),
            Reporter(),
        )


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('{"classes": {"1": "a", "1": "b"}}', "“1” occurs twice"),
        ('{"classes": {"1": "a", "01": "b"}}', "two classes have the id 1"),
        ('{"classes": [{"id": 1, "name": "a"}, {"id": 1, "name": "b"}]}', "two classes have the id 1"),
        ('{"classes": {"1": "a", "2": "a"}}', "two classes are called “a”"),
        ('["void", "a", " a"]', "two classes are called “a”"),
        ('{"classes": {"1": null}}', "no name"),
        ('{"classes": {"1": ""}}', "no name"),
        ('{"classes": {"1": 7}}', "no name"),
        ('{"classes": {"x": "a"}}', "x"),
        ('{"classes": {"1": {"name": "a", "color": [1, 2]}}}', "colour"),
        ('{"classes": {"1": {"name": "a", "color": [0.9, 0.5, 0.0]}}}', "the colour of a is not three whole numbers"),
        ('{"classes": {"1": {"name": "a", "color": [256, 0, 0]}}}', "from 0 to 255"),
        ('{"classes": {"70000": "a"}}', "0…65535"),
        ('{"ignore_id": "none", "classes": {"1": "a"}}', "none"),
        ("[" * 200_000, "nested"),
        ("7", "form"),
    ],
)
def test_classes_files_that_contradict_themselves(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "classes.json"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_classes(path)
    assert sentence in caught.value.message
    assert str(path) in caught.value.message


def test_void_may_be_named(tmp_path: Path) -> None:
    path = tmp_path / "classes.json"
    path.write_text('{"ignore_id": 0, "classes": {"0": "void", "1": "a"}}')
    assert read_classes(path)[0] == {1: "a"}


def test_a_value_without_a_class_is_told(tmp_path: Path) -> None:
    photos = labelled(tmp_path, value=77)
    (photos / "classes.json").write_text(json.dumps(CLASSES))
    report = Reporter()
    assert new(NewParams(photos=photos, project=tmp_path / "p"), report)["classes"] == ["stone", "wood", "class 77"]
    assert [c.id for c in load_project(tmp_path / "p").classes] == [1, 2, 77]
    (warning,) = report.warnings
    assert all(word in warning for word in ("p1.png", "77", "classes.json", "“class 77”"))


def test_without_a_classes_file_values_are_classes(tmp_path: Path) -> None:
    report = Reporter()
    photos = labelled(tmp_path, value=77)
    assert new(NewParams(photos=photos, project=tmp_path / "p"), report)["classes"] == ["class 1", "class 77"]
    assert report.warnings == []


@pytest.mark.parametrize(
    ("colors", "shown"),
    [
        ([[0.5, 0.25, 0.0], [1.0, 0.0, 0.0]], [(0.5, 0.25, 0.0), (1.0, 0.0, 0.0)]),
        ([[0.5, 0.25, 0], [1, 0, 0]], [(0.5, 0.25, 0.0), (1.0, 0.0, 0.0)]),  # as JavaScript writes the same
        ([[51, 255, 0], [1, 0, 0]], [(0.2, 1.0, 0.0), (1 / 255, 0.0, 0.0)]),
        ([[51.0, 255.0, 0.0], [1, 0, 0]], [(0.2, 1.0, 0.0), (1 / 255, 0.0, 0.0)]),
    ],
)
def test_colours_are_read_as_the_verb_lists_them_or_as_bytes(
    tmp_path: Path, colors: list[list[float]], shown: list[tuple[float, float, float]]
) -> None:
    entries = [{"id": i, "name": f"c{i}", "color": color, "priority": 1} for i, color in enumerate(colors, 1)]
    (tmp_path / "classes.json").write_text(json.dumps({"classes": entries}))
    assert [values.color for values in read_class_values(tmp_path / "classes.json")] == shown
