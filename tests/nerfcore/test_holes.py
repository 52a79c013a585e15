"""Small holes of a surface, filled."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.mesh.holes import LONGEST_LOOP, border_loops, fill_holes
from fieldwork.nerfcore.mesh.surface import is_watertight
from fieldwork.nerfcore.mesh.triangles import areas, border_edges, cross, unit
from fieldwork.tests.nerfcore.test_mesh_clean import grid
from hypothesis import given, settings
from hypothesis import strategies as st

FLAT = grid(np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), 24)


def ball(detail: int = 5) -> tuple[np.ndarray, np.ndarray]:
    made = trimesh.creation.icosphere(detail)
    return np.asarray(made.vertices), np.asarray(made.faces)


def sound(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether no edge has more than one triangle on a side, and each has an area."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return len(np.unique(edges, axis=0)) == len(edges) and bool((areas(vertices, faces) > 0).all())


def test_small_sheets_get_no_back() -> None:
    vertices, faces = grid(np.array([0.3, 0.1, 0.2]), np.array([0.0, 0.4, 0.1]), 6)
    _, after, filled = fill_holes(vertices, faces)
    assert len(after) == len(faces)
    assert not filled.any()
    hole = np.delete(faces, 14, axis=0)  # in its middle
    vertices, after, filled = fill_holes(vertices, hole)
    assert filled.sum() == 1
    assert (unit(cross(vertices, after)) @ unit(cross(vertices, after))[0] > 0.99).all()
    tube = trimesh.creation.cylinder(1.0, 3.0, sections=12)
    open_ = tube.faces[np.abs(tube.face_normals[:, 2]) < 0.5]
    vertices, after, filled = fill_holes(np.asarray(tube.vertices), np.asarray(open_))
    assert is_watertight(after)
    assert areas(vertices, after[filled]).sum() == pytest.approx(2 * 12 / 2 * np.sin(np.pi / 6)), "both ends"


@pytest.mark.parametrize("wide", [0.04, 0.1, 0.2])
def test_a_hole_in_a_ball_is_filled_by_a_membrane(wide: float) -> None:
    vertices, faces = ball()
    gone = np.linalg.norm(vertices[faces].mean(1) - [1, 0, 0], axis=1) < wide
    after, filled, new = fill_holes(vertices, faces[~gone])
    assert is_watertight(filled)
    assert sound(after, filled)
    np.testing.assert_array_equal(after[: len(vertices)], vertices)
    assert ((cross(after, filled) * after[filled].mean(1)).sum(1) > 0).all(), "outward"
    depth = 1 - np.linalg.norm(after[filled[new]].mean(1), axis=1)
    assert depth.max() < 1.1 * wide**2 / 2 + 0.001, "a membrane lies as deep as its rim"
    longest = np.linalg.norm(np.diff(after[filled[new][:, [0, 1, 2, 0]]], axis=1), axis=2).max()
    rim = np.linalg.norm(np.diff(after[border_edges(faces[~gone])], axis=1), axis=2).max()
    assert longest < 1.6 * rim


def test_longer_loops_stay() -> None:
    vertices, faces = ball()
    gone = np.linalg.norm(vertices[faces].mean(1) - [1, 0, 0], axis=1) < 0.5
    (loop,) = border_loops(faces[~gone])
    assert len(loop) > LONGEST_LOOP
    after, _, new = fill_holes(vertices, faces[~gone])
    assert not new.any()
    assert len(after) == len(vertices)
    assert is_watertight(fill_holes(vertices, faces[~gone], len(loop))[1])


def test_holes_that_meet_in_a_corner_are_two() -> None:
    vertices, faces = FLAT
    middle = vertices[faces].mean(1)[:, :2] * 24
    one, other = ((np.abs(middle - place) < 2).all(1) for place in ((8, 8), (12, 12)))
    kept = faces[~one & ~other]
    loops = [loop for loop in border_loops(kept) if len(loop) < 90]
    assert sorted(map(len, loops)) == [16, 16]
    assert len(np.intersect1d(*loops)) == 1
    after, filled, _ = fill_holes(vertices, kept)
    assert sound(after, filled)
    assert areas(after, filled).sum() == pytest.approx(1)


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.5))
def test_ragged_holes_in_a_plane_are_filled_flat(seed: int, share: float) -> None:
    """Whatever triangles are missing in the middle of a plane: what is filled lies in it, covers nothing twice, and shares edges."""
    vertices, faces = FLAT
    middle = vertices[faces].mean(1)[:, :2]
    random = np.random.default_rng(seed)
    gone = (np.abs(middle - 0.5) < 0.3).all(1) & (random.random(len(faces)) < share)
    before, longest = faces[~gone], max(len(loop) for loop in border_loops(faces[~gone]) if len(loop) < 96)
    after, filled, new = fill_holes(vertices, before, longest)
    assert np.abs(after[filled[new], 2]).max() < 1e-9
    assert cross(after, filled[new])[:, 2].min() > -1e-12
    edges = np.concatenate([filled[:, [0, 1]], filled[:, [1, 2]], filled[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert areas(after, filled[new]).sum() <= areas(vertices, faces[gone]).sum() * (1 + 1e-9)
    unclear = [loop for loop in border_loops(filled) if len(loop) < 96]
    assert len(unclear) <= 0.1 * len(list(border_loops(before)))


def test_a_loop_that_crosses_itself_from_everywhere_is_filled() -> None:
    """The border of a ball between two waves up to the poles, like the seam of a tennis ball."""
    vertices, faces = ball(4)
    angle, height = np.arctan2(vertices[:, 1], vertices[:, 0]), vertices[:, 2]
    inside = height > 0.6 * np.cos(2 * angle)
    kept = faces[inside[faces].all(1)]
    (loop,) = border_loops(kept)
    after, filled, new = fill_holes(vertices, kept, len(loop))
    assert is_watertight(filled)
    assert 0 < areas(after, filled[new]).sum() < 4 * np.pi


def test_filling_stops_when_told() -> None:
    vertices, faces = ball()
    middle = vertices[faces].mean(1)
    gone = (np.linalg.norm(middle - [1, 0, 0], axis=1) < 0.1) | (np.linalg.norm(middle - [0, 1, 0], axis=1) < 0.1)

    def stop() -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        fill_holes(vertices, faces[~gone], check=stop)
