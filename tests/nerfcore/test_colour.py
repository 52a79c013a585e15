"""Colour and alpha from file to training target, to picture and back, with exact values."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from fieldwork.nerfcore.blender.package import write_package
from fieldwork.nerfcore.data.box import Box
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.data.pixels import PixelStore
from fieldwork.nerfcore.evaluate.verb import compared_with
from fieldwork.nerfcore.images.decode import read_photo
from fieldwork.nerfcore.images.encode import write_picture
from fieldwork.nerfcore.images.picture import (
    Picture,
    as_float,
    associated,
    is_transparent,
    resized,
    straight,
    to_linear,
    to_srgb,
    with_alpha,
)
from fieldwork.nerfcore.images.working import read_picture
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project
from fieldwork.nerfcore.render.image import Frame
from fieldwork.nerfcore.render.verb import write_frame
from fieldwork.nerfcore.train.prepare import has_transparency
from fieldwork.tests.nerfcore.support.ball import ball_project
from fieldwork.tests.nerfcore.support.photos import new, picture
from PIL import Image, ImageCms

UNLABELLED: Any = SimpleNamespace(class_ids=[], label_revision=None)  # a run without classes


def write(path: Path, pixels: np.ndarray, **attributes: object) -> Path:
    """A file with exactly these numbers in it."""
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], str(pixels.dtype).replace("32", ""))
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    assert out.write_image(np.ascontiguousarray(pixels))
    assert out.close()
    return path


def cut_out(size: int = 90, level: int = 248) -> np.ndarray:
    """A bright disc with a soft edge over transparent black, (size, size, 4) uint8 with straight alpha."""
    y, x = np.mgrid[:size, :size] + 0.5
    alpha = np.clip((0.35 * size - np.hypot(x - size / 2, y - size / 2)) / 3 + 0.5, 0, 1)
    rgba = np.zeros((size, size, 4), np.uint8)
    rgba[..., 3] = (alpha * 255 + 0.5).astype(np.uint8)
    rgba[rgba[..., 3] > 0, :3] = level
    return rgba


def ball_with(folder: Path, rgba: np.ndarray, which: list[int] | None = None) -> Path:
    """The ball's project, in which some photos (all unless given) are this picture and the others opaque."""
    project = ball_project(folder, views=4)
    for i, record in enumerate(load_project(project).images):
        if which is None or i in which:
            Image.fromarray(rgba).resize((40, 40), Image.Resampling.NEAREST).save(project / record.file)
        else:
            with Image.open(project / record.file) as image:
                opaque = image.convert("RGB")
            opaque.save(project / record.file)
    return project


@pytest.mark.parametrize("longest", [27, 20, 11])
def test_training_targets_keep_the_colour_of_edges(tmp_path: Path, longest: int) -> None:
    project = ball_with(tmp_path / "p", cut_out())
    store = PixelStore(load_scene(project), [0, 1], [], np.eye(4), longest, torch.device("cpu"), Reporter())
    rgba = store.rgba.numpy()
    edge = (rgba[:, 3] > 0) & (rgba[:, 3] < 255)
    assert edge.sum() > 10
    assert (rgba[rgba[:, 3] > 0, :3] == 248).all()
    # A half covered pixel weighs half: the covered area stays.
    assert rgba[:, 3].mean() / 255 == pytest.approx(np.pi * 0.35**2, rel=0.03)


def test_evaluation_compares_with_the_colour_of_edges(tmp_path: Path) -> None:
    scene = load_scene(ball_with(tmp_path / "p", cut_out()))
    photo, keep, _ = compared_with(scene.views[0], scene, 27, 27, 1.0)
    assert keep is None
    assert photo.min() == 248
    assert photo.max() == 255
    black, _, _ = compared_with(scene.views[0], scene, 27, 27, 0.0)
    assert black.max() == 248
    assert black.min() == 0


def test_rgba_from_file_to_training_target(tmp_path: Path) -> None:
    """Ingest, working copy and training target: a colour is the same everywhere, also where little of it shows."""
    (tmp_path / "photos").mkdir()
    for i in range(3):
        rgba = cut_out(300)
        rgba[40 + 9 * i : 100, 90:200, :3] = (17, 101, 201)  # a patch, so that the photos differ
        rgba[120:180, 40:250] = (64, 33, 250, 13)
        Image.fromarray(rgba).save(tmp_path / "photos" / f"{i}.png")
    assert new(tmp_path / "photos", tmp_path / "p", max_size=140, keep_blurry=True)["images"] == 3
    record = load_project(tmp_path / "p").images[0]
    with Image.open(tmp_path / "p" / record.file) as image:
        small = np.asarray(image)
    assert small.shape == (140, 140, 4)
    colours = {tuple(c) for c in small[small[..., 3] == 13][:, :3].tolist()}
    assert (64, 33, 250) in colours
    inner = small[60:80, 30:110]
    assert (inner == (64, 33, 250, 13)).all()
    assert (small[36:42, 60:80, :3] == (17, 101, 201)).all()
    # The rim of the disc, away from the patches.
    rim = small[100:][(small[100:, :, 3] > 0)]
    assert len(rim) > 100
    assert (rim[:, :3] == 248).all()


HALF = np.tile(np.array([0.125, 0.25, 0.05, 0.5], np.float32), (80, 80, 1))  # associated: 0.25, 0.5, 0.1 half covered
STRAIGHT8 = [137, 188, 89, 128]  # linear 0.25, 0.5 and 0.1 in sRGB


def photo_pixel(path: Path) -> list[int]:
    image = read_photo(path).image
    assert image.size == (80, 80)
    return list(image.getpixel((40, 40)))


def test_associated_exr_becomes_straight(tmp_path: Path) -> None:
    assert photo_pixel(write(tmp_path / "a.exr", HALF)) == STRAIGHT8


def test_hdr_has_no_alpha(tmp_path: Path) -> None:
    buffer = oiio.ImageBuf(np.full((80, 80, 3), 0.25, np.float32))
    assert buffer.write(str(tmp_path / "a.hdr"))
    assert photo_pixel(tmp_path / "a.hdr") == [137, 137, 137]


@pytest.mark.parametrize("kind", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("unassociated", [False, True])
def test_tiff_says_which_alpha_it_has(tmp_path: Path, kind: str, unassociated: bool) -> None:
    """The numbers in the file are colours times alpha, or colours; the photo is the same."""
    if kind == "float32":
        pixels = HALF.copy()
        pixels[..., :3] *= 2 if unassociated else 1
        wanted = STRAIGHT8
    else:
        top = np.iinfo(kind).max
        rgb = np.array([200, 100, 40]) / 255
        full = np.array([*(rgb * (1 if unassociated else 0.2)), 0.2]) * top
        pixels = np.tile(np.round(full).astype(kind), (80, 80, 1))
        wanted = [200, 100, 40, 51]
    path = write(tmp_path / "a.tif", pixels)
    # OpenImageIO divides what it writes as unassociated, so only the tag is changed here (ExtraSamples 1 → 2).
    if unassociated:
        retag(path)
    assert np.abs(np.array(photo_pixel(path)) - wanted).max() <= (2 if kind == "uint8" and not unassociated else 0)
    if kind == "uint8":  # also as a file of the project
        assert np.abs(read_picture(path).pixels[40, 40].astype(int) - wanted).max() <= (0 if unassociated else 2)


def retag(path: Path) -> None:
    """Make a little-endian TIFF's alpha unassociated, leaving its numbers."""
    data = bytearray(path.read_bytes())
    entry = data.find(b"\x52\x01\x03\x00\x01\x00\x00\x00\x01\x00")
    assert entry > 0
    data[entry + 8] = 2
    path.write_bytes(bytes(data))


def test_sixteen_bit_png_with_alpha(tmp_path: Path) -> None:
    """Alpha of PNG is straight; 16 bits are rounded, not cut."""
    pixels = np.tile(np.array([51399, 25699, 10279, 13106], np.uint16), (80, 80, 1))
    path = tmp_path / "a.png"
    write(path, pixels, oiio__UnassociatedAlpha=1)
    assert photo_pixel(path) == [200, 100, 40, 51]


@pytest.mark.parametrize("mode", ["P", "L", "RGB"])
def test_a_colour_may_mean_transparent(tmp_path: Path, mode: str) -> None:
    """Palettes with transparency, and PNGs in which one grey or one colour is not there."""
    grey = np.full((80, 80), 60, np.uint8)
    grey[:40] = 7
    image = Image.fromarray(grey)
    if mode == "P":
        image = image.convert("P")
        image.putpalette([i for i in range(256) for _ in range(3)])
    key: int | tuple = 7 if mode != "RGB" else (7, 7, 7)
    image.convert(mode).save(tmp_path / "a.png", transparency=key)
    photo = read_photo(tmp_path / "a.png").image
    assert photo.getpixel((40, 60)) == (60, 60, 60, 255)
    assert photo.getpixel((40, 20))[3] == 0


def test_grey_with_alpha_and_a_profile(tmp_path: Path) -> None:
    """A linear grey profile: half the light is 188 in sRGB; alpha stays."""
    clear = Image.merge("LA", [Image.new("L", (80, 80), 128), Image.new("L", (80, 80), 77)])
    clear.save(tmp_path / "plain.png")
    assert photo_pixel(tmp_path / "plain.png") == [128, 128, 128, 77]
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    picture(size=(80, 80)).convert("RGBA").save(io.BytesIO(), "PNG", icc_profile=profile)
    rgba = Image.merge("RGBA", [Image.new("L", (80, 80), v) for v in (200, 100, 40, 51)])
    rgba.save(tmp_path / "rgba.png", icc_profile=profile)
    assert photo_pixel(tmp_path / "rgba.png") == [200, 100, 40, 51]


@pytest.mark.parametrize("which", [0, 1, 3])
def test_any_photo_may_be_the_transparent_one(tmp_path: Path, which: int) -> None:
    project = ball_with(tmp_path / "p", cut_out(), [which])
    scene = load_scene(project)
    assert scene.train == [0, 1, 2, 3]
    assert has_transparency(scene)
    assert not has_transparency(load_scene(ball_with(tmp_path / "q", cut_out(), [])))


@pytest.mark.parametrize(("mode", "transparent"), [("empty", True), ("ignore", False)])
def test_any_photo_may_be_the_one_with_a_mask(tmp_path: Path, mode: str, transparent: bool) -> None:
    scene = load_scene(ball_with(tmp_path / "p", cut_out(), []))
    views = [replace(view, mask=tmp_path / "m.png" if n == 2 else None) for n, view in enumerate(scene.views)]
    assert has_transparency(replace(scene, views=views, mask_mode=mode)) == transparent


def test_a_render_holds_its_colours_without_the_background(tmp_path: Path) -> None:
    """Three surfaces, opaque, a quarter covered and empty, before white: over black they are what they are."""
    alpha = np.tile(np.array([1.0, 0.25, 0.0], np.float32)[:, None], (2, 1, 1))
    shown = np.array([200, 100, 40], np.float32) / 255
    pixels = np.concatenate([np.tile(shown, (2, 3, 1)) * alpha, alpha], 2)
    nowhere = np.full((2, 3, 3), np.nan, np.float32)
    frame = Frame(Picture(pixels, "srgb", "associated"), 1.0, nowhere[..., 0], None, nowhere)
    box = Box(np.eye(4), False)
    png, exr = write_frame(tmp_path, "a", frame, ["rgb"], UNLABELLED, 0, {}, box)
    with Image.open(png) as image:
        assert image.mode == "RGB"
        # 100 / 4 + 255 · 3 / 4
        assert [image.getpixel((x, 0)) for x in range(3)] == [(200, 100, 40), (241, 216, 201), (255, 255, 255)]
    buffer = oiio.ImageBuf(str(exr))
    assert buffer.spec().channelnames == ("R", "G", "B", "A")
    assert buffer.spec().alpha_channel == 3
    linear = np.array([0.577580, 0.127438, 0.021219])  # 200, 100 and 40 by IEC 61966-2-1
    wanted = [[*linear, 1], [*linear / 4, 0.25], [0, 0, 0, 0]]
    assert buffer.get_pixels(oiio.FLOAT)[0] == pytest.approx(np.array(wanted), abs=2e-6)
    # Read as a photo it is what was rendered, straight.
    again = read_photo(exr).image
    assert [again.getpixel((x, 0)) for x in range(2)] == [(200, 100, 40, 255), (200, 100, 40, 64)]


def test_a_picture_with_alpha_is_written_straight(tmp_path: Path) -> None:
    pixels = np.tile(np.array([0.125, 0.25, 0.05, 0.5], np.float32), (4, 4, 1))
    write_picture(tmp_path / "a.png", Picture(pixels, "linear", "associated"))
    with Image.open(tmp_path / "a.png") as image:
        assert image.mode == "RGBA"
        assert list(image.getpixel((2, 2))) == STRAIGHT8
    assert read_picture(tmp_path / "a.png").pixels[2, 2].tolist() == STRAIGHT8


@pytest.mark.parametrize("kind", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("encoding", ["srgb", "linear"])
def test_conversions_undo_each_other(kind: str, encoding: str) -> None:
    rng = np.random.default_rng(0)
    values = rng.uniform(0, 1, (20, 30, 4)).astype(np.float32)
    values[..., 3] = values[..., 3] * 0.9 + 0.1
    if kind != "float32":
        values = (values * np.iinfo(kind).max).astype(kind)
    given = Picture(values, encoding, "straight")  # type: ignore[arg-type]
    back = straight(associated(given))
    assert back.alpha == "straight"
    assert np.abs(back.pixels - as_float(given).pixels).max() < 1e-6
    other = to_linear(to_srgb(associated(given)))
    assert other.encoding == "linear"
    assert other.alpha == "associated"
    assert np.abs(straight(other).pixels - as_float(to_linear(given)).pixels).max() < 2e-6
    assert resized(given, 10, 7).pixels.dtype == kind
    assert resized(given, 30, 20) is given
    with pytest.raises(ValueError, match="3 channels"):
        Picture(values)


def test_shrinking_opaque_pictures_keeps_levels() -> None:
    flat = Picture(np.full((90, 70, 3), 137, np.uint8))
    small = resized(flat, 31, 40)
    assert small.size == (31, 40)
    assert (small.pixels == 137).all()
    shown = resized(with_alpha(flat), 31, 40)
    assert (shown.pixels == (137, 137, 137, 255)).all()
    assert not is_transparent(shown)


def test_transparent_photos_are_straightened_with_their_alpha(tmp_path: Path) -> None:
    """Blender gets photos without lens distortion: a transparent one stays so, with the colour of its edges."""
    scene = load_scene(ball_with(tmp_path / "p", cut_out()))
    bent = scene.views[0].camera.model_copy(update={"model": "OPENCV", "distortion": (0.1, 0.02, 0.0, 0.0)})
    scene.views[:] = [replace(scene.views[0], camera=bent)]
    folder = write_package(tmp_path / "p", "main", scene, "p", Reporter())
    (file,) = (folder / "images").iterdir()
    with Image.open(file) as image:
        assert image.mode == "RGBA"
        rgba = np.asarray(image).reshape(-1, 4)
    assert 0 < rgba[:, 3].astype(float).mean() < 255
    assert ((rgba[:, 3] > 0) & (rgba[:, 3] < 255)).sum() > 10
    assert (rgba[rgba[:, 3] > 8, :3] == 248).all()


def test_a_depth_picture_has_a_legend(tmp_path: Path) -> None:
    depth = np.linspace(1, 3, 400, dtype=np.float32).reshape(20, 20)
    frame = Frame(
        Picture(np.ones((20, 20, 4), np.float32), "srgb", "associated"), 1.0, depth, None, np.ones((20, 20, 3))
    )
    box = Box(np.diag([2.0, 2, 2, 1]), False)
    picture, _ = write_frame(tmp_path, "a", frame, ["depth"], UNLABELLED, 0, {}, box)
    legend = json.loads(picture.with_suffix(".json").read_text())
    assert (legend["near"], legend["far"]) == pytest.approx((2 * 1.04, 2 * 2.96), abs=0.01)
    with Image.open(picture) as image:
        near, far = image.getpixel((0, 0)), image.getpixel((19, 19))
    assert near[0] > near[2], "near is red"
    assert far[2] > far[0], "far is blue"
    nothing = np.full_like(depth, np.nan)
    write_frame(tmp_path, "b", replace(frame, depth=nothing), ["depth"], UNLABELLED, 0, {}, box)
    assert json.loads((tmp_path / "b_depth.json").read_text())["near"] is None
