"""Which label, mask and confidence belongs to which photo, and which way up: rigs, near names, EXIF orientations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from fieldwork.nerfcore.capture import ingest
from fieldwork.nerfcore.capture.find import find_sources, list_photos
from fieldwork.nerfcore.data.copying import copy_photo
from fieldwork.nerfcore.data.importer import read_dataset
from fieldwork.nerfcore.images.decode import image_size, read_photo, upright
from fieldwork.nerfcore.params import NewParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project
from fieldwork.tests.nerfcore.support.photos import exif, new, picture
from PIL import Image

INVERSE = {6: 8, 8: 6}


def level(path: Path, value: int, last_row: int | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.new("L", (320, 200), value)
    image.paste(value if last_row is None else last_row, (0, 199, 320, 200))
    image.save(path)


def rig(root: Path, cameras: list[str]) -> Path:
    for i, camera in enumerate(cameras):
        for k in range(2):
            (root / camera).mkdir(parents=True, exist_ok=True)
            picture(10 * i + k).save(root / camera / f"img{k}.jpg", quality=95)
    return root


def test_rigs_keep_their_labels_masks_and_confidence_apart(tmp_path: Path) -> None:
    photos = rig(tmp_path / "photos", ["cam0", "cam1", "cam2"])
    for i in range(2):  # cam2 has none
        for k in range(2):
            level(tmp_path / "labels" / f"cam{i}" / f"img{k}.png", 1 + 2 * i + k)
            level(tmp_path / "labels" / "confidence" / f"cam{i}" / f"img{k}.png", 100 + 2 * i + k)
            level(tmp_path / "masks" / f"cam{i}" / f"img{k}_mask.png", 255 * k, last_row=255)
    result = new(photos, tmp_path / "p", labels=tmp_path / "labels", masks=tmp_path / "masks")
    assert (result["labelled"], result["masked"]) == (4, 4)
    for record in load_project(tmp_path / "p").images:
        camera, k = int(record.name[3]), int(record.name[-1])
        found = []
        for file in (record.label, record.confidence, record.mask):
            if file is None:
                found.append(None)
                continue
            with Image.open(tmp_path / "p" / file) as image:
                assert (np.asarray(image)[:-1] == image.getpixel((0, 0))).all()
                found.append(image.getpixel((0, 0)))
        assert found == ([None] * 3 if camera == 2 else [1 + 2 * camera + k, 100 + 2 * camera + k, 255 * k])


def sources(photos: Path, labels: Path) -> dict[str, str | None]:
    paths, _, root = list_photos(photos)
    return {s.name: s.label.name if s.label else None for s in find_sources(paths, root, labels, None, set())}


def test_a_flat_label_with_a_stem_of_two_photos_belongs_to_neither(tmp_path: Path) -> None:
    photos = rig(tmp_path / "photos", ["cam0", "cam1"])
    level(tmp_path / "labels" / "img0.png", 1)
    level(tmp_path / "labels" / "cam1_img1.png", 2)
    assert sources(photos, tmp_path / "labels") == {
        "cam0_img0": None, "cam0_img1": None, "cam1_img0": None, "cam1_img1": "cam1_img1.png",
    }  # fmt: skip


def test_names_that_begin_alike_and_formats_side_by_side(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("a.jpg", "a_1.jpg", "b.jpg", "b.png"):
        picture().save(photos / name)
    for name in ("a_1.png", "b.jpg.png", "b.png.png"):
        level(tmp_path / "labels" / name, 1)
    assert sources(photos, tmp_path / "labels") == {
        "a_jpg": None, "a_1_jpg": "a_1.png", "b_jpg": "b.jpg.png", "b_png": "b.png.png",
    }  # fmt: skip


def test_a_colmap_rig_keeps_its_labels_apart(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    rig(folder / "images", ["cam0", "cam1"])
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "sparse" / "0" / "cameras.txt").write_text("1 PINHOLE 320 200 300 300 160 100\n")
    names = [f"cam{i}/img{k}.jpg" for i in range(2) for k in range(2)]
    lines = "".join(f"{n + 1} 1 0 0 0 {n} 0 0 1 {name}\n\n" for n, name in enumerate(names))
    (folder / "sparse" / "0" / "images.txt").write_text(lines)
    (folder / "sparse" / "0" / "points3D.txt").write_text("")
    for k in range(2):
        level(folder / "labels" / "cam1" / f"img{k}.png", 7)
        level(folder / "masks" / "cam0" / f"img{k}.jpg.png", 255)
    level(folder / "labels" / "img0.png", 9)
    for view in read_dataset(folder).views:
        camera = view.image.parent.name
        assert view.label == (folder / "labels" / "cam1" / f"{view.image.stem}.png" if camera == "cam1" else None)
        assert view.mask == (folder / "masks" / "cam0" / f"{view.image.name}.png" if camera == "cam0" else None)


def labels() -> np.ndarray:
    values = np.zeros((200, 320), np.uint8)
    values[:, 250:] = 1
    values[150:, :] = 7
    return values


def turned_capture(folder: Path, orientations: dict[str, int], stored: bool, own: bool = False) -> Path:
    """Photos stored turned, and label maps drawn on the stored or on the upright pictures."""
    (folder / "photos" / "labels").mkdir(parents=True)
    for i, (name, value) in enumerate(orientations.items()):
        back = INVERSE.get(value, value)
        upright(picture(i), back).save(folder / "photos" / f"{name}.jpg", quality=95, exif=exif(value))
        block = Image.Exif()
        if own:
            block[0x0112] = value
        drawn = upright(Image.fromarray(labels()), back if stored else 1)
        drawn.save(folder / "photos" / "labels" / f"{name}.png", exif=block)
    return folder


def ingested(folder: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    report = Reporter()
    ingest.new(NewParams(photos=folder / "photos", project=folder / "p"), report)
    found = {}
    for record in load_project(folder / "p").images:
        with Image.open(folder / "p" / str(record.label)) as image:
            found[record.name] = np.asarray(image)
    return found, report.warnings


@pytest.mark.parametrize("orientation", range(1, 9))
def test_maps_of_stored_pixels_turn_with_every_orientation(tmp_path: Path, orientation: int) -> None:
    names = {"a": orientation, "b": orientation, "c": 1}
    found, warnings = ingested(turned_capture(tmp_path, names, stored=True))
    assert all(np.array_equal(values, labels()) for values in found.values())
    assert any("as they are stored" in w for w in warnings) == (orientation in (2, 3, 4))


@pytest.mark.parametrize("orientation", range(2, 9))
def test_maps_with_a_tag_of_their_own(tmp_path: Path, orientation: int) -> None:
    names = {"a": orientation, "b": orientation, "c": 1}
    found, warnings = ingested(turned_capture(tmp_path, names, stored=True, own=True))
    assert all(np.array_equal(values, labels()) for values in found.values())
    assert not any("as they are stored" in w for w in warnings)


@pytest.mark.parametrize("orientation", [2, 3, 6, 8])
def test_a_map_with_a_tag_is_turned_beside_an_upright_photo(tmp_path: Path, orientation: int) -> None:
    folder = turned_capture(tmp_path, {"a": 1, "b": 1, "c": 1}, stored=False)
    block = Image.Exif()
    block[0x0112] = orientation
    drawn = upright(Image.fromarray(labels()), INVERSE.get(orientation, orientation))
    drawn.save(folder / "photos" / "labels" / "b.png", exif=block)
    found, _ = ingested(folder)
    assert all(np.array_equal(values, labels()) for values in found.values())


@pytest.mark.parametrize("stored", [True, False])
def test_sideways_photos_tell_how_the_others_were_labelled(tmp_path: Path, stored: bool) -> None:
    """A tool that shows photos upright does so with all of them."""
    names = {"a": 6, "b": 3, "c": 2, "d": 1}
    found, warnings = ingested(turned_capture(tmp_path, names, stored))
    assert all(np.array_equal(values, labels()) for values in found.values())
    assert not any("as they are stored" in w for w in warnings)


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp", "exr"])
@pytest.mark.parametrize("orientation", [3, 6])
def test_posed_photos_are_never_turned(tmp_path: Path, suffix: str, orientation: int) -> None:
    """Poses are given for the pixels as stored: the red corner stays at the top left."""
    source = tmp_path / f"a.{suffix}"
    if suffix == "exr":
        spec = oiio.ImageSpec(320, 200, 3, oiio.FLOAT)
        spec.attribute("Orientation", orientation)
        buffer = oiio.ImageBuf(spec)
        buffer.set_pixels(spec.roi, np.asarray(picture()).astype(np.float32) / 255)
        assert buffer.write(str(source))
    else:
        picture().save(source, exif=exif(orientation))
    (tmp_path / "out").mkdir()
    with Image.open(copy_photo(source, tmp_path / "out", "a")) as image:
        assert image.size == (320, 200)
        assert image.getexif().get(0x0112, 1) == 1
        red, green, blue = image.convert("RGB").getpixel((10, 10))
        assert red > 200
        assert max(green, blue) < 60


@pytest.mark.parametrize("suffix", ["tif", "png", "webp"])
@pytest.mark.parametrize("deep", [False, True])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_baked_in_once_in_every_format(
    tmp_path: Path, suffix: str, deep: bool, orientation: int
) -> None:
    turned = upright(picture(), INVERSE.get(orientation, orientation))
    path = tmp_path / f"a.{suffix}"
    if deep:
        if suffix == "webp":
            return  # has 8 bits only
        spec = oiio.ImageSpec(*turned.size, 3, oiio.UINT16)
        spec.attribute("Orientation", orientation)
        buffer = oiio.ImageBuf(spec)
        buffer.set_pixels(spec.roi, np.asarray(turned).astype(np.uint16) * 257)
        assert buffer.write(str(path))
    else:
        turned.save(path, exif=exif(orientation), **({"lossless": True} if suffix == "webp" else {}))
    photo = read_photo(path)
    assert photo.full_size == (320, 200)
    assert np.abs(np.asarray(photo.image).astype(int) - np.asarray(picture())).max() <= 1
    stored = read_photo(path, turn=False)
    assert np.abs(np.asarray(stored.image).astype(int) - np.asarray(turned)).max() <= 1
    assert image_size(path) == stored.full_size == turned.size
