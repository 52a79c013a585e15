"""Closed surfaces that touch themselves are cut apart there."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from fieldwork.nerfcore.mesh.surface import is_watertight
from fieldwork.nerfcore.mesh.unfold import parted, unfolded


def touching(apart: int) -> tuple[np.ndarray, np.ndarray]:
    """Boxes of 1 m that meet in one edge, `apart` of them around it."""
    parts = []
    for number in range(apart):
        box = trimesh.creation.box(bounds=[[0, 0, 0], [1, 0.3, 1]])
        box.apply_transform(trimesh.transformations.rotation_matrix(2 * np.pi * number / apart, [0, 0, 1]))
        parts.append(box)
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + 8 * n for n, part in enumerate(parts)])
    places, index = np.unique(vertices.round(9), axis=0, return_inverse=True)
    return places, index.reshape(-1)[faces]


@pytest.mark.parametrize("apart", [2, 3])
def test_boxes_that_meet_in_an_edge_become_boxes_of_their_own(apart: int) -> None:
    vertices, faces = touching(apart)
    assert not is_watertight(faces)
    made, cut = unfolded(vertices, faces)
    assert is_watertight(cut)
    whole = trimesh.Trimesh(made, cut, process=False)
    assert whole.is_winding_consistent
    assert whole.body_count == apart
    assert whole.volume == pytest.approx(0.3 * apart, rel=0.02)
    assert trimesh.Trimesh(made.astype(np.float32), cut).is_watertight  # also where a reader joins equal places
    assert np.abs(made - vertices[np.linalg.norm(made[:, None] - vertices, axis=2).argmin(1)]).max() < 0.02


def test_sheets_that_touch_and_hang_together_are_parted() -> None:
    """Two tetrahedra at one edge, joined by a third at each of its ends into one body."""
    places = np.array([[0, 0, 0], [0, 0, 1], [1, -0.2, 0.5], [1, 0.2, 0.5], [-1, -0.2, 0.5], [-1, 0.2, 0.5]])
    one, other = (np.array([[0, 1, a], [1, 0, b], [0, a, b], [1, b, a]]) for a, b in ((3, 2), (4, 5)))
    faces = np.concatenate([one, other])
    assert not is_watertight(faces)
    made, cut = parted(places, faces)
    assert is_watertight(cut)
    assert len(cut) == len(faces) + 4  # each sheet has halved both of its triangles, or one of them has: no more
    assert trimesh.Trimesh(made, cut, process=False).is_winding_consistent


def test_what_does_not_touch_itself_stays() -> None:
    ball = trimesh.creation.icosphere(2)
    made, cut = unfolded(np.array(ball.vertices), np.array(ball.faces))
    assert len(made) == len(ball.vertices)
    np.testing.assert_allclose(made[cut], ball.vertices[ball.faces])
