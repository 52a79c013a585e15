"""Still formats: every one becomes upright 8-bit sRGB with its EXIF facts."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from fieldwork.nerfcore.capture import ingest
from fieldwork.nerfcore.errors import InputError
from fieldwork.nerfcore.images.decode import image_size, read_photo
from fieldwork.nerfcore.images.picture import Picture, to_srgb8
from fieldwork.nerfcore.params import NewParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.photos import close, exif, new, picture
from PIL import ExifTags, Image


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
    assert np.array_equal(pixels, to_srgb8(Picture(linear, "linear")).pixels)
    assert pixels[0, 0].tolist() == [0, 0, 0]
    assert pixels[3, 255].tolist() == [255, 255, 255]
    # 18 % grey is 118 in sRGB.
    assert to_srgb8(Picture(np.full((1, 1, 3), 0.18, np.float32), "linear")).pixels[0, 0, 0] == 118


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
    from fieldwork.nerfcore.images.decode import upright as turn

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


def grey_exr(path: Path, light: float, seed: int) -> None:
    """A textured picture of this radiance, with a wall of radiance 1 in it."""
    linear = np.asarray(picture(seed)).astype(np.float32) / 255 * light
    linear[-20:] = 1.0
    buffer = oiio.ImageBuf(oiio.ImageSpec(320, 200, 3, oiio.HALF))
    buffer.set_pixels(oiio.ROI(), linear)
    assert buffer.write(str(path))


def test_float_photos_that_are_added_share_the_exposure(tmp_path: Path) -> None:
    """The added ones look towards a lamp: by themselves they would be made darker."""
    for folder, light in (("photos", 6.0), ("more", 60.0)):
        (tmp_path / folder).mkdir()
        for i in range(3):
            grey_exr(tmp_path / folder / f"{folder}{i}.exr", light, i)
    new(tmp_path / "photos", tmp_path / "p")
    new(tmp_path / "more", tmp_path / "p", add=True)
    walls = set()
    for path in (tmp_path / "p" / "images").iterdir():
        with Image.open(path) as image:
            walls.add(image.getpixel((160, 195)))
    assert len(walls) == 1


def test_truncation_is_found_in_every_format(tmp_path: Path) -> None:
    for suffix in ("jpg", "png", "webp", "tif"):
        buffer = io.BytesIO()
        picture().save(buffer, format={"jpg": "JPEG", "tif": "TIFF"}.get(suffix, suffix.upper()))
        (tmp_path / f"a.{suffix}").write_bytes(buffer.getvalue()[: len(buffer.getvalue()) * 2 // 3])
        with pytest.raises(InputError):
            read_photo(tmp_path / f"a.{suffix}")


def test_panoramas_are_told_by_what_a_png_says_behind_its_pixels_and_by_their_shape(tmp_path: Path) -> None:
    photos, report = tmp_path / "photos", Reporter()
    photos.mkdir()
    rng = np.random.default_rng(0)
    for name, size in {"a": (400, 300), "b": (400, 200), "c": (400, 300), "d": (400, 300), "e": (400, 300)}.items():
        Image.fromarray(rng.integers(0, 255, (size[1], size[0], 3), np.uint8)).save(photos / f"{name}.png")
    said = b"XML:com.adobe.xmp\0\0\0\0\0<rdf:Description GPano:ProjectionType='equirectangular'/>"
    chunk = struct.pack(">I", len(said)) + b"iTXt" + said + struct.pack(">I", zlib.crc32(b"iTXt" + said))
    data = (photos / "a.png").read_bytes()
    (photos / "a.png").write_bytes(data[:-12] + chunk + data[-12:])  # before the end, as exiftool puts it
    result = ingest.new(NewParams(project=tmp_path / "p", photos=photos), report)
    assert [(row["file"], "a panorama" in row["reason"]) for row in result["rejected"]] == [("a.png", True)]
    assert result["images"] == 4
    (told,) = [warning for warning in report.warnings if "twice as wide" in warning]
    assert ": b. If they are panoramas, leave them out" in told


@pytest.mark.parametrize(("kind", "channels"), [("uint16", 2), ("uint16", 5), ("uint8", 5)])
def test_tiffs_with_alpha_and_more_channels(tmp_path: Path, kind: str, channels: int) -> None:
    """Grey of 16 bits with alpha, and colours beside which infrared lies."""
    values = np.random.default_rng(0).integers(0, 255, (70, 90, channels)).astype(kind)
    spec = oiio.ImageSpec(90, 70, channels, kind)
    spec.channelnames = ("Y", "A") if channels == 2 else ("R", "G", "B", "A", "NIR")
    spec.alpha_channel = 1 if channels == 2 else 3
    spec.attribute("oiio:UnassociatedAlpha", 1)
    out = oiio.ImageOutput.create(str(tmp_path / "a.tif"))
    assert out.open(str(tmp_path / "a.tif"), spec)
    assert out.write_image(values * (257 if kind == "uint16" else 1))
    assert out.close()
    photo = read_photo(tmp_path / "a.tif")
    wanted = values[..., [0, 0, 0, 1] if channels == 2 else [0, 1, 2, 3]]
    assert (photo.picture.pixels == wanted).all()
    assert image_size(tmp_path / "a.tif") == photo.full_size == (90, 70)
