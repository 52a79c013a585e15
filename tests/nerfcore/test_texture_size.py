"""How many texels a mesh gets, from photos of a wall that show it at known sizes."""

from __future__ import annotations

import numpy as np
import psutil
import pytest
import trimesh
from fieldwork.nerfcore.errors import TrainingError
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.mesh import texture_size as module
from fieldwork.nerfcore.mesh.painted import unwrapped
from fieldwork.nerfcore.mesh.photo_texture import bytes_needed
from fieldwork.nerfcore.mesh.photos import Photo
from fieldwork.nerfcore.mesh.texture_size import TEXELS, texels_needed, texture_size
from fieldwork.nerfcore.mesh.uv import COVERED, PADDING, unwrap
from fieldwork.nerfcore.mesh.visibility import PosedCamera
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.flat import looking, wall_mesh
from hypothesis import given, settings
from hypothesis import strategies as st

SIDE = 1.2  # of the wall
WALL = wall_mesh()[:2]


def photo(pixels: float, away: float = 2.0, side: float = 1.0) -> Photo:
    """A photo from the front (behind: −1) that shows a unit of the wall on so many pixels."""
    wide = round(1.5 * pixels)
    lens = Camera(width=wide, height=wide, fx=pixels * away, fy=pixels * away, cx=wide / 2, cy=wide / 2)
    return Photo(
        PosedCamera(lens, looking((0, 0, 0), (0.01, 0.02, side * away))), lambda: np.zeros((1, 1, 4), np.uint8)
    )


def needed(photos: list[Photo]) -> float:
    return texels_needed(*WALL, photos, Reporter())


@settings(max_examples=40)
@given(pixels=st.floats(100, 5000), away=st.floats(1.5, 20))
def test_there_are_so_many_texels_a_pixel(pixels: float, away: float) -> None:
    # The photo is taken from nearly the front.
    assert needed([photo(pixels, away)]) == pytest.approx(TEXELS * pixels * SIDE, rel=0.01)


def test_the_photo_that_shows_most_decides() -> None:
    photos = [photo(300), photo(1500), photo(700)]
    assert needed(photos) == pytest.approx(needed(photos[1:2]), rel=0.01)


def test_photos_that_do_not_see_the_surface_have_no_say() -> None:
    assert needed([photo(300), photo(3000, side=-1.0)]) == needed([photo(300)])
    assert needed([]) == 0


@given(texels=st.floats(1, 5000), charts=st.integers(1, 40_000))
def test_texels_are_as_small_as_asked_for_beside_the_padding_and_not_half_as_large(texels: float, charts: int) -> None:
    size = texture_size(texels, charts)
    assert size & (size - 1) == 0
    left = [np.sqrt(COVERED) * side - PADDING * np.sqrt(charts) for side in (size, size / 2)]
    assert left[0] >= texels or size == module.LARGEST
    assert left[1] < texels or size == module.SMALLEST


def test_charts_cut_from_a_rough_ball_leave_what_is_reckoned_with() -> None:
    ball = trimesh.creation.icosphere(5)
    rough = ball.vertices * (1 + 0.01 * np.random.default_rng(0).normal(size=(len(ball.vertices), 1)))
    asked = []
    made = unwrap(rough, ball.faces, lambda charts: asked.append(charts) or texture_size(1000, charts), Reporter())
    assert asked == [made.chart.max() + 1]
    u, v = made.corners[:, 1] - made.corners[:, 0], made.corners[:, 2] - made.corners[:, 0]
    covered = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2
    assert np.sqrt(covered) * made.size > 0.9 * 1000


def test_what_does_not_fit_into_memory_is_halved(monkeypatch: pytest.MonkeyPatch) -> None:
    plenty = texture_size(2500, 100)
    half = bytes_needed(plenty // 2)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": half})())
    assert texture_size(2500, 100) == plenty // 2
    monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": 0})())
    assert texture_size(2500, 100) == module.SMALLEST


def test_a_mesh_without_area_is_told() -> None:
    nothing, photos = (np.zeros((3, 3)), np.array([[0, 1, 2]])), [photo(300)]
    assert texels_needed(*nothing, photos, Reporter()) == 0
    with pytest.raises(TrainingError, match="no area to unwrap"):
        unwrapped(*nothing, photos, "auto", Reporter())
