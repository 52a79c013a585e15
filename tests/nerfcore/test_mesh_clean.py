"""What a fused surface keeps of its triangles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from fieldwork.nerfcore.kernels.depth_arrays import FREE
from fieldwork.nerfcore.mesh import build, depth_maps
from fieldwork.nerfcore.mesh.clean import FEWEST_VIEWS, seen_by, shown
from fieldwork.nerfcore.mesh.fusion import fuse_maps
from fieldwork.nerfcore.mesh.region import choose_region
from fieldwork.nerfcore.mesh.triangles import border_edges, components, cross, mean_around, unit
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.depth_views import box, maps_of, orbit, sphere

NEAR = 0.06  # within which a view sees what it shows


def grid(across: np.ndarray, up: np.ndarray, cells: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a rectangle from the origin along two directions (3,), its normal their cross product."""
    i, j = np.meshgrid(np.arange(cells + 1), np.arange(cells + 1), indexing="ij")
    vertices = (i[..., None] * across + j[..., None] * up).reshape(-1, 3) / cells
    corner = (i * (cells + 1) + j)[:-1, :-1].reshape(-1, 1)
    faces = np.concatenate([corner + [0, cells + 1, cells + 2], corner + [0, cells + 2, 1]])
    return vertices, faces


def test_what_stands_upright_on_a_table_is_left_out_though_views_see_it() -> None:
    table = box(np.array([-0.6, -0.6, -0.2]), np.array([0.6, 0.6, 0.0]))
    flats, maps = maps_of(table, orbit(30, 1.8, (0.95, 0.9, 0.97)))
    known = depth_maps.confirmed_maps(flats, maps, torch.device("cpu"), Reporter())
    x, y, z = 0.4 * np.eye(3)
    for (vertices, faces), expected in ((grid(x, y), True), (grid(x, 0.05 * z), False)):
        seen = seen_by(vertices[faces].mean(1), unit(cross(vertices, faces)), known, NEAR, Reporter())
        assert (seen >= FEWEST_VIEWS).all()
        assert (shown(vertices, faces, known, NEAR, Reporter()) == expected).all()


def test_single_triangles_that_no_view_sees_are_no_holes_and_single_ones_seen_are_no_surface() -> None:
    ball, random = trimesh.creation.icosphere(4, 0.5), np.random.default_rng(0)
    flats, maps = maps_of(sphere(0.5), orbit(30, 1.8, (0.95, 0.9, 0.97)))
    for map_ in maps:
        map_.depth[random.random(map_.depth.shape) < 0.1] = 0
    known = depth_maps.map_arrays(flats[:12], maps[:12], torch.device("cpu"))
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    single = seen_by(vertices[faces].mean(1), unit(cross(vertices, faces)), known, NEAR, Reporter()) >= FEWEST_VIEWS
    kept = shown(vertices, faces, known, NEAR, Reporter())
    assert 0.2 < kept.mean() < 0.8
    assert len(border_edges(faces[kept])) < 0.5 * len(border_edges(faces[single]))
    assert (kept != single).mean() < 0.1


def test_slopes_that_are_not_certain_contradict_nothing() -> None:
    table = box(np.array([-0.6, -0.6, -0.2]), np.array([0.6, 0.6, 0.0]))
    flats, maps = maps_of(table, orbit(30, 1.8, (0.95, 0.9, 0.97)))
    known = depth_maps.confirmed_maps(flats, maps, torch.device("cpu"), Reporter())
    x, _, z = 0.4 * np.eye(3)
    strand = grid(x, 0.05 * z)
    assert (known.certain[known.depth < FREE] == 1).all()
    for certain, expected in ((1.0, False), (0.0, True)):
        believed = replace(known, certain=torch.full_like(known.certain, certain))
        assert (shown(*strand, believed, NEAR, Reporter()) == expected).all()


def test_values_of_triangles_spread_over_their_neighbours() -> None:
    mesh = trimesh.creation.icosphere(3)
    faces, random = np.asarray(mesh.faces), np.random.default_rng(0)
    noise = random.normal(2.0, 1.0, len(faces))
    calm = mean_around(faces, noise, len(mesh.vertices), 6)
    assert calm.std() < 0.2 * noise.std()
    assert abs(calm.mean() - noise.mean()) < 0.05
    np.testing.assert_allclose(mean_around(faces, np.ones(len(faces)), len(mesh.vertices), 3), 1)


def test_what_simplifying_tears_off_does_not_hang_in_the_air(monkeypatch: pytest.MonkeyPatch) -> None:
    """A few triangles without a border, where there was a thin strand."""
    maps = depth_maps.confirmed_maps(*maps_of(sphere(0.5), orbit(24, 1.8)), torch.device("cpu"), Reporter())
    region = choose_region(maps, None, 48)
    lump = trimesh.creation.icosphere(0, 0.5 * region.voxel)

    def torn(vertices: np.ndarray, faces: np.ndarray, target: int, report: Reporter) -> tuple[np.ndarray, np.ndarray]:
        return np.concatenate([vertices, lump.vertices]), np.concatenate([faces, lump.faces + len(vertices)])

    monkeypatch.setattr(build, "decimate", torn)
    bricks = fuse_maps(maps, region, Reporter())
    vertices, faces, _ = build.open_surface(bricks, maps, 4 * region.voxel, region, 1000, 0.0, Reporter())
    assert len(faces) > 1000
    assert components(faces, len(vertices)).max() == 0
    assert len(np.unique(faces)) == len(vertices)
