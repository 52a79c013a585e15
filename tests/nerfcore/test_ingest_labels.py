"""Label maps, masks and class files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.capture import ingest
from fieldwork.nerfcore.errors import InputError
from fieldwork.nerfcore.images.labels import read_labels, read_mask
from fieldwork.nerfcore.params import NewParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import SemanticClass
from fieldwork.nerfcore.project.store import edit_project, load_project
from fieldwork.tests.nerfcore.support.photos import exif, folder_of, new, picture
from PIL import Image


def labels(size: tuple[int, int] = (320, 200)) -> np.ndarray:
    values = np.zeros((size[1], size[0]), np.uint8)
    values[:, size[0] // 2 :] = 1
    values[size[1] // 2 :, :] = 7
    return values


COLORS = {0: (0, 0, 0), 1: (200, 10, 10), 7: (10, 10, 200)}
CLASSES = {"classes": {str(i): {"name": f"c{i}", "color": COLORS[i]} for i in (1, 7)}}


def write_labels(folder: Path, kind: str, name: str) -> None:
    folder.mkdir(exist_ok=True)
    values = labels()
    if kind == "index":
        Image.fromarray(values).save(folder / name)
    elif kind == "index16":
        Image.fromarray(values.astype(np.uint16)).save(folder / name)
    elif kind == "palette":
        image = Image.fromarray(values).convert("P")
        image.putpalette([c for i in range(8) for c in COLORS.get(i, (1, 1, 1))])
        image.save(folder / name)
    elif kind == "palette colours":  # the order of the palette is not that of the ids
        order = {0: 2, 1: 0, 7: 1}
        image = Image.fromarray(np.vectorize(order.get)(values).astype(np.uint8)).convert("P")
        image.putpalette([*COLORS[1], *COLORS[7], *COLORS[0]])
        image.save(folder / name)
    else:
        rgb = np.zeros((*values.shape, 3), np.uint8)
        for i, color in COLORS.items():
            rgb[values == i] = color
        Image.fromarray(rgb).save(folder / name)


def test_classes_of_one_color(tmp_path: Path) -> None:
    """A palette tells them apart by its indices; colours alone do not."""
    red = {1: (255, 0, 0), 2: (255, 0, 0), 3: (0, 255, 0)}
    picture = Image.fromarray(np.array([[0, 1, 2]], np.uint8), "P")
    picture.putpalette([0, 0, 0, 255, 0, 0, 255, 0, 0])
    picture.save(tmp_path / "palette.png")
    picture.convert("RGB").save(tmp_path / "rgb.png")
    assert read_labels(tmp_path / "palette.png", red).tolist() == [[0, 1, 2]]
    with pytest.raises(InputError, match="#ff0000 is that of the classes 1 and 2"):
        read_labels(tmp_path / "rgb.png", red)
    Image.fromarray(np.array([[[0, 255, 0], [0, 0, 0]]], np.uint8)).save(tmp_path / "green.png")
    assert read_labels(tmp_path / "green.png", red).tolist() == [[3, 0]]


@pytest.mark.parametrize("kind", ["index", "index16", "palette", "palette colours", "rgb"])
def test_label_formats(tmp_path: Path, kind: str) -> None:
    photos = folder_of(tmp_path / "photos")
    write_labels(tmp_path / "labels", kind, "p1.png")
    (tmp_path / "labels" / "classes.json").write_text(json.dumps(CLASSES))
    if kind == "palette":
        CLASSES_BY_INDEX = {"classes": {"1": "c1", "7": "c7"}}
        (tmp_path / "labels" / "classes.json").write_text(json.dumps(CLASSES_BY_INDEX))
    result = new(photos, tmp_path / "p", labels=tmp_path / "labels", max_size=160)
    assert result["labelled"] == 1  # labels for some photos only are normal
    assert result["classes"] == ["c1", "c7"]
    if kind != "palette":  # the classes are shown in the colours of the file
        shown = {c.id: [round(255 * part) for part in c.color] for c in load_project(tmp_path / "p").classes}
        assert shown == {i: list(COLORS[i]) for i in (1, 7)}
    record = next(r for r in load_project(tmp_path / "p").images if r.label)
    assert record.name == "p1"
    with Image.open(tmp_path / "p" / record.label) as image:
        small = np.asarray(image)
    assert small.shape == (100, 160)
    assert set(np.unique(small)) == {0, 1, 7}  # nearest neighbour: no id that was not there
    assert np.array_equal(small, labels()[1::2, 1::2])


def test_unusable_labels_are_named_and_left_out(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos")
    (tmp_path / "labels").mkdir()
    Image.fromarray(labels()).save(tmp_path / "labels" / "p0.jpg")
    Image.fromarray(labels((200, 320))).save(tmp_path / "labels" / "p1.png")
    picture().save(tmp_path / "labels" / "p2.png")
    report = Reporter()
    params = NewParams(photos=photos, project=tmp_path / "p", labels=tmp_path / "labels")
    assert ingest.new(params, report)["labelled"] == 0
    text = " ".join(report.warnings)
    assert "compression changes ids" in text
    assert "not the shape of the photo" in text
    assert "--classes" in text


def test_unknown_label_colour_is_named(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos")
    write_labels(tmp_path / "labels", "rgb", "p0.png")
    (tmp_path / "classes.json").write_text(json.dumps({"classes": {"1": {"name": "a", "color": COLORS[1]}}}))
    report = Reporter()
    new_params = NewParams(
        photos=photos, project=tmp_path / "p", labels=tmp_path / "labels", classes=tmp_path / "classes.json"
    )
    ingest.new(new_params, report)
    assert any("50.0 % of its pixels" in warning and "#0a0ac8" in warning for warning in report.warnings)


def test_labels_follow_the_orientation(tmp_path: Path) -> None:
    """A phone photo stored sideways; its labels drawn on the sideways picture."""
    photos, folder = tmp_path / "photos", tmp_path / "labels"
    photos.mkdir()
    folder.mkdir()
    upright = picture()
    for i in range(3):
        sideways = picture(i).transpose(Image.Transpose.ROTATE_90)
        sideways.save(photos / f"p{i}.jpg", quality=95, exif=exif(6))
    assert upright.size == (320, 200)
    Image.fromarray(labels()).transpose(Image.Transpose.ROTATE_90).save(folder / "p0.png")
    new(photos, tmp_path / "p", labels=folder)
    with Image.open(tmp_path / "p" / "labels" / "p0.png") as image:
        assert np.array_equal(np.asarray(image), labels())


@pytest.mark.parametrize("text", ["{", '{"classes": 3}', '["a", 3', '{"names": []}', '{"classes": {"x": "y"}}'])
def test_unusable_classes_file(tmp_path: Path, text: str) -> None:
    photos = folder_of(tmp_path / "photos")
    (tmp_path / "classes.json").write_text(text)
    with pytest.raises(InputError, match=r"classes file .*classes\.json"):
        new(photos, tmp_path / "p", classes=tmp_path / "classes.json")


def test_classes_as_a_list(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos")
    (tmp_path / "classes.json").write_text('["void", "Stein", "Gold"]')
    new(photos, tmp_path / "p", classes=tmp_path / "classes.json")
    classes = load_project(tmp_path / "p").classes
    assert [(c.id, c.name) for c in classes] == [(1, "Stein"), (2, "Gold")]
    assert len({c.color for c in classes}) == 2
    assert (0.0, 0.0, 0.0) not in {c.color for c in classes}


def test_masks(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos")
    (tmp_path / "masks").mkdir()
    mask = np.zeros((200, 320), np.uint8)
    mask[50:150] = 255
    Image.fromarray(mask).save(tmp_path / "masks" / "p0_mask.png")
    Image.fromarray(mask).save(tmp_path / "masks" / "p10.png")  # belongs to another photo
    result = new(photos, tmp_path / "p", masks=tmp_path / "masks", mask_mode="empty")
    assert result["masked"] == 1
    project = load_project(tmp_path / "p")
    assert project.mask_mode == "empty"
    with Image.open(tmp_path / "p" / "masks" / "p0.png") as image:
        assert np.array_equal(np.asarray(image), mask)


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "LA", "cut out"])
def test_masks_drawn_in_black_and_white_or_by_alpha(tmp_path: Path, mode: str) -> None:
    """Painting programs add an alpha channel that is full everywhere."""
    inside = np.zeros((20, 30), np.uint8)
    inside[5:15] = 255
    image = Image.fromarray(inside).convert("RGBA" if mode == "cut out" else mode)
    if mode == "cut out":
        image.putalpha(Image.fromarray(inside))
    image.save(tmp_path / "m.png")
    assert np.array_equal(read_mask(tmp_path / "m.png"), inside > 0)


@pytest.mark.parametrize("color", [(255, 0, 0), (0, 0, 255), (128, 0, 0)])  # the last: the first of VOC's palette
@pytest.mark.parametrize("mode", ["RGB", "P"])
def test_masks_painted_in_a_colour(tmp_path: Path, color: tuple[int, int, int], mode: str) -> None:
    inside = np.zeros((20, 30), np.uint8)
    inside[5:15] = 1
    image = Image.fromarray(inside, "P")
    image.putpalette([0, 0, 0, *color])
    image.convert(mode).save(tmp_path / "m.png")
    assert np.array_equal(read_mask(tmp_path / "m.png"), inside > 0)


@pytest.mark.parametrize(
    ("kind", "white"), [("uint8", 1), ("uint16", 1), ("uint16", 255), ("uint16", 65535), ("float32", 1)]
)
def test_masks_are_white_from_half_of_their_range(tmp_path: Path, kind: str, white: int) -> None:
    values = np.zeros((20, 30), kind)
    values[5:15], values[15:] = white, white * 0.4
    Image.fromarray(values).save(tmp_path / "m.tif")
    inside = np.zeros((20, 30), bool)
    inside[5:15] = True
    assert np.array_equal(read_mask(tmp_path / "m.tif"), inside)


@pytest.mark.parametrize("extended", [False, True])
@pytest.mark.parametrize("animated", [False, True])
def test_only_lossless_webp_holds_ids(tmp_path: Path, extended: bool, animated: bool) -> None:
    picture = Image.fromarray(np.repeat(labels()[..., None], 3, 2))
    more = {"exif": exif(1)} if extended else {}
    if animated:
        more |= {"save_all": True, "append_images": [Image.new("RGB", picture.size)]}
    picture.save(tmp_path / "a.webp", lossless=True, **more)
    picture.save(tmp_path / "b.webp", quality=95, **more)
    assert np.array_equal(read_labels(tmp_path / "a.webp"), labels())
    with pytest.raises(InputError, match="WEBP: its compression changes ids"):
        read_labels(tmp_path / "b.webp")


def test_a_cut_out_photo_that_fills_the_picture(tmp_path: Path) -> None:
    Image.new("RGBA", (30, 20), (10, 20, 30, 255)).save(tmp_path / "m.png")
    assert read_mask(tmp_path / "m.png").all()


def test_labels_that_came_later_stay_when_it_runs_again(tmp_path: Path) -> None:
    """Labels of p0 are the capture's own, those of p1 and p2 were imported; then p2 is taken again."""
    photos, folder, project = folder_of(tmp_path / "photos"), tmp_path / "labels", tmp_path / "p"
    write_labels(folder, "index", "p0.png")
    (folder / "classes.json").write_text(json.dumps(CLASSES))
    new(photos, project, labels=folder)
    (project / "labels" / "imported").mkdir()
    with edit_project(project) as edited:
        for record in edited.images[1:]:
            record.label = record.instances = f"labels/imported/{record.name}.png"
            record.depth = f"depth/{record.name}.exr"
            Image.fromarray(np.full((200, 320), 9, np.uint8)).save(project / record.label)
        edited.classes = [*edited.classes, SemanticClass(id=9, name="ivy", color=(0, 1, 0))]
    before = load_project(project)
    picture(99).save(photos / "p2.jpg", quality=95)
    report = Reporter()
    ingest.new(NewParams(photos=photos, project=project, labels=folder), report)
    after = load_project(project)
    assert after.images[:2] == before.images[:2]
    assert (after.images[2].label, after.images[2].instances) == (None, None)
    assert after.classes == before.classes
    assert report.warnings == []
    (folder / "p0.png").unlink()  # its own labels go with their folder
    new(photos, project, labels=folder)
    assert [record.label for record in load_project(project).images] == [None, "labels/imported/p1.png", None]
    again = Reporter()
    ingest.new(NewParams(photos=photos, project=project, max_size=200), again)
    assert not any(record.label for record in load_project(project).images)
    assert any("do not fit their new size" in text and "p1" in text for text in again.warnings)


@pytest.mark.parametrize("clear", [1, bytes([255, 20])])
def test_transparent_colours_of_a_palette_are_void(tmp_path: Path, clear: int | bytes) -> None:
    image = Image.fromarray(np.array([[0, 1, 2]], np.uint8))
    image.putpalette([255, 0, 0, 9, 9, 9, 0, 255, 0])
    image.save(tmp_path / "a.png", transparency=clear)
    assert read_labels(tmp_path / "a.png", None, 7).tolist() == [[0, 7, 2]]
    assert read_labels(tmp_path / "a.png", {3: (0, 255, 0), 4: (255, 0, 0), 5: (9, 9, 9)}, 7).tolist() == [[4, 7, 3]]
