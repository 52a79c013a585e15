"""Depths of the field in holes of what is known: moved as the known ones around were."""

from __future__ import annotations

import numpy as np
import pytest
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.kernels.depth_arrays import FREE
from fieldwork.nerfcore.mesh.completion import moved_as_around, push_pull
from fieldwork.nerfcore.mesh.depth_maps import DepthMap, FlatView, cosines
from hypothesis import given
from hypothesis import strategies as st


def view_and_field(width: int = 37, height: int = 29) -> tuple[FlatView, DepthMap, np.ndarray]:
    """A camera before a slanted wall, its true depths, and a field that has them too small by a share that grows from 2 to 4 %."""
    camera = Camera(width=width, height=height, fx=40.0, fy=40.0, cx=width / 2, cy=height / 2)
    view = FlatView(camera, np.eye(4), 0, np.ones((height, width), bool))
    slope = (np.arange(width) + 0.5 - width / 2)[None] / 40 + 0 * np.arange(height)[:, None]
    true = (2 / (1 - 0.3 * slope)).astype(np.float32)
    field = (true * (0.98 - 0.02 * np.arange(width)[None] / width)).astype(np.float32)
    return view, DepthMap(field, np.full(true.shape, 0.1, np.float32), cosines(camera, field)), true


def test_a_hole_takes_the_fields_depth_as_far_off_as_around_it() -> None:
    view, field, true = view_and_field()
    hole = np.zeros(true.shape, bool)
    hole[8:20, 10:24] = True
    moved = moved_as_around(view, field, np.where(hole, 0, true))
    off = np.abs(moved.depth / true - 1)[hole]
    assert np.abs(field.depth / true - 1)[hole].min() > 0.02
    assert off.max() < 0.006
    np.testing.assert_allclose(moved.cosine, cosines(view.camera, moved.depth))


def test_other_things_and_emptiness_say_nothing_of_a_depth() -> None:
    view, field, true = view_and_field()
    known = np.where(np.arange(true.shape[1])[None] % 2 == 0, 2 * true, FREE).astype(np.float32)
    np.testing.assert_allclose(moved_as_around(view, field, known).depth, field.depth)
    nothing = DepthMap(np.full_like(true, FREE), field.spread, field.cosine)
    np.testing.assert_array_equal(moved_as_around(view, nothing, true).depth, nothing.depth)


@given(st.integers(1, 40), st.integers(1, 40), st.floats(-0.1, 0.1), st.integers(0, 99))
def test_what_is_the_same_everywhere_is_so_in_the_holes(height: int, width: int, value: float, seed: int) -> None:
    known = np.random.default_rng(seed).random((height, width)) < 0.2
    found = push_pull(np.where(known, value, 7.0), known)
    assert found.shape == known.shape
    assert found == pytest.approx(value if known.any() else 0.0, abs=1e-6)


def test_values_that_are_known_hardly_change() -> None:
    values = np.add.outer(np.linspace(0, 0.1, 30), np.linspace(0, 0.05, 20))
    found = push_pull(values, np.ones(values.shape, bool))
    assert np.abs(found - values).max() < 0.01
