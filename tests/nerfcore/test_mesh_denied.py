"""Parts of a surface that photos deny are told from true ones, plain ones and those that few photos show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy
from fieldwork.nerfcore.data.scene import Scene, View
from fieldwork.nerfcore.geometry.cameras import Camera, pixel_centers, rays
from fieldwork.nerfcore.mesh.build import not_refuted
from fieldwork.nerfcore.mesh.denied import AGREE, agreement, denied
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.render.verb import look_at
from fieldwork.nerfcore.verdict import mesh_verdict
from PIL import Image

CAMERA = Camera(width=240, height=180, fx=200, fy=200, cx=120, cy=90)
EYES = [np.array([x, y, 5.0]) for x in (-1.5, -0.5, 0.5, 1.5) for y in (-0.6, 0.6)]
PLATE = np.array([-1.2, 0.0, 1.0])  # middle of a true part before the wall
SCRAP = np.array([1.0, 0.0, 1.0])  # of one that is not there
HALF = 0.4


def texture(seed: int, fine: float) -> np.ndarray:
    noise = scipy.ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(400, 400)), fine, mode="wrap")
    return 128 + 40 * noise / noise.std()


def sampled(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A texture over [−5, 5]² at places (N,)."""
    return scipy.ndimage.map_coordinates(picture, [(y + 5) * 40, (x + 5) * 40], order=1, mode="wrap")


def photos(folder: Path, plain: bool, contrast: float = 1.0) -> list[View]:
    """A wall at z = 0 and a plate before it, both with a texture, the wall without one where it is `plain`; with less
    `contrast` both are lighter towards one side instead."""
    wall, plate = texture(0, 3.0), texture(1, 3.0)
    views = []
    for number, eye in enumerate(EYES):
        pose = look_at(eye, np.array([0.0, 0.0, 0.5]), np.array([0.0, 1.0, 0.0]))
        local, _ = rays(CAMERA, pixel_centers(CAMERA.width, CAMERA.height).reshape(-1, 2))
        ways = local @ pose[:3, :3].T
        near, far = (eye + ways * ((z - eye[2]) / ways[:, 2])[:, None] for z in (PLATE[2], 0.0))
        inside = (np.abs(near[:, :2] - PLATE[:2]) < HALF).all(1)
        behind = np.full(len(far), 128.0) if plain else sampled(wall, *far[:, :2].T)
        grey = np.where(inside, sampled(plate, *near[:, :2].T), behind)
        grey = 128 + contrast * (grey - 128) + (1 - contrast) * 10 * far[:, 0]
        grey += np.random.default_rng(number).normal(size=len(grey))
        pixels = np.clip(grey, 0, 255).astype(np.uint8).reshape(CAMERA.height, CAMERA.width)
        Image.fromarray(np.repeat(pixels[..., None], 3, 2)).save(folder / f"{number}.png")
        views.append(View(str(number), CAMERA, pose, folder / f"{number}.png"))
    return views


def square(middle: np.ndarray, half: float, cells: int) -> tuple[np.ndarray, np.ndarray]:
    side = np.linspace(-half, half, cells + 1)
    vertices = np.stack([*np.meshgrid(side, side), np.zeros((cells + 1, cells + 1))], -1).reshape(-1, 3) + middle
    a = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    b, c, d = a + 1, a + cells + 1, a + cells + 2
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


@pytest.fixture
def surface() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Wall, plate and scrap: vertices, faces, and of which of the three each face is."""
    parts = [square(np.zeros(3), 3.0, 60), square(PLATE, HALF, 12), square(SCRAP, HALF, 12)]
    starts = np.cumsum([0, *(len(v) for v, _ in parts)])
    faces = np.concatenate([f + start for (_, f), start in zip(parts, starts)])
    return np.concatenate([v for v, _ in parts]), faces, np.repeat(np.arange(3), [len(f) for _, f in parts])


def test_only_the_part_that_is_not_there_is_denied(
    tmp_path: Path, surface: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> None:
    vertices, faces, part = surface
    views = photos(tmp_path, plain=False)
    assert np.array_equal(denied(vertices, faces, views, Reporter()), part == 2)
    assert not denied(vertices, faces, views[:2], Reporter()).any(), "two photos are one pair"
    assert not denied(vertices, faces[part == 2], views, Reporter()).any(), "the largest part stays"
    assert len(denied(vertices, faces[:0], views, Reporter())) == 0
    assert not denied(vertices + [0, 0, 50], faces, views, Reporter()).any(), "it lies behind all cameras"


def test_a_surface_of_more_parts_than_pieces_is_judged_too(
    tmp_path: Path, surface: tuple[np.ndarray, np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    vertices, faces, part = surface
    monkeypatch.setattr("fieldwork.nerfcore.mesh.denied.MOST_PIECES", 1)
    assert np.array_equal(denied(vertices, faces, photos(tmp_path, plain=False), Reporter()), part == 2)


def test_what_a_mask_says_to_ignore_is_not_compared(
    tmp_path: Path, surface: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> None:
    """As the photographer, or the car that the cameras are on."""
    vertices, faces, part = surface
    views, mask = photos(tmp_path, plain=False), np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    mask[CAMERA.height // 2 :] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    other = texture(5, 3.0)
    for number, view in enumerate(views):
        with Image.open(view.image) as image:
            pixels = np.array(image)
        shown = np.roll(other, 40 * number, 1)[: CAMERA.height, : CAMERA.width, None]
        pixels = np.where(mask[..., None] > 0, pixels, np.clip(shown, 0, 255)).astype(np.uint8)
        Image.fromarray(pixels).save(view.image)
    masked = [replace(view, mask=tmp_path / "mask.png") for view in views]
    assert np.array_equal(denied(vertices, faces, masked, Reporter(), "ignore"), part == 2)
    assert denied(vertices, faces, views, Reporter())[part == 0].any()


def test_photos_say_nothing_of_what_is_plain(
    tmp_path: Path, surface: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> None:
    vertices, faces, _ = surface
    assert not denied(vertices, faces, photos(tmp_path, plain=True), Reporter()).any()


def test_photos_tell_little_detail_from_none(
    tmp_path: Path, surface: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> None:
    """On a wall and a plate of a few grey values, which shine towards one side."""
    vertices, faces, part = surface
    assert np.array_equal(denied(vertices, faces, photos(tmp_path, plain=False, contrast=0.1), Reporter()), part == 2)


def test_photos_of_another_exposure_agree() -> None:
    rng = np.random.default_rng(0)
    shown, places = rng.uniform(40, 120, 300), rng.normal(size=(300, 3))
    assert agreement(np.stack([shown, 1.8 * shown + 20, 0.5 * shown]), places) > 0.99
    assert agreement(rng.uniform(40, 120, (3, 300)), places) < AGREE
    hidden = rng.uniform(40, 120, (3, 300))
    hidden[:, ::2] = np.nan
    hidden[1, 60:] = np.nan
    assert np.isnan(agreement(hidden, places)), "two pairs share too few places"


def test_what_is_lighter_towards_one_side_is_no_agreement() -> None:
    rng = np.random.default_rng(0)
    places = rng.normal(size=(300, 3))
    slope = 100 + places @ [30.0, 10.0, 0.0]
    assert agreement(slope + rng.uniform(-10, 10, (3, 300)), places) < AGREE
    assert agreement(slope + rng.uniform(-10, 10, 300) + rng.uniform(-5, 5, (3, 300)), places) > AGREE


def test_a_piece_of_the_largest_part_that_is_not_there_is_denied(tmp_path: Path) -> None:
    """One surface: the wall, and a half of it that lies too near, as wide as several pieces."""
    vertices, faces = square(np.zeros(3), 3.0, 120)
    raised = np.clip((vertices[:, 0] - 0.5) / 0.1, 0, 1)
    vertices[:, 2] = 0.8 * raised
    views = photos(tmp_path, plain=False)
    bad = denied(vertices, faces, views, Reporter())
    middle = vertices[faces].mean(1)
    shown = (np.abs(middle[:, :2] - PLATE[:2]) > 1.2 * HALF).any(1) & (np.abs(middle[:, :2]) < [2.4, 1.8]).all(1)
    wrong, right = (middle[:, 0] > 1.6) & shown, (middle[:, 0] < -0.1) & shown
    assert bad[wrong].mean() > 0.9
    assert bad[right].mean() < 0.02
    # Where photos disagree on most of it, as with wrong poses, single pieces are not blamed.
    moved = [replace(view, camera_to_world=look_at(eye + [0.3, 0.2, 0.0], np.array([0.4, 0.3, 0.5]), np.array([0.0, 1.0, 0.0])))
             for view, eye in zip(views, np.roll(EYES, 3, axis=0))]  # fmt: skip
    assert not denied(vertices, faces, moved, Reporter()).any()
    assert not denied(vertices, faces, photos(tmp_path, plain=True), Reporter())[right].any()


def test_how_much_photos_deny_is_told(tmp_path: Path, surface: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    vertices, faces, part = surface
    views, report = photos(tmp_path, plain=False), Reporter()
    scene = Scene(views, list(range(len(views))), [])
    kept, share = not_refuted(vertices, faces, scene, report)
    assert np.array_equal(kept, part != 2)
    assert share == pytest.approx(0.02, abs=0.005)
    assert report.warnings == []
    assert mesh_verdict(0.9, denied=share)["level"] == "good"
    near = part > 0
    kept, share = not_refuted(vertices, faces[near], scene, report)
    assert np.array_equal(kept, part[near] != 2)
    assert share == pytest.approx(0.5, abs=0.005)
    told = mesh_verdict(0.9, denied=share)
    assert told["level"] == "weak"
    assert "disagree on 50% of the surface" in told["reasons"][0]
    assert "disagree on 50 % of the surface" in report.warnings[0]
