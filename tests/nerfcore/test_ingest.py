"""Ingest of photos: formats, EXIF, labels, masks, and every way in which files can be bad."""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from fieldwork.nerfcore.capture import ingest
from fieldwork.nerfcore.capture.images import linear_to_srgb8, read_photo
from fieldwork.nerfcore.errors import Cancelled, DiskError, InputError, ProjectError
from fieldwork.nerfcore.params import NewParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project import load_project
from PIL import ExifTags, Image, ImageFilter


def picture(seed: int = 0, size: tuple[int, int] = (320, 200)) -> Image.Image:
    """A photo-like picture: coloured blobs and texture, different for each seed, with a red top-left corner."""
    rng = np.random.default_rng(seed)
    coarse = Image.fromarray(rng.integers(0, 255, (10, 16, 3), np.uint8)).resize(size, Image.Resampling.BICUBIC)
    pixels = np.asarray(coarse).astype(int) + rng.integers(-25, 25, (size[1], size[0], 1))
    pixels[: size[1] // 5, : size[0] // 5] = (250, 5, 5)
    return Image.fromarray(np.clip(pixels, 0, 255).astype(np.uint8))


def exif(orientation: int = 1, **more: object) -> Image.Exif:
    block = Image.Exif()
    block[ExifTags.Base.Orientation] = orientation
    block[ExifTags.Base.Make] = "Maker\x00"
    block[ExifTags.Base.Model] = "Model X"
    detail = block.get_ifd(ExifTags.IFD.Exif)
    detail[ExifTags.Base.FocalLength] = 30.0
    detail[ExifTags.Base.FocalLengthIn35mmFilm] = 45
    detail[ExifTags.Base.DateTimeOriginal] = "2024:05:06 07:08:09"
    gps = block.get_ifd(ExifTags.IFD.GPSInfo)
    gps[ExifTags.GPS.GPSLatitudeRef], gps[ExifTags.GPS.GPSLatitude] = "S", (10.0, 30.0, 0.0)
    gps[ExifTags.GPS.GPSLongitudeRef], gps[ExifTags.GPS.GPSLongitude] = "E", (20.0, 0.0, 36.0)
    gps[ExifTags.GPS.GPSAltitude] = 123.0
    detail.update(more)
    return block


def new(photos: Path, project: Path, **settings: object) -> dict:
    return ingest.new(NewParams(photos=photos, project=project, **settings), Reporter())  # type: ignore[arg-type]


def folder_of(path: Path, count: int = 3) -> Path:
    path.mkdir(parents=True)
    for i in range(count):
        picture(i).save(path / f"p{i}.jpg", quality=95)
    return path


def close(a: Image.Image, b: Image.Image, tolerance: float = 6.0) -> bool:
    return a.size == b.size and np.abs(np.asarray(a.convert("RGB"), float) - np.asarray(b, float)).mean() < tolerance


# --- formats --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp", "bmp", "heic"])
def test_eight_bit_formats(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    picture().save(path, quality=95) if suffix in ("jpg", "webp", "heic") else picture().save(path)
    photo = read_photo(path)
    assert close(photo.image, picture(), 8.0)
    assert photo.lossy == (suffix in ("jpg", "webp", "heic"))


def test_sixteen_bit_tiff_and_png(tmp_path: Path) -> None:
    deep = np.asarray(picture()).astype(np.uint16) * 257
    for name in ("a.tif", "b.png"):
        buffer = oiio.ImageBuf(oiio.ImageSpec(320, 200, 3, oiio.UINT16))
        buffer.set_pixels(oiio.ROI(), deep)
        assert buffer.write(str(tmp_path / name))
        assert np.abs(np.asarray(read_photo(tmp_path / name).image).astype(int) - np.asarray(picture())).max() <= 1


def test_exr_goes_through_the_srgb_curve(tmp_path: Path) -> None:
    linear = np.linspace(0, 1.2, 256 * 4 * 3, dtype=np.float32).reshape(4, 256, 3)
    linear[0, 0] = np.nan
    buffer = oiio.ImageBuf(oiio.ImageSpec(256, 4, 3, oiio.FLOAT))
    buffer.set_pixels(oiio.ROI(), linear)
    assert buffer.write(str(tmp_path / "a.exr"))
    pixels = np.asarray(read_photo(tmp_path / "a.exr").image)
    assert np.array_equal(pixels, linear_to_srgb8(linear))
    assert pixels[0, 0].tolist() == [0, 0, 0]
    assert pixels[3, 255].tolist() == [255, 255, 255]
    # 18 % grey is 118 in sRGB.
    assert linear_to_srgb8(np.full((1, 1, 3), 0.18, np.float32))[0, 0, 0] == 118


def test_grey_palette_cmyk_and_alpha(tmp_path: Path) -> None:
    picture().convert("L").save(tmp_path / "grey.png")
    assert read_photo(tmp_path / "grey.png").image.mode == "RGB"
    picture().quantize(64).save(tmp_path / "palette.png")
    assert read_photo(tmp_path / "palette.png").image.mode == "RGB"
    picture().convert("CMYK").save(tmp_path / "cmyk.jpg", quality=95)
    assert close(read_photo(tmp_path / "cmyk.jpg").image, picture(), 20)
    clear = picture().convert("RGBA")
    clear.putalpha(Image.linear_gradient("L").resize(clear.size))
    clear.save(tmp_path / "alpha.png")
    assert read_photo(tmp_path / "alpha.png").image.mode == "RGBA"
    picture().convert("RGBA").save(tmp_path / "opaque.png")
    assert read_photo(tmp_path / "opaque.png").image.mode == "RGB"


def write_dng(path: Path, mosaic: np.ndarray, orientation: int) -> None:
    """A minimal digital negative: one uncompressed 16-bit RGGB picture, a maker and a focal length in 35 mm terms."""
    height, width = mosaic.shape
    one = (10000, 10000)
    matrix = [one if i % 4 == 0 else (0, 10000) for i in range(9)]
    tags: list[tuple[int, str, list | bytes]] = [
        (254, "I", [0]), (256, "I", [width]), (257, "I", [height]), (258, "H", [16]), (259, "H", [1]),
        (262, "H", [32803]), (271, "s", b"Maker\0"), (272, "s", b"Model R\0"), (273, "I", [0]),
        (274, "H", [orientation]), (277, "H", [1]), (278, "I", [height]), (279, "I", [width * height * 2]),
        (284, "H", [1]), (33421, "H", [2, 2]), (33422, "B", [0, 1, 1, 2]), (34665, "I", [0]), (50706, "B", [1, 4, 0, 0]),
        (50708, "s", b"Maker Model R\0"), (50714, "H", [0]), (50717, "I", [65535]), (50721, "ii", matrix),
        (50728, "II", [(1, 1)] * 3), (50778, "H", [21]),
    ]  # fmt: skip
    kinds = {"B": 1, "s": 2, "H": 3, "I": 4, "II": 5, "ii": 10}

    def packed(kind: str, values: list | bytes) -> bytes:
        if isinstance(values, bytes):
            return values
        if len(kind) == 2:
            return b"".join(struct.pack("<" + kind, *pair) for pair in values)
        return struct.pack(f"<{len(values)}{kind}", *values)

    sizes = [len(packed(kind, values)) for _, kind, values in tags]
    place = 8 + 2 + 12 * len(tags) + 4
    detail_at = place + sum(size + size % 2 for size in sizes if size > 4)
    detail = struct.pack("<HHHII", 1, 41989, 3, 1, 45) + bytes(4)
    directory, long_values = b"", b""
    for tag, kind, values in tags:
        if tag in (273, 34665):
            values = [detail_at if tag == 34665 else detail_at + len(detail)]
        data = packed(kind, values)
        directory += struct.pack("<HHI", tag, kinds[kind], len(values))
        if len(data) <= 4:
            directory += data.ljust(4, b"\0")
        else:
            directory += struct.pack("<I", place + len(long_values))
            long_values += data + b"\0" * (len(data) % 2)
    head = b"II*\0" + struct.pack("<IH", 8, len(tags))
    path.write_bytes(head + directory + bytes(4) + long_values + detail + mosaic.astype("<u2").tobytes())


@pytest.mark.parametrize("orientation", [1, 6])
def test_camera_raw(tmp_path: Path, orientation: int) -> None:
    mosaic = np.full((200, 320), 20000, np.uint16)
    mosaic[:40, :60] = 1000  # a dark top-left corner
    write_dng(tmp_path / "a.dng", mosaic, orientation)
    photo = read_photo(tmp_path / "a.dng")
    assert photo.full_size == ((320, 200) if orientation == 1 else (200, 320))
    dark, light = ((20, 20), (200, 150)) if orientation == 1 else ((180, 20), (50, 200))
    assert max(photo.image.getpixel(dark)) < 60
    assert max(photo.image.getpixel(light)) > 120
    assert photo.facts["make"] == "Maker"
    assert photo.facts["focal_px"] == pytest.approx(45 / 36 * 320)


def test_raw_by_name_but_not_by_content(tmp_path: Path) -> None:
    (tmp_path / "a.nef").write_bytes(b"not a raw photo" * 100)
    with pytest.raises(InputError, match="camera raw"):
        read_photo(tmp_path / "a.nef")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_baked_in(tmp_path: Path, orientation: int) -> None:
    upright = picture()
    inverse = {6: 8, 8: 6}.get(orientation, orientation)
    from fieldwork.nerfcore.capture.images import upright as turn

    turn(upright, inverse).save(tmp_path / "a.jpg", quality=95, exif=exif(orientation))
    photo = read_photo(tmp_path / "a.jpg")
    assert photo.full_size == (320, 200)
    assert close(photo.image, upright)
    assert "exif" not in photo.image.info


def test_exif_facts(tmp_path: Path) -> None:
    picture().save(tmp_path / "a.jpg", exif=exif())
    facts = read_photo(tmp_path / "a.jpg").facts
    assert facts["make"] == "Maker"
    assert facts["model"] == "Model X"
    assert facts["time"] == "2024:05:06 07:08:09"
    assert facts["focal_px"] == pytest.approx(45 / 36 * 320)
    assert facts["gps"] == pytest.approx({"latitude": -10.5, "longitude": 20.01, "altitude": 123.0})


def test_focal_length_survives_shrinking_and_cropping(tmp_path: Path) -> None:
    """A camera of 6400×4000, the file shrunk to a tenth and then cropped to a square."""
    size = {ExifTags.Base.ExifImageWidth: 6400, ExifTags.Base.ExifImageHeight: 4000}
    block = exif()
    block.get_ifd(ExifTags.IFD.Exif).update(size)
    picture(size=(400, 400)).save(tmp_path / "a.jpg", exif=block)
    assert read_photo(tmp_path / "a.jpg").facts["focal_px"] == pytest.approx(45 / 36 * 640)


# --- the verb -------------------------------------------------------------------------------------------------------


def test_working_copies(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "Fotos mit Ümlaut")
    picture(7, (1000, 625)).save(photos / "big.png", exif=exif(1))
    result = new(photos, tmp_path / "Projekt ß", max_size=500)
    assert result["images"] == 4
    project = load_project(tmp_path / "Projekt ß")
    big = next(record for record in project.images if record.name == "big")
    assert (big.width, big.height) == (500, 312)
    assert big.file == "images/big.png"
    with Image.open(tmp_path / "Projekt ß" / big.file) as image:
        assert image.size == (500, 312)
    assert big.focal_px == pytest.approx(45 / 36 * 500)
    assert big.sha256 == ingest.file_hash(photos / "big.png")
    assert big.camera_group == "Maker Model X 30.0mm 500x312"
    assert project.provenance[0].verb == "new"


def test_several_cameras_and_equal_names(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    for i, camera in enumerate(("left", "right")):
        (photos / camera).mkdir(parents=True)
        for k in range(2):
            picture(10 * i + k).save(photos / camera / f"{k}.jpg", quality=95)
    new(photos, tmp_path / "p")
    assert [record.name for record in load_project(tmp_path / "p").images] == ["left_0", "left_1", "right_0", "right_1"]


def test_bad_files_have_reasons(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos", 4)
    (photos / "empty.jpg").touch()
    (photos / "text.jpg").write_text("this is not a photo")
    whole = (photos / "p0.jpg").read_bytes()
    (photos / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    picture(50).save(photos / "really a png.jpg", format="PNG")
    shutil.copy(photos / "p1.jpg", photos / "z copy.jpg")
    picture(2).save(photos / "z recompressed.jpg", quality=90)
    picture(9, (900, 200)).save(photos / "pano.jpg")
    picture(9, (40, 30)).save(photos / "tiny.jpg")
    (photos / "layers.psd").write_bytes(b"8BPS")
    (photos / "notes.txt").write_text("x")
    result = new(photos, tmp_path / "p")
    reasons = {entry["file"]: entry["reason"] for entry in result["rejected"]}
    assert result["images"] == 5  # four good ones and the PNG with the wrong extension
    assert "empty" in reasons["empty.jpg"]
    assert "not an image" in reasons["text.jpg"]
    assert "truncated" in reasons["cut.jpg"]
    assert reasons["z copy.jpg"] == "the same picture as p1.jpg"
    assert reasons["z recompressed.jpg"] == "the same picture as p2.jpg"
    assert "panorama" in reasons["pano.jpg"]
    assert "too small" in reasons["tiny.jpg"]
    assert ".psd" in reasons["layers.psd"]
    assert set(reasons) == {
        "empty.jpg", "text.jpg", "cut.jpg", "z copy.jpg", "z recompressed.jpg", "pano.jpg", "tiny.jpg", "layers.psd",
    }  # fmt: skip


def test_huge_panorama_is_refused_without_much_memory(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos")
    Image.new("RGB", (20000, 4000), (90, 120, 30)).save(photos / "pano.jpg", quality=60)
    Image.new("RGB", (20000, 10000), (90, 120, 30)).save(photos / "sphere.jpg", quality=60)
    result = new(photos, tmp_path / "p")
    assert result["rejected"] == [
        {"file": f"{name}.jpg", "reason": f"a panorama ({size}): poses need single photos, not stitched ones"}
        for name, size in (("pano", "20000×4000"), ("sphere", "20000×10000"))
    ]


def test_all_identical(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in range(5):
        picture().save(photos / f"{i}.jpg", quality=95)
    result = new(photos, tmp_path / "p")
    assert result["images"] == 1
    assert len(result["rejected"]) == 4


def test_blurred_photo_is_left_out_and_can_be_kept(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos", 9)
    picture(20).filter(ImageFilter.GaussianBlur(4)).save(photos / "shaky.jpg", quality=95)
    result = new(photos, tmp_path / "p")
    assert [entry["file"] for entry in result["rejected"]] == ["shaky.jpg"]
    assert result["rejected"][0]["reason"].startswith("blurred")
    assert new(photos, tmp_path / "q", keep_blurry=True)["images"] == 10


def test_empty_missing_and_useless_folders(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="There are no photos"):
        new(tmp_path / "empty", tmp_path / "p")
    with pytest.raises(InputError, match="does not exist"):
        new(tmp_path / "nowhere", tmp_path / "p")
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "a.jpg").touch()
    with pytest.raises(InputError, match=r"None of the 1 files.*a\.jpg: the file is empty"):
        new(tmp_path / "bad", tmp_path / "p")
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(InputError, match="neither a folder of photos nor a video"):
        new(tmp_path / "a.txt", tmp_path / "p")
    assert not (tmp_path / "p" / "project.json").exists()


def test_unreadable_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests may run as root, which reads everything: the refusal is simulated at os.scandir."""
    photos = folder_of(tmp_path / "photos")

    def refuse(path: str) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(os, "scandir", refuse)
    with pytest.raises(InputError, match=r"cannot be read: Permission denied"):
        ingest.list_photos(photos)


def test_one_photo_is_taken_with_a_warning(tmp_path: Path) -> None:
    report = Reporter()
    result = ingest.new(NewParams(photos=folder_of(tmp_path / "photos", 1), project=tmp_path / "p"), report)
    assert result["images"] == 1
    assert any("at least three" in warning for warning in report.warnings)


# --- labels and masks -----------------------------------------------------------------------------------------------


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


# --- running again --------------------------------------------------------------------------------------------------


def count_decodes(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    decoded: list[str] = []

    def counted(path: Path, *rest: object) -> object:
        decoded.append(path.name)
        return read_photo(path, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(ingest, "read_photo", counted)
    return decoded


def test_cancelled_and_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = folder_of(tmp_path / "photos", 12)
    decoded = count_decodes(monkeypatch)

    class Stops(Reporter):
        def progress(self, fraction: float, message: str = "") -> None:
            if fraction > 0.4:
                self.cancel()
            self.check()

    with pytest.raises(Cancelled):
        ingest.new(NewParams(photos=photos, project=tmp_path / "p"), Stops())
    first = len(decoded)
    assert 4 <= first < 12
    assert not (tmp_path / "p" / "project.json").exists()
    assert new(photos, tmp_path / "p")["images"] == 12
    # What was finished is not done again; those under way when the stop came may be.
    assert len(decoded) <= 12 + 4
    before = len(decoded)
    assert new(photos, tmp_path / "p")["images"] == 12
    assert len(decoded) == before


def test_killed_and_run_again(tmp_path: Path) -> None:
    """Cut off by SIGKILL at any moment: no half file, and the next run finishes."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in range(8):
        picture(i, (1600, 1000)).save(photos / f"p{i}.png", compress_level=1)
    code = (
        "import sys; from pathlib import Path; from fieldwork.nerfcore.capture.ingest import new\n"
        "from fieldwork.nerfcore.params import NewParams; from fieldwork.nerfcore.progress import Reporter\n"
        f"new(NewParams(photos=Path({str(photos)!r}), project=Path({str(tmp_path / 'p')!r})), Reporter())\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code])
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline and not list((tmp_path / "p").glob("images/p*.png")):
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert list((tmp_path / "p").glob("images/p*.png"))
    assert new(photos, tmp_path / "p")["images"] == 8
    files = {record.file for record in load_project(tmp_path / "p").images}
    assert {f"images/{name}" for name in os.listdir(tmp_path / "p" / "images")} == files
    for file in files:
        with Image.open(tmp_path / "p" / file) as image:
            image.load()


def test_changed_photo_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = folder_of(tmp_path / "photos")
    new(photos, tmp_path / "p")
    old = load_project(tmp_path / "p").images[1].sha256
    decoded = count_decodes(monkeypatch)
    picture(77).save(photos / "p1.jpg", quality=95)
    new(photos, tmp_path / "p")
    assert decoded == ["p1.jpg"]
    assert load_project(tmp_path / "p").images[1].sha256 != old


def test_another_capture_is_not_overwritten_but_can_be_added(tmp_path: Path) -> None:
    new(folder_of(tmp_path / "a"), tmp_path / "p")
    more = tmp_path / "b"
    more.mkdir()
    picture(30).save(more / "p0.jpg")  # the same name as one that is there
    picture(1).save(more / "again.jpg", quality=95)  # the same picture
    with pytest.raises(ProjectError, match="--add"):
        new(more, tmp_path / "p")
    result = new(more, tmp_path / "p", add=True)
    assert result["images"] == 4
    assert result["rejected"] == [{"file": "again.jpg", "reason": "the same picture as p1.jpg"}]
    names = [record.name for record in load_project(tmp_path / "p").images if record.status == "ok"]
    assert names == ["p0", "p1", "p2", "p0_b"]


def test_full_disk(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos", 8)
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=128k", "tmpfs", str(disk)]
    mounted = subprocess.run(command, capture_output=True, text=True, check=False) if shutil.which("mount") else None
    if mounted is None or mounted.returncode:
        pytest.skip("a small file system cannot be mounted here")
    try:
        with pytest.raises(DiskError, match="No space left"):
            new(photos, disk / "p")
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_damaged_memory_of_earlier_runs_only_costs_time(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos")
    new(photos, tmp_path / "p")
    (tmp_path / "p" / ingest.CACHE_FILE).write_text('{"p0": 3')
    assert new(photos, tmp_path / "p")["images"] == 3


def test_float_photos_share_one_exposure(tmp_path: Path) -> None:
    """Radiance up to 40: all photos are brought down by the same factor, so that a wall keeps its colour."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in range(3):
        linear = np.asarray(picture(i)).astype(np.float32) / 255 * 40
        linear[-20:] = 20.0
        buffer = oiio.ImageBuf(oiio.ImageSpec(320, 200, 3, oiio.HALF))
        buffer.set_pixels(oiio.ROI(), linear)
        assert buffer.write(str(photos / f"{i}.exr"))
    new(photos, tmp_path / "p")
    values = set()
    for i in range(3):
        with Image.open(tmp_path / "p" / "images" / f"{i}.png") as image:
            values.add(image.getpixel((160, 195)))
    assert len(values) == 1
    assert 100 < values.pop()[0] < 230


def test_truncation_is_found_in_every_format(tmp_path: Path) -> None:
    for suffix in ("jpg", "png", "webp", "tif"):
        buffer = io.BytesIO()
        picture().save(buffer, format={"jpg": "JPEG", "tif": "TIFF"}.get(suffix, suffix.upper()))
        (tmp_path / f"a.{suffix}").write_bytes(buffer.getvalue()[: len(buffer.getvalue()) * 2 // 3])
        with pytest.raises(InputError):
            read_photo(tmp_path / f"a.{suffix}")
