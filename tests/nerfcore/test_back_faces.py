"""What hides the back of a surface stays."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.kernels.depth_arrays import MapArrays
from fieldwork.nerfcore.mesh import clean, depth_maps
from fieldwork.nerfcore.mesh.back_faces import hide_back_faces
from fieldwork.nerfcore.mesh.triangles import border_edges
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.depth_views import box, maps_of, orbit, sphere


def seen(hit, count: int = 24) -> MapArrays:
    """Depth maps of a shape from all around."""
    flats, maps = maps_of(hit, orbit(count, 1.8, (-0.6, 0.2, 0.9)))
    return depth_maps.map_arrays(flats, maps, torch.device("cpu"))


def ball(radius: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    made = trimesh.creation.icosphere(4, radius)
    return np.asarray(made.vertices), np.asarray(made.faces)


def toward(vertices: np.ndarray, faces: np.ndarray, way: tuple[float, float, float], cosine: float) -> np.ndarray:
    """Which triangles (F,) bool of a ball lie around a direction from its middle."""
    middle = vertices[faces].mean(1)
    return middle @ np.array(way) > cosine * np.linalg.norm(middle, axis=1) * np.linalg.norm(way)


def test_a_cap_of_a_ball_hides_the_inside_and_stays() -> None:
    vertices, faces = ball()
    cap = toward(vertices, faces, (1, 0.3, 0.5), np.cos(0.5))
    found = hide_back_faces(vertices, faces, ~cap, seen(sphere(0.5)), Reporter())
    assert not found[~cap].any()
    assert found[cap].mean() > 0.9


def test_shells_in_the_air_and_holes_before_nothing_are_not_brought_back() -> None:
    """A shell before a ball hides its front; behind a hole in a sheet that is seen from above there is nothing."""
    vertices, faces = ball()
    outer, shell = ball(0.7)
    around = toward(outer, shell, (1, 0.3, 0.5), np.cos(0.5))
    both = np.concatenate([vertices, outer]), np.concatenate([faces, shell[around] + len(vertices)])
    kept = np.arange(len(both[1])) < len(faces)
    assert not hide_back_faces(*both, kept, seen(sphere(0.5)), Reporter()).any()
    plane = trimesh.creation.box((2.0, 2.0, 0.01)).subdivide_to_size(0.05)
    sheet = np.asarray(plane.vertices), np.asarray(plane.faces)[plane.face_normals[:, 2] > 0.5]
    hole = np.linalg.norm(sheet[0][sheet[1]].mean(1)[:, :2], axis=1) < 0.3
    maps = seen(box(np.array([-1.0, -1.0, -0.01]), np.array([1.0, 1.0, 0.005])))
    assert hole.sum() > 50
    assert not hide_back_faces(*sheet, ~hole, maps, Reporter()).any()


def test_nothing_kept_or_all_of_it_asks_no_view() -> None:
    vertices, faces = ball()
    maps = seen(sphere(0.5), 3)
    for kept in (np.zeros(len(faces), bool), np.ones(len(faces), bool)):
        assert not hide_back_faces(vertices, faces, kept, maps, Reporter()).any()


def test_it_can_be_cancelled() -> None:
    class Stops(Reporter):
        def check(self) -> None:
            raise Cancelled

    vertices, faces = ball()
    with pytest.raises(Cancelled):
        hide_back_faces(vertices, faces, ~toward(vertices, faces, (1, 0, 0), 0.8), seen(sphere(0.5), 3), Stops())


def test_a_cleaned_surface_is_whole_where_views_do_not_know_it() -> None:
    """A ball of which no view knows a cap wider than a hole that is filled: it stays, and is a guess."""
    vertices, faces = ball()
    cap = toward(vertices, faces, (1, 0.3, 0.5), np.cos(0.6))
    flats, maps = maps_of(sphere(0.5), orbit(24, 1.8, (-0.6, 0.2, 0.9)))
    way = np.array([1, 0.3, 0.5]) / np.linalg.norm([1, 0.3, 0.5])
    for flat, map_ in zip(flats, maps):
        local = depth_maps.pixel_directions(flat.camera) * map_.depth[..., None]
        points = local @ flat.pose[:3, :3].T + flat.pose[:3, 3]
        map_.depth[map_.hit & (points @ way > 0.5 * np.cos(0.6))] = 0
    known = depth_maps.map_arrays(flats, maps, torch.device("cpu"))
    assert not clean.shown(vertices, faces, known, 0.03, Reporter())[toward(vertices, faces, (1, 0.3, 0.5), 0.95)].any()
    made, whole, guessed = clean.clean(vertices, faces, known, 0.03, Reporter())
    assert not len(border_edges(whole))
    assert 0.5 * cap.sum() < guessed.sum() < 1.5 * cap.sum()
    inside = toward(made, whole, (1, 0.3, 0.5), np.cos(0.4))
    assert guessed[inside].all()
    np.testing.assert_allclose(np.linalg.norm(made[whole[inside]], axis=2), 0.5, atol=0.01)
