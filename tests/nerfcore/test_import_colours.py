"""Colour profiles of photos that a posed data set brings."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.data.copying import copy_photo
from fieldwork.nerfcore.images.decode import read_photo
from fieldwork.nerfcore.images.working import read_picture
from PIL import Image, ImageCms

SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def red_and_green_swapped() -> bytes:
    """The profile of a screen whose first channel shines green: sRGB's, with two tags and a letter of its name exchanged."""
    swapped = SRGB.replace(b"rXYZ", b"----").replace(b"gXYZ", b"rXYZ").replace(b"----", b"gXYZ")
    return swapped.replace("sRGB".encode("utf-16-be"), "xRGB".encode("utf-16-be"))


@pytest.mark.parametrize(
    ("suffix", "mode"), [("png", "RGB"), ("png", "RGBA"), ("jpg", "RGB"), ("webp", "RGB"), ("webp", "RGBA")]
)
def test_photos_with_a_colour_profile_become_srgb(tmp_path: Path, suffix: str, mode: str) -> None:
    source = tmp_path / f"a.{suffix}"
    color = (200, 60, 40, 255)[: len(mode)]
    Image.new(mode, (64, 48), color).save(source, icc_profile=red_and_green_swapped(), quality=95)
    copy = copy_photo(source, tmp_path / "images", "a")
    shown = read_picture(copy).pixels[5, 5, :3]
    assert np.abs(shown.astype(int) - (60, 200, 40)).max() <= 3
    assert np.array_equal(shown, read_photo(source).picture.pixels[5, 5, :3]), "as `new` reads it"
    with Image.open(copy) as image:
        assert "icc_profile" not in image.info


@pytest.mark.parametrize("profile", [None, SRGB, b"no profile"])
def test_photos_in_srgb_keep_their_bytes(tmp_path: Path, profile: bytes | None) -> None:
    source = tmp_path / "a.jpg"
    Image.new("RGB", (64, 48), (200, 60, 40)).save(source, icc_profile=profile)
    assert copy_photo(source, tmp_path / "images", "a").read_bytes() == source.read_bytes()


def test_a_copy_in_other_colours_is_made_anew(tmp_path: Path) -> None:
    """It bears the name and the time of what takes its place."""
    source, copy = tmp_path / "a.png", tmp_path / "images" / "a.png"
    Image.new("RGB", (64, 48), (200, 60, 40)).save(source, icc_profile=red_and_green_swapped())
    copy.parent.mkdir()
    copy.write_bytes(source.read_bytes())
    os.utime(copy, ns=(source.stat().st_atime_ns, source.stat().st_mtime_ns))
    copy_photo(source, tmp_path / "images", "a")
    assert np.abs(read_picture(copy).pixels[5, 5, :3].astype(int) - (60, 200, 40)).max() <= 3
    made = copy.stat().st_ino
    assert copy_photo(source, tmp_path / "images", "a").stat().st_ino == made
