"""Made-up photos, and ingesting them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from fieldwork.nerfcore.capture import ingest
from fieldwork.nerfcore.params import NewParams
from fieldwork.nerfcore.progress import Reporter
from PIL import ExifTags, Image


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
