"""Camera models: distortion and its inverse, agreement with COLMAP, conversions of axes."""

from __future__ import annotations

import zlib  # noqa: F401  (before pycolmap)

import numpy as np
import pycolmap
import pytest
from fieldwork.nerfcore.errors import InputError
from fieldwork.nerfcore.geometry.cameras import Camera, flip_camera_axes, pixel_centers, project, rays
from fieldwork.nerfcore.geometry.colmap_cameras import camera_from_colmap
from hypothesis import given, settings
from hypothesis import strategies as st


def grid(camera: Camera, step: int = 13) -> np.ndarray:
    return pixel_centers(camera.width, camera.height)[::step, ::step].reshape(-1, 2)


def round_trip(camera: Camera) -> np.ndarray:
    pixels = grid(camera)
    directions, valid = rays(camera, pixels)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1)
    assert valid.mean() > 0.9
    return np.abs(project(camera, directions[valid]) - pixels[valid]).max()


sizes = {"width": 320, "height": 200}
focal = st.floats(150, 900)
small = st.floats(-0.02, 0.02)


@settings(max_examples=60)
@given(focal, focal, st.floats(140, 180), st.floats(80, 120))
def test_pinhole_round_trip(fx: float, fy: float, cx: float, cy: float) -> None:
    assert round_trip(Camera(fx=fx, fy=fy, cx=cx, cy=cy, **sizes)) < 1e-3


@settings(max_examples=60)
@given(st.floats(220, 900), st.floats(-0.12, 0.15), st.floats(-0.02, 0.03), small, small)
def test_opencv_round_trip(f: float, k1: float, k2: float, p1: float, p2: float) -> None:
    camera = Camera(model="OPENCV", fx=f, fy=f, cx=160, cy=100, distortion=(k1, k2, p1, p2), **sizes)
    assert round_trip(camera) < 1e-3


@settings(max_examples=40)
@given(st.floats(250, 900), st.lists(st.floats(-0.03, 0.03), min_size=8, max_size=8), st.sampled_from([5, 8]))
def test_long_opencv_round_trip(f: float, k: list[float], count: int) -> None:
    camera = Camera(model="OPENCV", fx=f, fy=f, cx=160, cy=100, distortion=tuple(k[:count]), **sizes)
    assert round_trip(camera) < 1e-3


@settings(max_examples=60)
@given(st.floats(120, 400), st.floats(-0.04, 0.06), st.floats(-0.01, 0.01), st.floats(-0.003, 0.003))
def test_fisheye_round_trip(f: float, k1: float, k2: float, k3: float) -> None:
    camera = Camera(model="OPENCV_FISHEYE", fx=f, fy=f, cx=160, cy=100, distortion=(k1, k2, k3, 0.0), **sizes)
    assert round_trip(camera) < 1e-3


def test_fisheye_sees_behind() -> None:
    camera = Camera(model="OPENCV_FISHEYE", fx=60, fy=60, cx=160, cy=100, distortion=(0.0,) * 4, **sizes)
    directions, valid = rays(camera, np.array([[160.0 + 60 * 2.0, 100.0]]))  # 2 rad from the axis
    assert valid.all()
    assert directions[0, 2] == pytest.approx(np.cos(2.0))


def test_equirectangular_round_trip_and_axes() -> None:
    camera = Camera(model="EQUIRECTANGULAR", width=400, height=200, fx=1, fy=1, cx=200, cy=100)
    assert round_trip(camera) < 1e-3
    directions, _ = rays(camera, np.array([[200.0, 100.0], [300.0, 100.0], [200.0, 0.0]]))
    assert np.allclose(directions, [[0, 0, 1], [1, 0, 0], [0, -1, 0]], atol=1e-12)


@pytest.mark.parametrize(
    "camera",
    [
        Camera(fx=200, fy=200, cx=160, cy=100, **sizes),
        Camera(model="OPENCV_FISHEYE", fx=60, fy=60, cx=160, cy=100, distortion=(0.1, 0.0, 0.0, 0.0), **sizes),
        Camera(model="EQUIRECTANGULAR", width=400, height=200, fx=200, fy=200, cx=200, cy=100),
    ],
    ids=lambda camera: camera.model,
)
def test_a_small_angle_spans_pixels_in_the_middle(camera: Camera) -> None:
    angle = 1e-4
    (first, second) = project(camera, np.array([[0, 0, 1], [np.sin(angle), 0, np.cos(angle)]]))
    assert (second - first)[0] / angle == pytest.approx(camera.pixels_per_radian, rel=1e-3)


def test_folded_lens_is_marked_invalid() -> None:
    """A strong barrel folds the image over: pixels outside what it can map must be flagged, not invented."""
    camera = Camera(model="OPENCV", fx=100, fy=100, cx=160, cy=100, distortion=(-0.3, 0.0, 0.0, 0.0), **sizes)
    pixels = grid(camera)
    directions, valid = rays(camera, pixels)
    assert 0.2 < valid.mean() < 1
    assert np.abs(project(camera, directions[valid]) - pixels[valid]).max() < 1e-3
    assert valid[np.abs(pixels - [160, 100]).sum(1).argmin()]


def seen_again(camera: Camera) -> float:
    """Of directions all around that lie in the picture, how far the rays of their pixels are from them at most; at the fold, where
    the picture stands still, rays are less exact."""
    directions = np.random.default_rng(0).normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        pixel = project(camera, directions)
        inside = ((pixel >= 0) & (pixel <= [camera.width, camera.height])).all(1)
    back, valid = rays(camera, pixel[inside])
    assert inside.sum() > 100
    return float(np.abs(back - directions[inside])[valid].max())


@settings(max_examples=60)
@given(st.floats(150, 400), st.floats(-0.15, 0.15), st.floats(-0.2, 0.05))
def test_what_lies_beyond_the_fold_of_a_lens_is_not_in_the_picture(f: float, k1: float, k2: float) -> None:
    lens = {"fx": f, "fy": f, "cx": 160, "cy": 100, **sizes}
    assert seen_again(Camera(model="OPENCV", distortion=(k1, k2, 0.0, 0.0), **lens)) < 0.01


@pytest.mark.parametrize("p1", [-0.03, 0.0, 0.05])
@pytest.mark.parametrize("p2", [-0.05, 0.02, 0.05])
def test_lenses_that_bend_back_on_one_side_show_the_other_whole(p1: float, p2: float) -> None:
    camera = Camera(model="OPENCV", fx=150, fy=150, cx=160, cy=100, distortion=(0.0, 0.0, p1, p2), **sizes)
    pixels = grid(camera)
    directions, valid = rays(camera, pixels)
    with np.errstate(invalid="ignore"):
        off = np.abs(project(camera, directions[valid]) - pixels[valid]).max(1)
    assert np.isfinite(off).mean() > 0.995
    assert np.nanmax(off) < 1e-3
    assert seen_again(camera) < 0.02


@settings(max_examples=60)
@given(st.floats(60, 200), st.floats(-0.05, 0.05), st.floats(-0.02, 0.01), st.floats(-0.001, 0.004))
def test_what_a_fisheye_does_not_see_is_not_in_the_picture(f: float, k1: float, k2: float, k3: float) -> None:
    lens = {"fx": f, "fy": f, "cx": 160, "cy": 100, **sizes}
    assert seen_again(Camera(model="OPENCV_FISHEYE", distortion=(k1, k2, k3, -0.0008), **lens)) < 0.01


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", [300, 161, 99]),
        ("PINHOLE", [300, 310, 161, 99]),
        ("SIMPLE_RADIAL", [300, 161, 99, 0.08]),
        ("RADIAL", [300, 161, 99, 0.08, -0.02]),
        ("OPENCV", [300, 310, 161, 99, 0.08, -0.02, 0.003, -0.004]),
        ("FULL_OPENCV", [300, 310, 161, 99, 0.08, -0.02, 0.003, -0.004, 0.01, 0.02, -0.01, 0.005]),
        ("OPENCV_FISHEYE", [300, 310, 161, 99, 0.05, -0.01, 0.002, -0.001]),
        ("SIMPLE_RADIAL_FISHEYE", [300, 161, 99, 0.05]),
        ("RADIAL_FISHEYE", [300, 161, 99, 0.05, -0.01]),
    ],
)
def test_projects_like_colmap(model: str, params: list[float]) -> None:
    theirs = pycolmap.Camera(model=model, width=320, height=200, params=params)
    ours = camera_from_colmap(model, 320, 200, params)
    points = np.random.default_rng(0).uniform([-0.5, -0.3, 1.0], [0.5, 0.3, 1.5], (200, 3))
    assert np.abs(project(ours, points) - np.asarray(theirs.img_from_cam(points))).max() < 1e-9


def test_unknown_colmap_model_is_named() -> None:
    with pytest.raises(InputError, match="FOV"):
        camera_from_colmap("FOV", 320, 200, [300, 300, 160, 100, 0.9])


def test_resizing_keeps_directions() -> None:
    camera = Camera(model="OPENCV", fx=300, fy=310, cx=150, cy=90, distortion=(0.1, -0.02, 0.001, 0.002), **sizes)
    half = camera.resized(160, 100)
    pixels = grid(camera)
    assert np.allclose(rays(camera, pixels)[0], rays(half, pixels / 2)[0])


@pytest.mark.parametrize(("width", "height"), [(160, 160), (90, 200), (640, 100)])
def test_reframing_cuts_the_same_from_opposite_sides_and_keeps_pixels_square(width: int, height: int) -> None:
    camera = Camera(fx=300, fy=310, cx=150, cy=90, **sizes)
    cut = camera.reframed(width, height)
    assert (cut.width, cut.height) == (width, height)
    assert np.isclose(cut.fx / cut.fy, 300 / 310)
    corners = np.array([[0.0, 0.0], [width, height]])
    scale = 300 / cut.fx
    seen = (corners - [width / 2, height / 2]) * scale + [camera.width / 2, camera.height / 2]
    assert np.allclose(rays(cut, corners)[0], rays(camera, seen)[0])
    assert np.isclose(np.ptp(seen, axis=0), [camera.width, camera.height]).any()
    assert (seen >= -1e-9).all()
    assert (seen <= [camera.width + 1e-9, camera.height + 1e-9]).all()


def test_points_behind_have_no_pixel() -> None:
    camera = Camera(fx=300, fy=300, cx=160, cy=100, **sizes)
    assert np.isnan(project(camera, np.array([[0.0, 0, -1]]))).all()


def test_axes_flip_is_its_own_inverse() -> None:
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    flipped = flip_camera_axes(pose)
    assert np.array_equal(flip_camera_axes(flipped), pose)
    assert not np.signbit(flip_camera_axes(np.eye(4))[3]).any()  # files would show −0
    # A Blender camera looks along −z: the OpenCV viewing axis must come out as its −z.
    assert np.array_equal(flipped[:3, 2], -pose[:3, 2])
    assert np.array_equal(flipped[:3, 0], pose[:3, 0])
