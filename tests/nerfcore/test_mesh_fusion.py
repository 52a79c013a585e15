"""Depth maps of analytic shapes fused into surfaces: nothing is learned here, so that every error is the fusion's."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.data.scene import View
from fieldwork.nerfcore.errors import Cancelled, SettingError, TrainingError
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.geometry.similarity import make_similarity, transform_points
from fieldwork.nerfcore.kernels.depth_arrays import FREE, MapArrays
from fieldwork.nerfcore.mesh import clean, depth_maps, fusion, metrics, triangles
from fieldwork.nerfcore.mesh.closed import extract_closed
from fieldwork.nerfcore.mesh.decimate import decimate
from fieldwork.nerfcore.mesh.extract import extract, weld
from fieldwork.nerfcore.mesh.fusion import (
    BRICK,
    Bricks,
    coarser,
    fuse_maps,
    is_soft,
    mean_spread,
    spread_of,
    tolerances,
)
from fieldwork.nerfcore.mesh.region import Region, choose_region, drawn_in, on_sides, sides_of
from fieldwork.nerfcore.mesh.surface import is_watertight
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.depth_views import CAMERA, Hit, box, look_at, maps_of, orbit, sphere
from scipy.spatial.transform import Rotation

CPU = torch.device("cpu")


def surface_of(
    hit: Hit, poses: list[np.ndarray], cells: int, camera: Camera = CAMERA, voxel: float | None = None
) -> tuple[np.ndarray, np.ndarray, MapArrays, float]:
    maps = depth_maps.confirmed_maps(*maps_of(hit, poses, camera), CPU, Reporter())
    region = choose_region(maps, None, cells, voxel)
    vertices, faces = extract(fuse_maps(maps, region, Reporter()), Reporter())
    return vertices, faces, maps, region.voxel


LENSES = {
    "pinhole": CAMERA,
    "distorted": CAMERA.model_copy(update={"model": "OPENCV", "distortion": (-0.25, 0.06, 0.002, -0.003)}),
}


@pytest.mark.parametrize("lens", LENSES)
def test_a_sphere_comes_back_as_a_closed_sphere(lens: str) -> None:
    vertices, faces, _, voxel = surface_of(sphere(0.5), orbit(24, 1.8), 64, LENSES[lens])
    assert is_watertight(faces)
    radius = np.linalg.norm(vertices, axis=1)
    # Half a pixel is 0.008 here: distances along the ray taken for depths, or corners for centres, would show.
    assert np.median(radius) == pytest.approx(0.5, abs=0.0015)
    assert np.quantile(np.abs(radius - 0.5), 0.95) < 0.25 * voxel
    outward = (triangles.cross(vertices, faces) * vertices[faces].mean(1)).sum(1)
    assert (outward > 0).all()
    assert triangles.areas(vertices, faces).sum() == pytest.approx(np.pi, rel=0.01)


@pytest.mark.parametrize(("voxel", "free"), [(1e-7, 64 << 30), (0.01, 1 << 20)], ids=["of the grid", "of its bricks"])
def test_no_memory_for_fine_cells_is_said_before_they_are_made(
    monkeypatch: pytest.MonkeyPatch, voxel: float, free: int
) -> None:
    monkeypatch.setattr(fusion.psutil, "virtual_memory", lambda: SimpleNamespace(available=free))
    with pytest.raises(SettingError, match=r"cells needs .* GB of memory") as caught:
        surface_of(sphere(0.5), orbit(6, 1.8), 64, voxel=voxel)
    assert "--detail" in (caught.value.hint or "")


def test_a_plate_of_two_voxels_keeps_both_sides() -> None:
    voxel = 0.02
    half = np.array([0.4, 0.4, voxel])
    vertices, faces, maps, _ = surface_of(box(-half, half), orbit(30, 1.7), 64, voxel=voxel)
    vertices, faces, _ = clean.clean(vertices, faces, maps, 4 * voxel, Reporter())
    normal = triangles.unit(triangles.cross(vertices, faces))[:, 2]
    center = vertices[faces].mean(1)
    core = (np.abs(center[:, :2]) < 0.36).all(1)
    area = triangles.areas(vertices, faces)
    for side in (-1, 1):
        chosen = core & (side * normal > 0.8) & (side * center[:, 2] > 0)
        assert area[chosen].sum() > 0.95 * 0.72**2
        assert np.median(np.abs(center[chosen, 2])) == pytest.approx(voxel, abs=voxel)
    assert not (core & (np.abs(center[:, 2]) < 0.3 * voxel)).any()


def test_a_rod_that_some_views_miss_stays_whole() -> None:
    """Four pixels wide; every fourth view shows what is behind it instead."""
    voxel, half = 0.02, np.array([0.03, 0.03, 0.4])
    flats, maps = maps_of(box(-half, half), orbit(32, 1.7))
    for map_ in maps[::4]:
        map_.depth[:] = FREE
    arrays = depth_maps.map_arrays(flats, maps, CPU)
    vertices, faces = extract(fuse_maps(arrays, choose_region(arrays, None, 64, voxel), Reporter()), Reporter())
    core = np.abs(vertices[faces].mean(1)[:, 2]) < 0.35
    assert triangles.areas(vertices, faces[core]).sum() == pytest.approx(0.7 * 4 * 0.06, rel=0.2)
    assert np.abs(np.abs(vertices[np.unique(faces[core]), :2]).max(1) - 0.03).max() < voxel


def test_views_that_disagree_make_one_surface_where_the_field_is_soft() -> None:
    """Every view has a sphere of another size, up to ten voxels apart: of the surfaces they make, which break each other up,
    one remains."""
    voxel, flats, maps = 0.015, [], []
    for number, pose in enumerate(orbit(32, 1.8)):
        (flat,), (map_,) = maps_of(sphere(0.5 + 2.5 * voxel * (number % 5 - 2)), [pose])
        flats.append(replace(flat, photo=number))
        maps.append(map_)
    border = {}
    for spread in (voxel, 12 * voxel):
        arrays = depth_maps.map_arrays(flats, [replace(m, spread=np.full_like(m.spread, spread)) for m in maps], CPU)
        bricks = fuse_maps(arrays, choose_region(arrays, None, 128, voxel), Reporter())
        assert bricks.wide.any() == (spread > voxel)
        vertices, faces = extract(bricks, Reporter())
        near = tolerances(bricks, vertices, faces, 4 * voxel)
        assert set(near) == ({4 * voxel, 16 * voxel} if spread > voxel else {4 * voxel})
        vertices, faces, _ = clean.clean(vertices, faces, arrays, near, Reporter())
        radius = np.linalg.norm(vertices, axis=1)
        assert 0.5 - 5 * voxel < np.median(radius) < 0.5 + 5 * voxel
        border[spread] = len(triangles.border_edges(faces))
    assert border[12 * voxel] < 0.2 * border[voxel]


def test_a_field_that_is_unsure_in_one_place_only_keeps_what_is_there() -> None:
    """Views disagree about a ball, as in the test above, but are sure of most of what they show besides: no soft field."""
    voxel, flats, maps = 0.015, [], []
    for number, pose in enumerate(orbit(32, 1.8)):
        ball = sphere(0.5 + 2.5 * voxel * (number % 5 - 2))
        (flat,), (map_,) = maps_of(ball, [pose])
        flats.append(replace(flat, photo=number))
        maps.append(replace(map_, spread=np.full_like(map_.spread, 12 * voxel)))
    unsure = depth_maps.map_arrays(flats, maps, CPU)
    region = choose_region(unsure, None, 128, voxel)
    assert fuse_maps(unsure, region, Reporter()).wide.any()
    own = spread_of(unsure)
    assert own[0] == pytest.approx(12 * voxel * own[1])
    others = np.array([0.5 * voxel, 1.0]) * 9 * own[1]  # of maps that show something else
    assert is_soft([own], voxel)
    assert not is_soft([own, others], voxel)
    assert not fuse_maps(unsure, region, Reporter(), spreads=[own, others]).wide.any()


def test_spread_of_a_brick_is_that_of_what_is_seen_in_it_and_around_it() -> None:
    flats, maps = maps_of(sphere(0.5), orbit(12, 1.8))
    left = [flat.pose[0, 3] < 0 for flat in flats]
    maps = [replace(m, spread=np.full_like(m.spread, 0.3 if side else 0.1)) for m, side in zip(maps, left)]
    arrays = depth_maps.map_arrays(flats, maps, CPU)
    found = mean_spread(arrays, np.full(3, -0.8), 0.02, np.full(3, 10))
    assert found.shape == (10, 10, 10)
    assert abs(found[0, 0, 0]) < 1e-9  # nothing is shown there
    assert found[1, 5, 5] > 0.25
    assert found[8, 5, 5] < 0.15
    assert (found[found > 1e-9] > 0.1 - 1e-6).all()
    assert found.max() < 0.3 + 1e-6


def room_poses(count: int) -> list[np.ndarray]:
    poses = []
    for k in range(count):
        angle = 2 * np.pi * k / count
        place = 0.35 * np.array([np.cos(angle), np.sin(angle), 0.2 * (-1) ** k])
        target = place + np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0.9 * (k % 3 - 1)])
        poses.append(look_at(place, target))
    return poses


def test_a_room_from_inside_keeps_its_walls_and_stays_open_outside() -> None:
    wide = Camera(width=120, height=100, fx=60.0, fy=60.0, cx=60.0, cy=50.0)
    high = np.array([1.0, 0.8, 0.5])
    vertices, faces, maps, voxel = surface_of(box(-high, high), room_poses(40), 80, wide)
    vertices, faces, _ = clean.clean(vertices, faces, maps, 4 * voxel, Reporter())
    off = np.abs(np.abs(vertices) - high).min(1)
    assert np.quantile(off, 0.95) < voxel  # no shell around the room, no cap at its region
    normal, center = triangles.unit(triangles.cross(vertices, faces)), vertices[faces].mean(1)
    area = triangles.areas(vertices, faces)
    for axis in range(3):
        for side in (-1, 1):
            wall = (side * center[:, axis] > 0.9 * high[axis]) & (side * normal[:, axis] < -0.8)  # facing inwards
            assert area[wall].sum() > 0.9 * 4 * np.delete(high, axis).prod()


def test_what_no_two_views_see_stays_open() -> None:
    front = [pose for pose in orbit(40, 1.8) if pose[0, 3] > 0.5]
    vertices, faces, maps, voxel = surface_of(sphere(0.5), front, 64)
    vertices, faces, _ = clean.clean(vertices, faces, maps, 4 * voxel, Reporter())
    assert not is_watertight(faces)
    assert len(triangles.border_edges(faces)) > 20
    assert (vertices[:, 0] < -0.45).sum() == 0
    assert np.abs(np.linalg.norm(vertices, axis=1) - 0.5).max() < 2 * voxel


def test_the_surface_ends_where_the_grid_knows_nothing() -> None:
    axis = np.arange(BRICK) - 3.5
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    distance = (np.sqrt(x * x + y * y + z * z) - 2.5).astype(np.float32)[None]
    one = np.zeros((1, 1, 1), np.int32)
    bricks = Bricks(np.full(3, -3.5), 1.0, one, distance, (x > 0).astype(np.float32)[None])
    vertices, faces = extract(bricks, Reporter())
    assert len(faces) > 20
    assert vertices.min(0) == pytest.approx([0.5, -2.5, -2.5], abs=0.15)


def test_the_region_follows_what_is_seen_and_leaves_out_what_is_far() -> None:
    near = sphere(0.5)

    def hit(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        wall = sphere(30.0)(origin, direction)
        found = near(origin, direction)
        few = np.arange(len(direction)) % 211 == 0
        return np.where(np.isfinite(found), found, np.where(few, wall, np.inf))

    maps = depth_maps.confirmed_maps(*maps_of(hit, orbit(16, 1.8)), CPU, Reporter())
    region = choose_region(maps, None, 64)
    assert (region.high < 0.8).all()
    assert (region.low > -0.8).all()
    with pytest.raises(TrainingError, match="region of interest"):
        choose_region(maps, (np.full(3, 2.0), np.full(3, 3.0)), 64)


@pytest.mark.parametrize(("pixel", "cells"), [(0.1, 20), (0.003, 512), (0.001, 2 / 3 * 1000), (0.0001, 1024)])
def test_cells_are_as_fine_as_pixels_between_512_and_1024(pixel: float, cells: float) -> None:
    """`pixel`: its footprint over the region's size."""
    maps = depth_maps.confirmed_maps(*maps_of(sphere(0.5), orbit(6, 1.8)), CPU, Reporter())
    size = choose_region(maps, None, 64).size
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(f"{choose_region.__module__}.footprint", lambda _: pixel * size)
        assert size / choose_region(maps, None, None).voxel == pytest.approx(cells)
        assert size / choose_region(maps, None, 64).voxel == pytest.approx(min(64, 2 / pixel))
        assert choose_region(maps, None, None, 0.123).voxel == 0.123


def test_views_that_agree_on_nothing_are_an_error() -> None:
    flats, maps = maps_of(sphere(0.5), orbit(6, 1.8))
    random = np.random.default_rng(0)
    noisy = [
        depth_maps.DepthMap(m.depth * random.uniform(0.5, 1.5, m.depth.shape).astype(np.float32), m.spread, m.cosine)
        for m in maps
    ]
    arrays = depth_maps.confirmed_maps(flats, noisy, CPU, Reporter())
    with pytest.raises(TrainingError, match="several views agree"):
        choose_region(arrays, None, 64)


def test_fusing_stops_when_asked() -> None:
    maps = depth_maps.confirmed_maps(*maps_of(sphere(0.5), orbit(6, 1.8)), CPU, Reporter())
    region = choose_region(maps, None, 64)
    report = Reporter()
    report.cancel()
    with pytest.raises(Cancelled):
        fuse_maps(maps, region, report)


def test_a_wide_lens_is_cut_into_pinholes_that_cover_it() -> None:
    around = Camera(model="EQUIRECTANGULAR", width=240, height=120, fx=1, fy=1, cx=0, cy=0)
    poses = [
        look_at(p, np.zeros(3)) for p in (np.array([0.3, 0, 0]), np.array([-0.3, 0.1, 0]), np.array([0, 0.3, 0.1]))
    ]
    views = [View(f"{k}", around, pose, image=None) for k, pose in enumerate(poses)]  # type: ignore[arg-type]
    flats = depth_maps.flat_views(views, np.eye(4), 240)
    assert len(flats) == 18
    assert all(flat.inside.all() for flat in flats)
    forward = np.stack([flat.pose[:3, 2] for flat in flats[:6]])
    assert np.abs(forward @ forward.T).sum() == pytest.approx(6 + 6, abs=1e-9)  # six directions along three axes
    assert all(np.linalg.det(flat.pose[:3, :3]) == pytest.approx(1) for flat in flats)
    vertices, _, _, voxel = surface_of(box(np.full(3, -1.0), np.full(3, 1.0)), poses, 48, around)
    off = np.abs(np.abs(vertices) - 1).min(1)
    assert np.quantile(off, 0.9) < voxel


def test_scraps_go_and_small_holes_are_filled() -> None:
    vertices, faces, _, voxel = surface_of(sphere(0.5), orbit(24, 1.8), 64)
    hole = np.linalg.norm(vertices[faces].mean(1) - [0.5, 0, 0], axis=1) < 2 * voxel
    scrap = np.linalg.norm(vertices - [0, 0, 0.5], axis=1) < 1.5 * voxel
    moved = np.concatenate([vertices, vertices[scrap] * 1.5])
    inside = scrap[faces].all(1)
    lookup = np.cumsum(scrap) - 1 + len(vertices)
    broken = np.concatenate([faces[~hole], lookup[faces[inside]]])
    kept = clean.drop_scraps(moved, broken, 0.01)
    assert len(kept) == (~hole).sum()
    points, filled, new = clean.fill_holes(moved, kept)
    assert new.sum() >= 3
    assert is_watertight(filled)
    outward = (triangles.cross(points, filled) * points[filled].mean(1)).sum(1)
    assert (outward > 0).all()


def test_fewer_triangles_keep_shape_and_border() -> None:
    vertices, faces, *_ = surface_of(sphere(0.5), orbit(24, 1.8), 96)
    faces = faces[vertices[faces].mean(1)[:, 2] < 0.2]
    vertices, faces = triangles.compact(vertices, faces)
    border = {tuple(v) for v in vertices[np.unique(triangles.border_edges(faces))].tolist()}
    points, fewer = decimate(vertices, faces, len(faces) // 6, Reporter())
    assert len(fewer) < len(faces) / 5
    assert np.abs(np.linalg.norm(points[fewer].mean(1), axis=1) - 0.5).max() < 0.015
    kept = {tuple(v) for v in points[np.unique(triangles.border_edges(fewer))].tolist()}
    assert kept == border


def test_edges_of_three_triangles_do_not_keep_a_mesh_from_getting_smaller() -> None:
    vertices, faces, *_ = surface_of(sphere(0.5), orbit(24, 1.8), 96)
    some = faces[::40]
    flaps = np.stack([some[:, 0], some[:, 1], len(vertices) + np.arange(len(some))], 1)
    vertices = np.concatenate([vertices, vertices[some].mean(1) * 1.1])
    faces = np.concatenate([faces, flaps])
    _, fewer = decimate(vertices, faces, len(faces) // 6, Reporter())
    assert len(fewer) < len(faces) / 4


def test_a_mesh_full_of_holes_gets_as_small_as_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    from fieldwork.nerfcore.mesh import decimate as module

    side = 41
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    vertices = np.stack([x, y, 0 * x], -1).reshape(-1, 3).astype(np.float64)
    corner = np.flatnonzero(((x % 2 == 0) | (y % 2 == 0)) & (x < side - 1) & (y < side - 1))
    quads = np.stack([corner, corner + side, corner + side + 1, corner + 1], 1)
    faces = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
    monkeypatch.setattr(module, "CHUNK", 300)
    points, fewer = decimate(vertices, faces, len(faces) // 2, Reporter())
    assert len(fewer) <= len(faces) // 2
    assert np.abs(points[:, 2]).max() < 1e-6


def test_scores_of_known_shapes() -> None:
    import trimesh

    ball = trimesh.creation.icosphere(4, 1.0)
    truth = np.asarray(ball.vertices), np.asarray(ball.faces)
    same = metrics.compare(truth, truth, 0.01)
    assert same.f == pytest.approx(1)
    assert same.median < 1e-6
    assert same.area_ratio == pytest.approx(1)
    bigger = metrics.compare((truth[0] * 1.03, truth[1]), truth, 0.02)
    assert bigger.f == 0
    assert bigger.median == pytest.approx(0.03, abs=0.001)
    assert bigger.area_ratio == pytest.approx(1.03**2, rel=0.001)
    half = truth[1][truth[0][truth[1]].mean(1)[:, 2] > 0]
    part = metrics.compare((truth[0], half), truth, 0.02)
    assert part.precision == pytest.approx(1)
    assert part.recall == pytest.approx(0.51, abs=0.02)
    upper = metrics.compare((truth[0], half), truth, 0.02, visible=lambda points, normals: normals[:, 2] > 0)
    assert upper.recall > 0.99
    inner = truth[1] + len(truth[0])
    doubled = metrics.compare(
        (np.concatenate([truth[0], truth[0] * 0.9]), np.concatenate([truth[1], inner])), truth, 0.02
    )
    assert doubled.precision < 0.6


def test_small_triangles_among_large_ones_are_what_is_closest() -> None:
    """No sample of the truth need lie in them."""
    vertices = np.array([[-500.0, -500, 0], [500, -500, 0], [0, 500, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]])
    small = np.array([[3, 4, 5]])
    found = metrics.distances((vertices, small), (vertices, np.concatenate([small[:, ::-1] - 3, small])), count=200)
    assert (found.truth_face == 1).all()
    assert found.to_truth.max() < 1e-6


def test_what_reaches_beyond_a_region_is_drawn_in() -> None:
    low, high = np.zeros(3), np.ones(3)
    points = np.array([[0.5, 0.5, 0.5], [1.02, 0.5, 0.5], [0.5, -0.01, 1.01]])
    moved, beyond = drawn_in(points, Region(low, high, 0.05))
    np.testing.assert_allclose(moved, [[0.5, 0.5, 0.5], [1, 0.5, 0.5], [0.5, 0, 1]])
    assert beyond.tolist() == [False, True, True]
    turn = make_similarity(2.0, Rotation.from_euler("z", 30, degrees=True).as_matrix(), low)
    there = (points - turn[:3, 3]) @ turn[:3, :3] / 4  # in the frame where the box stands at an angle
    moved, beyond = drawn_in(there, Region(there.min(0) - 1, there.max(0) + 1, 0.05, sides_of(low, high, turn)))
    np.testing.assert_allclose(moved @ turn[:3, :3].T, [[0.5, 0.5, 0.5], [1, 0.5, 0.5], [0.5, 0, 1]], atol=1e-12)
    assert beyond.tolist() == [False, True, True]


def test_faces_on_the_sides_of_a_region_are_told() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0.5], [0.5, 0.5, 0.5]])
    faces = np.array([[0, 1, 2], [0, 1, 4], [1, 2, 3]])
    box = Region(np.zeros(3), np.ones(3), 0.1)
    assert on_sides(vertices, faces, box, 1e-3).tolist() == [True, False, False]


def test_vertices_of_a_grid_beyond_32_bits_are_told_apart() -> None:
    """The numbers of the first two edges differ by 2³²: 32 · 4096² · 8."""
    place = np.array([[0.5, 0, 0], [32.5, 0, 0], [1, 4094, 4094]])
    joined, faces = weld(np.concatenate([place, place]), np.array([[0, 1, 2], [3, 4, 5]]))
    assert joined[faces].tolist() == [place.tolist()] * 2
    assert len(joined) == 3


@pytest.mark.parametrize("cells", [64, 50, 45])
def test_a_surface_ends_where_its_region_does_on_every_side(cells: int) -> None:
    """Bricks of eight cells reach beyond the last side of a region."""
    maps = depth_maps.confirmed_maps(*maps_of(sphere(0.5), orbit(24, 1.8)), CPU, Reporter())
    region = choose_region(maps, (np.full(3, -0.2), np.full(3, 0.45)), cells)
    bricks = fuse_maps(maps, region, Reporter())
    open_, closed = extract(bricks, Reporter())[0], extract_closed(bricks, maps, Reporter())[0]
    for vertices, beyond in ((open_, 0.5), (closed, 1.5)):
        assert (vertices.min(0) >= region.low - beyond * region.voxel).all()
        assert (vertices.max(0) <= region.high + beyond * region.voxel).all()
    coarse = extract(coarser(bricks), Reporter())[0]
    assert (coarse.max(0) <= region.high + region.voxel).all()


def test_a_surface_ends_where_its_region_does_at_any_angle() -> None:
    """A box of the world, in which the field's cube stands at an angle: the project was turned since the training."""
    maps = depth_maps.confirmed_maps(*maps_of(sphere(0.5), orbit(24, 1.8)), CPU, Reporter())
    turn = make_similarity(2.0, Rotation.from_euler("zx", [40, 30], degrees=True).as_matrix(), np.array([1.0, 2, 3]))
    low, high = np.array([0.6, 1.4, 2.5]), np.array([1.9, 2.9, 3.7])
    sides = sides_of(low, high, turn)
    region = replace(choose_region(maps, None, 64), sides=sides)
    bricks = fuse_maps(maps, region, Reporter())
    found = extract(bricks, Reporter())[0], extract(coarser(bricks), Reporter())[0]
    for vertices, beyond in zip((*found, extract_closed(bricks, maps, Reporter())[0]), (0.6, 1.1, 0.1)):
        world = transform_points(turn, vertices)
        assert (world >= low - 2 * beyond * region.voxel).all()
        assert (world <= high + 2 * beyond * region.voxel).all()
        assert (world.min(0) < low + 4 * region.voxel).all()  # and not before
        assert (world.max(0) > high - 4 * region.voxel).all()
    assert (
        sides_of(low, high, make_similarity(2.0, Rotation.from_euler("z", 90, degrees=True).as_matrix(), low)) is None
    )
