"""Watertight surfaces: closed for other programs too, true where views look, and marked where they do not."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.mesh import clean, depth_maps, triangles
from fieldwork.nerfcore.mesh.closed import closed_surface, drop_unseen, extract_closed, unseen_faces
from fieldwork.nerfcore.mesh.decimate import decimate, decimate_closed, single
from fieldwork.nerfcore.mesh.fusion import BRICK, Bricks, fuse_maps
from fieldwork.nerfcore.mesh.region import choose_region
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.depth_views import maps_of, orbit, sphere


def closed_sphere(front: float, cells: int = 48) -> tuple[trimesh.Trimesh, np.ndarray, float]:
    """The closed surface of a ball of radius 0.5 that is seen from where x > `front`, its unseen faces and the voxel."""
    poses = [pose for pose in orbit(30, 1.8) if pose[0, 3] > front]
    maps = depth_maps.confirmed_maps(*maps_of(sphere(0.5), poses), torch.device("cpu"), Reporter())
    region = choose_region(maps, None, cells)
    vertices, faces = extract_closed(fuse_maps(maps, region, Reporter()), maps, Reporter())
    vertices, faces = triangles.compact(vertices, clean.drop_scraps(vertices, faces))
    unseen = unseen_faces(vertices, faces, maps, 4 * region.voxel, Reporter())
    return trimesh.Trimesh(vertices, faces, process=False), unseen, region.voxel


def test_a_ball_seen_from_all_around_is_a_closed_ball() -> None:
    mesh, unseen, voxel = closed_sphere(-9)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(np.pi / 6, rel=0.02)
    assert unseen.mean() < 0.01
    assert np.quantile(np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.5), 0.95) < 0.5 * voxel


def test_what_nobody_sees_is_closed_and_marked() -> None:
    mesh, unseen, voxel = closed_sphere(0.5)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    center = mesh.triangles_center
    off = np.abs(np.linalg.norm(center, axis=1) - 0.5)
    assert np.quantile(off[~unseen], 0.95) < 0.5 * voxel  # what is seen is true
    assert unseen[(center[:, 0] > 0.15) & (off < voxel)].mean() < 0.02
    back = center[:, 0] < mesh.bounds[0, 0] + 0.5 * voxel  # where the region ends, and with it what views show
    assert mesh.area_faces[back].sum() > 0.3
    assert unseen[back].all()


def test_noise_over_several_blocks_of_bricks_is_closed_too() -> None:
    """Corners known and unknown at random, bricks missing at random, more than one block along an axis."""
    random = np.random.default_rng(0)
    poses = orbit(6, 1.8)
    maps = depth_maps.confirmed_maps(*maps_of(sphere(0.5), poses), torch.device("cpu"), Reporter())
    index = np.full((18, 2, 3), -1, np.int32)
    there = random.random(index.shape) < 0.8
    index[there] = np.arange(there.sum())
    shape = (int(there.sum()), BRICK, BRICK, BRICK)
    distance = random.normal(size=shape).astype(np.float32) * 0.01
    weight = (random.random(shape) < 0.9).astype(np.float32)
    bricks = Bricks(np.array([-0.7, -0.1, -0.1]), 0.01, index, distance, weight)
    vertices, faces = extract_closed(bricks, maps, Reporter())
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    np.testing.assert_array_less(np.array([-0.71, -0.11, -0.11]) - 1e-9, mesh.bounds[0])
    # Sheets so near each other that plain collapses fold them into edges of four triangles.
    plain = trimesh.Trimesh(*decimate(vertices, faces, len(faces) // 3, Reporter()), process=False)
    assert not plain.is_watertight
    fewer = trimesh.Trimesh(*decimate_closed(vertices, faces, len(faces) // 3, Reporter()), process=False)
    assert len(fewer.faces) < len(faces)  # noise leaves little to take away
    assert fewer.is_watertight
    for mesh in plain, fewer:  # no flap of two triangles, and single precision keeps vertices apart
        assert len(np.unique(np.sort(mesh.faces, 1), axis=0)) == len(mesh.faces)
        assert len(np.unique(mesh.vertices.astype(np.float32), axis=0)) == len(mesh.vertices)


def test_of_triangles_with_the_same_corners_one_is_left_or_none() -> None:
    faces = np.array([[0, 1, 2], [1, 2, 0], [3, 4, 5], [5, 4, 3], [2, 4, 6], [6, 2, 4], [4, 2, 6]])
    assert single(faces).tolist() == [0, 4]


def test_fewer_triangles_stay_closed() -> None:
    maps = depth_maps.confirmed_maps(*maps_of(sphere(0.5), orbit(30, 1.8)), torch.device("cpu"), Reporter())
    region = choose_region(maps, None, 64)
    bricks, report = fuse_maps(maps, region, Reporter()), Reporter()
    _, whole = closed_surface(bricks, maps, 4 * region.voxel, None, report)
    mesh = trimesh.Trimesh(*closed_surface(bricks, maps, 4 * region.voxel, len(whole) // 4, report), process=False)
    assert len(mesh.faces) <= 1.1 * len(whole) / 4
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(np.pi / 6, rel=0.02)
    assert report.warnings == []


def test_what_hangs_in_unseen_space_goes() -> None:
    """A ball that views see, and one behind it that none does."""
    flats, rendered = maps_of(sphere(0.5), orbit(24, 1.8))
    maps = depth_maps.confirmed_maps(flats, rendered, torch.device("cpu"), Reporter())
    balls = [trimesh.creation.icosphere(3, 0.5), trimesh.creation.icosphere(3, 0.1)]
    both = trimesh.util.concatenate(balls)
    vertices, faces = np.array(both.vertices), np.array(both.faces)
    kept = drop_unseen(vertices, faces, maps, 0.05, Reporter())
    np.testing.assert_array_equal(kept, faces[: len(balls[0].faces)])


def test_closing_stops_when_asked() -> None:
    maps = depth_maps.confirmed_maps(*maps_of(sphere(0.5), orbit(6, 1.8)), torch.device("cpu"), Reporter())
    bricks = fuse_maps(maps, choose_region(maps, None, 32), Reporter())
    report = Reporter()
    report.cancel()
    with pytest.raises(Cancelled):
        extract_closed(bricks, maps, report)
