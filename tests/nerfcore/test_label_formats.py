"""Labels of other tools: files as these tools write them, and everything there and back."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import skimage
from fieldwork.nerfcore.cli import main
from fieldwork.nerfcore.errors import DiskError, FieldworkError, InputError, ProjectError, SettingError
from fieldwork.nerfcore.images.working import read_label
from fieldwork.nerfcore.labels import exchange
from fieldwork.nerfcore.labels.exchange import export_labels
from fieldwork.nerfcore.labels.formats import coco, cvat, known, label_studio
from fieldwork.nerfcore.labels.formats.regions import (
    from_runs,
    hex_color,
    id_picture,
    placed,
    polygon_mask,
    region_of,
    runs_of,
)
from fieldwork.nerfcore.labels.journal import append_mark
from fieldwork.nerfcore.params import LabelExportParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import edit_project, load_project
from fieldwork.tests.nerfcore.support.label_files import (
    BRUSH,
    COCO,
    CORNER,
    CVAT,
    HEIGHT,
    RING,
    WIDTH,
    WRITTEN,
    bring,
    named_map,
    project_of,
    write_coco,
    write_cvat,
    write_panoptic,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

MASKS = st.integers(1, 12).flatmap(
    lambda w: st.integers(1, 12).flatmap(
        lambda h: st.lists(st.booleans(), min_size=w * h, max_size=w * h).map(lambda v: np.array(v).reshape(h, w))
    )
)


def expect(**masks: np.ndarray) -> np.ndarray:
    found = np.full((HEIGHT, WIDTH), "", dtype="<U8")
    for name, mask in masks.items():
        found[mask] = name
    return found


@pytest.mark.parametrize("kind", WRITTEN)
def test_files_as_tools_write_them_are_recognised_and_read(tmp_path: Path, kind: str) -> None:
    folder = project_of(tmp_path / "p", ["a", "b"])
    (tmp_path / "given").mkdir()
    told, _ = bring(folder, WRITTEN[kind](tmp_path / "given"))
    assert (told["photos"], told["classes"]) == (1, ["stone", "wood"])
    np.testing.assert_array_equal(named_map(folder, "a"), expect(wood=RING, stone=CORNER))
    images = {image.name: image for image in load_project(folder).images}
    assert images["b"].label is None, "what nobody labelled stays unlabelled"
    if kind == "colors":
        assert images["a"].instances is None
    else:
        assert images["a"].instances is not None
        things = read_label(folder / images["a"].instances)
        assert len(np.unique(things[RING])) == 1
        assert things[RING][0] not in (0, things[CORNER][0])
        assert not things[~RING & ~CORNER].any()
        assert (things[CORNER][0] == 0) == (kind in ("segments", "panoptic")), "what has no instances is no thing"
    if kind in ("panoptic", "cvat", "segments", "supervisely", "colors"):
        colors = {c.name: [round(part * 255) for part in c.color] for c in load_project(folder).classes}
        assert colors == {"stone": [1, 2, 3], "wood": [255, 0, 51]}


def test_what_has_no_area_and_strange_pictures_are_told(tmp_path: Path) -> None:
    folder = project_of(tmp_path / "p", ["a"])
    told, report = bring(folder, write_coco(tmp_path))
    assert told["unknown"] == ["stranger.jpg"]
    assert told["skipped"] == {"box": 1}
    assert any("stranger.jpg" in text for text in report.warnings)
    assert any("“box” have no area" in text for text in report.warnings)
    told, _ = bring(folder, write_cvat(tmp_path), replace=True)
    assert told["skipped"] == {"polyline": 1}


def test_masks_that_stand_out_of_the_picture_are_cut_off() -> None:
    for left, top in np.ndindex(16, 14):
        whole = np.zeros((40, 40), bool)
        whole[10 + top - 4 : 13 + top - 4, 10 + left - 4 : 14 + left - 4] = True
        found = placed(np.ones((3, 4), bool), left - 4, top - 4, 8, 6)
        np.testing.assert_array_equal(found, whole[10:16, 10:18])


def test_regions_are_kept_as_the_patches_that_enclose_them() -> None:
    random = np.random.default_rng(1)
    for _ in range(200):
        corners = random.integers(-40, 100, (random.integers(3, 7), 2)) / 2
        whole = skimage.draw.polygon2mask((60, 70), corners[:, ::-1] + 20 - 0.5)[20:38, 20:44]
        mask = polygon_mask(corners.tolist(), 24, 18)
        np.testing.assert_array_equal(mask, whole)
        region = region_of("wood", mask, 3)
        np.testing.assert_array_equal(region.mask(24, 18), mask)
        painted = np.zeros((18, 24), np.uint16)
        region.paint(painted, 7)
        np.testing.assert_array_equal(painted, 7 * mask)
    small = np.zeros((3000, 4000), bool)
    small[7:9, 30] = True
    assert region_of("wood", small).patch.nbytes == 2, "hundreds of things on a large photo take no memory"


def test_photos_keep_labels_of_their_own_unless_they_shall_not(tmp_path: Path) -> None:
    folder = project_of(tmp_path / "p", ["a"])
    own = folder / "labels/mine.png"
    Image.fromarray(np.full((HEIGHT, WIDTH), 9, np.uint8)).save(own)
    with edit_project(folder) as project:
        project.images[0].label = "labels/mine.png"
    told, report = bring(folder, write_cvat(tmp_path))
    assert (told["photos"], told["kept"]) == (0, ["a"])
    assert any("keep them" in text for text in report.warnings)
    assert load_project(folder).images[0].label == "labels/mine.png"
    told, _ = bring(folder, write_cvat(tmp_path), replace=True)
    assert told["photos"] == 1
    np.testing.assert_array_equal(named_map(folder, "a"), expect(wood=RING, stone=CORNER))
    assert own.is_file(), "nothing is deleted"


def test_known_classes_keep_their_ids_and_names_for_nothing_are_no_class(tmp_path: Path) -> None:
    folder = project_of(tmp_path / "p", ["a"])
    with edit_project(folder) as project:
        project.ignore_id = 1
        project.classes = [known_class(5, "wood")]
    (tmp_path / "annotations.xml").write_text(CVAT.replace("stone", "Unlabeled"))
    bring(folder, tmp_path / "annotations.xml")
    project = load_project(folder)
    assert [(c.id, c.name) for c in project.classes] == [(5, "wood")]
    label = read_label(folder / str(project.images[0].label))
    assert (label[RING] == 5).all()
    assert (label[~RING] == 1).all(), "void has the id that the project says"
    (tmp_path / "annotations.xml").write_text(CVAT.replace("stone", "background"))
    bring(folder, tmp_path / "annotations.xml", replace=True)
    assert [(c.id, c.name) for c in load_project(folder).classes] == [(2, "background"), (5, "wood")]


def test_new_classes_get_no_id_that_marks_or_label_maps_may_hold(tmp_path: Path) -> None:
    folder = project_of(tmp_path / "p", ["a"])
    with edit_project(folder) as project:
        project.classes = [known_class(1, "marked"), known_class(2, "drawn"), known_class(4, "clay")]
    append_mark(folder, {"photo": "a", "shape": "line", "points": [(1, 1)], "class_id": 1})
    with edit_project(folder) as project:
        project.classes = project.classes[2:]
    bring(folder, write_cvat(tmp_path))
    assert [(c.id, c.name) for c in load_project(folder).classes] == [(3, "stone"), (4, "clay"), (5, "wood")]


def test_classes_that_are_added_during_an_import_keep_their_ids(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = project_of(tmp_path / "p", ["a"])
    whole = exchange.maps_of

    def slow(*given: Any) -> Any:
        with edit_project(folder) as project:  # meanwhile, in Blender
            project.classes = [known_class(1, "gold")]
        return whole(*given)

    monkeypatch.setattr(exchange, "maps_of", slow)
    with pytest.raises(ProjectError, match="changed during the import"):
        bring(folder, write_cvat(tmp_path))
    assert not list((folder / "labels/imported").rglob("*.png"))
    assert [c.name for c in load_project(folder).classes] == ["gold"]


def test_ids_of_label_maps_without_names_mean_the_same_in_every_import(tmp_path: Path) -> None:
    folder = project_of(tmp_path / "p", ["a", "b"])
    for name, values in {"a": (1, 5), "b": (2, 5)}.items():
        (tmp_path / name).mkdir()
        Image.fromarray(np.where(CORNER, *values).astype(np.uint8)).save(tmp_path / name / f"{name}.png")
        bring(folder, tmp_path / name)
        np.testing.assert_array_equal(
            named_map(folder, name), np.where(CORNER, f"class {values[0]}", f"class {values[1]}")
        )
    assert [(c.id, c.name) for c in load_project(folder).classes] == [(i, f"class {i}") for i in (1, 2, 5)]


def test_colors_that_do_not_tell_classes_apart_are_refused(tmp_path: Path) -> None:
    folder = project_of(tmp_path / "p", ["a"])
    bring(folder, write_cvat(tmp_path))
    for color, owner in (((1.0, 0.0, 0.2), "stone"), ((0.0, 0.0, 0.0), "void")):
        with edit_project(folder) as project:
            project.classes[0].color = color
        with pytest.raises(SettingError, match=f"the colour of .*{owner}"):
            export(folder, tmp_path / "out", "png-colors")
        assert not (tmp_path / "out").exists()
    export(folder, tmp_path / "ids", "png")


def test_more_classes_than_a_field_tells_apart_are_refused(tmp_path: Path) -> None:
    folder = project_of(tmp_path / "p", ["a"], (300, 4))
    (tmp_path / "maps").mkdir()
    Image.fromarray(np.arange(300, dtype=np.uint16)[None].repeat(4, 0)).save(tmp_path / "maps/a.png")
    with pytest.raises(InputError, match="299 classes"):
        bring(folder, tmp_path / "maps")
    assert not load_project(folder).classes


def known_class(number: int, name: str) -> Any:
    from fieldwork.nerfcore.project.schema import SemanticClass

    return SemanticClass(id=number, name=name, color=(1, 0, 0))


def test_labels_of_larger_photos_are_brought_to_their_size_and_others_are_refused(tmp_path: Path) -> None:
    folder = project_of(tmp_path / "p", ["a"], (14, 10))
    bring(folder, write_cvat(tmp_path))
    large = expect(wood=RING, stone=CORNER).repeat(2, 0).repeat(2, 1)
    np.testing.assert_array_equal(named_map(folder, "a"), large)
    other = project_of(tmp_path / "q", ["a"], (10, 14))
    with pytest.raises(InputError, match="No picture"):
        bring(other, write_cvat(tmp_path))
    assert load_project(other).images[0].label is None


def test_masks_as_metashape_writes_them_are_one_class(tmp_path: Path) -> None:
    folder = project_of(tmp_path / "p", ["a", "IMG_1.x"])
    given = tmp_path / "masks"
    given.mkdir()
    Image.fromarray(RING.astype(np.uint8) * 255).save(given / "a_mask.png")
    Image.fromarray(CORNER).save(given / "IMG_1.x_mask.png")  # one bit
    told, _ = bring(folder, given, format="masks", class_name="vase")
    assert (told["photos"], told["classes"]) == (2, ["vase"])
    np.testing.assert_array_equal(named_map(folder, "a"), expect(vase=RING))
    np.testing.assert_array_equal(named_map(folder, "IMG_1.x"), expect(vase=CORNER))
    out = tmp_path / "again"
    export(folder, out, "masks", class_name="vase")
    np.testing.assert_array_equal(np.asarray(Image.open(out / "a_mask.png")), RING * 255)


def export(folder: Path, out: Path, kind: str, **values: Any) -> dict[str, Any]:
    given = {"project": folder, "out": out, "format": kind, **values}
    return export_labels(LabelExportParams.model_validate(given), Reporter())


@pytest.mark.parametrize(
    "kind", ["coco", "coco-panoptic", "cvat", "label-studio", "labelme", "segments", "supervisely", "png", "png-colors"]
)
def test_labels_and_instances_come_back_as_they_went(tmp_path: Path, kind: str) -> None:
    random = np.random.default_rng(4)
    folder = project_of(tmp_path / "p", ["a", "b"], (23, 17))
    ids, things = {}, {}
    with edit_project(folder) as project:
        project.classes = [known_class(2, "stone"), known_class(300, "holz & stein")]
        project.classes[1].color = (0.0, 0.4, 1.0)
        (folder / "labels/i").mkdir()
        for image in project.images:
            ids[image.name] = random.choice([0, 2, 300], (17, 23)).astype(np.uint16)
            things[image.name] = np.where(ids[image.name] == 300, random.integers(1, 4, (17, 23)), 0).astype(np.uint16)
            image.label, image.instances = f"labels/{image.name}.png", f"labels/i/{image.name}.png"
            Image.fromarray(ids[image.name]).save(folder / image.label)
            Image.fromarray(things[image.name]).save(folder / image.instances)
    out = tmp_path / f"out{known.FILES.get(kind, '')}"
    told = export(folder, out, kind)
    assert told["photos"] == 2
    assert all(Path(file).is_file() for file in told["files"])
    other = project_of(tmp_path / "q", ["a", "b"], (23, 17))
    path = out / "panoptic.json" if kind == "coco-panoptic" else out
    told, _ = bring(other, path)
    assert told["unknown"] == []
    for name in ("a", "b"):
        wanted = np.vectorize({0: "", 2: "stone", 300: "holz & stein"}.__getitem__)(ids[name])
        np.testing.assert_array_equal(named_map(other, name), wanted)
        if kind not in ("png", "png-colors"):
            record = next(image for image in load_project(other).images if image.name == name)
            assert record.instances is not None
            back = read_label(other / record.instances)
            pairs = {(int(a), int(b)) for a, b in zip(things[name].flat, back.flat) if a}
            assert len(pairs) == 3, "each instance is one again"
            assert len({b for _, b in pairs}) == 3


THING_FORMATS = ["coco", "coco-panoptic", "cvat", "label-studio", "labelme", "segments", "supervisely"]


@pytest.mark.parametrize("kind", THING_FORMATS)
@pytest.mark.parametrize("single", [True, False], ids=["one thing", "no thing"])
def test_what_is_no_instance_comes_back_as_none(tmp_path: Path, kind: str, single: bool) -> None:
    folder = project_of(tmp_path / "p", ["a"])
    things = np.where(CORNER & single, 7, 0).astype(np.uint8)
    with edit_project(folder) as project:
        project.classes = [known_class(1, "stone"), known_class(2, "wood")]
        project.images[0].label, project.images[0].instances = "labels/a.png", "labels/things.png"
        ids = np.full((HEIGHT, WIDTH), 2, np.uint8)
        ids[:, :3] = 1
        Image.fromarray(ids).save(folder / "labels/a.png")
        Image.fromarray(things).save(folder / "labels/things.png")
    out = tmp_path / f"out{known.FILES.get(kind, '')}"
    export(folder, out, kind)
    other = project_of(tmp_path / "q", ["a"])
    told, _ = bring(other, out / "panoptic.json" if kind == "coco-panoptic" else out)
    assert told["instances"] == single
    found = load_project(other).images[0].instances
    assert (found is not None) == single
    if found is not None:
        np.testing.assert_array_equal(read_label(other / found) > 0, CORNER)
    np.testing.assert_array_equal(named_map(other, "a"), expect(stone=ids == 1, wood=ids == 2))


@pytest.mark.parametrize("kind", [*THING_FORMATS, "png", "png-colors"])
def test_photos_with_odd_names_are_found_again(tmp_path: Path, kind: str) -> None:
    names = [
        "20240101-front",
        "deadbeef-x",
        "IMG#1",
        "50%25",
        "a.b",
        "a;b&c",
        "[1]",
        "mask",
        "-x",
        "a_label_ground-truth",
    ]
    folder, other = project_of(tmp_path / "p", names), project_of(tmp_path / "q", names)
    with edit_project(folder) as project:
        project.classes = [known_class(1, "stone")]
        for number, image in enumerate(project.images):
            image.label = f"labels/{image.name}.png"
            ids = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) == number
            Image.fromarray(ids.astype(np.uint8)).save(folder / image.label)
    out = tmp_path / f"out{known.FILES.get(kind, '')}"
    export(folder, out, kind)
    told, _ = bring(other, out / "panoptic.json" if kind == "coco-panoptic" else out)
    assert told["unknown"] == []
    for name in names:
        np.testing.assert_array_equal(named_map(other, name), named_map(folder, name))


@given(MASKS)
@settings(max_examples=60)
def test_run_lengths_come_back(mask: np.ndarray) -> None:
    runs = runs_of(mask)
    assert sum(runs) == mask.size
    assert (from_runs(runs, mask.size) == mask.reshape(-1)).all()
    assert coco.unpacked(coco.packed(runs)) == runs
    flat = np.repeat(mask.reshape(-1).astype(np.uint8) * 255, 4)
    np.testing.assert_array_equal(label_studio.unpacked(label_studio.packed(flat)), flat)


def test_run_lengths_are_those_of_the_tools() -> None:
    assert coco.packed(runs_of(RING.T)) == ";32NO0129"
    mask = np.zeros((4, 6), np.uint8)
    mask[1:3, 2:5] = 255
    np.testing.assert_array_equal(label_studio.unpacked(BRUSH), np.repeat(mask.reshape(-1), 4))
    many = np.zeros(3_000_000, np.uint8)
    many[700_000:] = 255
    np.testing.assert_array_equal(label_studio.unpacked(label_studio.packed(many)), many)


def test_names_of_label_studio_s_pictures() -> None:
    name = lambda address: label_studio.picture_name({"image": address}, 1)  # noqa: E731
    assert name("/data/upload/3/0a1b2c3d-IMG_1.jpg") == "IMG_1.jpg"
    assert name("/data/upload/3/0a1b2c3d-20240101-IMG_1.jpg") == "20240101-IMG_1.jpg"
    assert name("/data/local-files/?d=vase%2FIMG%201.jpg") == "vase/IMG 1.jpg"
    assert name("s3://bucket/vase/IMG_1.jpg?versionId=4") == "vase/IMG_1.jpg"
    for plain in ("20240101-IMG_1.jpg", "IMG#1.jpg", "50%25.jpg", "a;b?.jpg", "cam0/1.jpg"):
        assert name(plain) == plain
    assert hex_color("#0f8") == (0, 255, 136)
    assert hex_color("red") is None


def test_pictures_of_one_name_in_several_folders_keep_apart(tmp_path: Path) -> None:
    segments, samples = tmp_path / "segments", []
    boxes = {"cam0": RING, "cam1": CORNER}
    for number, (camera, mask) in enumerate(boxes.items(), 1):
        (segments / camera).mkdir(parents=True)
        rgba = np.dstack([id_picture(mask * number), np.full(mask.shape, 255, np.uint8)])
        Image.fromarray(rgba).save(segments / camera / "1_label_mine.png")
        attributes = {
            "annotations": [{"id": number, "category_id": 1}],
            "segmentation_bitmap": {"url": "https://x.org/0a"},
        }
        samples.append({"name": f"{camera}/1.jpg", "labels": {"mine": {"attributes": attributes}}})
        annotated = tmp_path / "supervisely" / camera / "ann"
        annotated.mkdir(parents=True)
        points = {"exterior": [[0, number], [3, 5]], "interior": []}
        objects = [{"classTitle": "clay", "geometryType": "rectangle", "points": points}]
        value = {"size": {"width": WIDTH, "height": HEIGHT}, "objects": objects}
        (annotated / "1.jpg.json").write_text(json.dumps(value))
    dataset = {"samples": samples, "task_attributes": {"categories": [{"id": 1, "name": "clay"}]}}
    (segments / "release.json").write_text(json.dumps({"dataset": dataset}))
    (tmp_path / "supervisely/meta.json").write_text(json.dumps({"classes": [{"title": "clay"}]}))
    folder = project_of(tmp_path / "p", ["cam0_1", "cam1_1"])
    assert bring(folder, segments)[0]["photos"] == 2
    for camera, mask in boxes.items():
        np.testing.assert_array_equal(named_map(folder, f"{camera}_1"), expect(clay=mask))
    (segments / "cam1/1_label_mine.png").unlink()
    with pytest.raises(InputError, match=r"label picture of cam1/1\.jpg is not beside"):
        bring(folder, segments, replace=True)
    assert bring(folder, tmp_path / "supervisely", replace=True)[0]["photos"] == 2
    for number, camera in enumerate(boxes, 1):
        assert (named_map(folder, f"{camera}_1") == "clay").any(1).tolist() == [row >= number for row in range(HEIGHT)]


@pytest.mark.parametrize("kind", ["labelme", "png", "masks"])
def test_folders_of_several_cameras_are_read(tmp_path: Path, kind: str) -> None:
    boxes = {"cam0": (2, 2), "cam1": (4, 3)}
    for camera, (right, bottom) in boxes.items():
        (tmp_path / "given" / camera).mkdir(parents=True)
        shape = {"label": "stone", "points": [[0, 0], [right, bottom]], "shape_type": "rectangle"}
        value = {"shapes": [shape], "imagePath": "1.jpg", "imageWidth": WIDTH, "imageHeight": HEIGHT}
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[:bottom, :right] = 255 if kind == "masks" else 1
        if kind == "labelme":
            (tmp_path / "given" / camera / "1.json").write_text(json.dumps(value))
        else:
            Image.fromarray(mask).save(tmp_path / "given" / camera / ("1_mask.png" if kind == "masks" else "1.png"))
    folder = project_of(tmp_path / "p", ["cam0_1", "cam1_1"])
    told, _ = bring(folder, tmp_path / "given", class_name="stone", format="masks" if kind == "masks" else "auto")
    assert told["photos"] == 2
    for camera, (right, bottom) in boxes.items():
        found = named_map(folder, f"{camera}_1")
        assert (found != "").sum() == right * bottom
        assert (found[:bottom, :right] == ("class 1" if kind == "png" else "stone")).all()


def test_masks_named_with_the_whole_name_of_the_photo(tmp_path: Path) -> None:
    folder = project_of(tmp_path / "p", ["a", "b_jpg"])
    (tmp_path / "masks").mkdir()
    for name in ("a.jpg.png", "b.jpg.png"):
        Image.fromarray(CORNER).save(tmp_path / "masks" / name)
    assert bring(folder, tmp_path / "masks", format="masks")[0]["photos"] == 2


BROKEN = {
    "order.xml": CVAT.replace('z_order="1"', 'z_order="1.5"').encode(),
    "no shapes.json": b'{"shapes": null}',
    "circle.json": json.dumps(
        {
            "shapes": [{"label": "x", "points": [[1, 1]], "shape_type": "circle"}],
            "imagePath": "a.jpg",
            "imageWidth": 7,
            "imageHeight": 5,
        }
    ).encode(),
    "no json.json": b"{",
    "other.json": b'{"a": 1}',
    "broken.xml": b"<annotations><image",
    "video.xml": b"<annotations><track id='0' label='x'/></annotations>",
    "empty.xml": b"<annotations/>",
    "size.xml": b"<annotations><image name='a' width='-3' height='5'/></annotations>",
    "huge.xml": b"<annotations><image name='a' width='30000' height='30000'/></annotations>",
    "runs.xml": b"<annotations><image name='a' width='7' height='5'><mask label='x' rle='3, 9' left='0' top='0' width='2' height='2'/></image></annotations>",
    "points.xml": b"<annotations><image name='a' width='7' height='5'><polygon label='x' points='1,2;3'/></image></annotations>",
    "categories.json": b'{"images": [], "annotations": []}',
    "runs.json": json.dumps(
        {**COCO, "annotations": [{**COCO["annotations"][0], "segmentation": {"size": [5, 7], "counts": [3, 4]}}]}
    ).encode(),
    "strange category.json": json.dumps(
        {**COCO, "annotations": [{**COCO["annotations"][1], "category_id": 77}]}
    ).encode(),
    "no panoptic.json": json.dumps(
        {**COCO, "annotations": [{"image_id": 4, "file_name": "x.png", "segments_info": []}]}
    ).encode(),
    "brush.json": json.dumps(
        [
            {
                "data": {"image": "a.jpg"},
                "annotations": [
                    {
                        "result": [
                            {
                                "type": "brushlabels",
                                "original_width": 7,
                                "original_height": 5,
                                "value": {"rle": [1, 2], "brushlabels": ["x"]},
                            }
                        ]
                    }
                ],
            }
        ]
    ).encode(),
    "mask.json": json.dumps(
        {
            "shapes": [{"label": "x", "points": [[0, 0], [1, 1]], "shape_type": "mask", "mask": "!"}],
            "imagePath": "a.jpg",
            "imageWidth": 7,
            "imageHeight": 5,
        }
    ).encode(),
    "list of numbers.json": json.dumps([{"data": {"image": "a.jpg"}, "annotations": 3}]).encode(),
    "samples of none.json": b'{"dataset": {"samples": null, "task_attributes": {"categories": []}}}',
    "endless.xml": b"<annotations><image name='a' width='7' height='5'><mask label='x' rle='4' left='0' top='0' width='inf' height='2'/></image></annotations>",
    "release.json": b'{"dataset": {"samples": [], "task_attributes": {}}}',
    "a.png": b"no picture",
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_cannot_be_read_is_told_in_a_sentence(tmp_path: Path, name: str) -> None:
    folder = project_of(tmp_path / "p", ["a"])
    before = (folder / "project.json").read_bytes()
    path = tmp_path / name
    path.write_bytes(BROKEN[name])
    with pytest.raises(InputError) as error:
        bring(folder, path)
    assert error.value.message.endswith(".")
    assert error.value.hint
    assert (folder / "project.json").read_bytes() == before


def test_panoptic_pictures_that_are_elsewhere_are_asked_for(tmp_path: Path) -> None:
    """They are looked for where the file says and in the folder that is called like it, and no photo is taken for one."""
    folder, path = project_of(tmp_path / "p", ["a"]), write_panoptic(tmp_path)
    (tmp_path / "panoptic_val").rename(tmp_path / "maps")
    with pytest.raises(InputError, match=r"is in none of the folders .*panoptic_val, ") as error:
        bring(folder, path)
    assert f"into {tmp_path / 'panoptic_val'}" in error.value.hint
    value = json.loads(path.read_text())
    value["annotations"][0]["file_name"] = "maps\\a.png"
    path.write_text(json.dumps(value))
    assert bring(folder, path)[0]["photos"] == 1
    shutil.rmtree(tmp_path / "maps")
    Image.new("RGB", (WIDTH, HEIGHT), (9, 9, 9)).save(tmp_path / "a.png")
    with pytest.raises(InputError, match="shows none of the segments"):
        bring(folder, path, replace=True)


def test_folders_and_files_that_are_wrong_are_refused(tmp_path: Path) -> None:
    folder = project_of(tmp_path / "p", ["a"])
    (tmp_path / "empty").mkdir()
    for path in (tmp_path / "nothing", tmp_path / "empty"):
        with pytest.raises(InputError):
            bring(folder, path)
    with pytest.raises(InputError, match="has labels"):
        export(folder, tmp_path / "x.json", "coco")
    bring(folder, write_cvat(tmp_path))
    export(folder, tmp_path / "panoptic", "coco-panoptic")
    with pytest.raises(InputError, match="of no format"):  # its pictures are no label maps
        bring(folder, tmp_path / "panoptic", replace=True)
    with pytest.raises(SettingError, match=r"end in \.xml"):
        export(folder, tmp_path / "x.json", "cvat")
    with pytest.raises(SettingError, match="no class"):
        export(folder, tmp_path / "m", "masks", class_name="gold")
    with pytest.raises(SettingError, match=r"say which one is white, with --class-name\. The classes are \w"):
        export(folder, tmp_path / "m", "masks")
    (tmp_path / "full").mkdir()
    (tmp_path / "full/x").touch()
    with pytest.raises(InputError, match="there already"):
        export(folder, tmp_path / "full", "png")
    (tmp_path / "new").mkdir()
    assert export(folder, tmp_path / "new", "png")["photos"] == 1, "an empty folder is as good as none"


def test_labels_go_into_the_folder_that_one_is_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = project_of(tmp_path / "p", ["a"])
    bring(folder, write_cvat(tmp_path))
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    written = export(folder, Path("."), "png")["files"]
    assert sorted(path.name for path in here.iterdir()) == sorted(Path(path).name for path in written)
    assert Path("a.png").is_file(), "the folder is still the one that the user is in"
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = project_of(tmp_path / "p", ["a"])
    bring(folder, write_cvat(tmp_path))

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", full)
    with pytest.raises(DiskError):
        export(folder, tmp_path / "out", "png")
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".out*"))


def test_polygons_of_cvat_turn_as_the_tool_turns_them() -> None:
    from xml.etree import ElementTree

    box = ElementTree.fromstring("<box xtl='1' ytl='2' xbr='5' ybr='4' rotation='90'/>")
    mask = cvat._mask(box, 8, 8)
    assert mask is not None
    assert [list(map(int, edge)) for edge in (np.flatnonzero(mask.any(0)), np.flatnonzero(mask.any(1)))] == [
        [2, 3],
        [1, 2, 3, 4],
    ]


def test_the_command_line_imports_and_exports(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = project_of(tmp_path / "p", ["a"])
    assert main(["label", "import", str(folder), "--file", str(write_cvat(tmp_path)), "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["photos"] == 1
    out = tmp_path / "labels.json"
    assert main(["label", "export", str(folder), str(out), "--format", "coco", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["files"] == [str(out)]
    assert main(["label", "import", str(folder), "--file", str(tmp_path / "nothing"), "--json"]) == 1
    assert "does not exist" in json.loads(capfd.readouterr().out)["error"]["message"]
    assert issubclass(InputError, FieldworkError)
