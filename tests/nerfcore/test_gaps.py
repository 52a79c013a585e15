"""Holes and frayed borders of a surface, closed by a guess: what closes, what stays open, and where the guess lies."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.kernels.depth_arrays import MapArrays
from fieldwork.nerfcore.mesh import build, depth_maps
from fieldwork.nerfcore.mesh.build import open_surface
from fieldwork.nerfcore.mesh.extract import extract
from fieldwork.nerfcore.mesh.fusion import Bricks, fuse_maps
from fieldwork.nerfcore.mesh.gaps import Corners, close_gaps, harmonic, looked_through, openings
from fieldwork.nerfcore.mesh.region import Region, choose_region
from fieldwork.nerfcore.mesh.triangles import areas, border_edges, compact, components, cross, unit
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.depth_views import Hit, maps_of, orbit, sphere

RADIUS, HOLE, ISLAND = 0.5, 0.15, 0.04
SIDE = np.array([0, RADIUS, 0])


def scene(hit: Hit, cells: int = 96) -> tuple[Bricks, MapArrays, Region, np.ndarray, np.ndarray]:
    maps = depth_maps.confirmed_maps(*maps_of(hit, orbit(24, 1.8)), torch.device("cpu"), Reporter())
    region = choose_region(maps, None, cells)
    bricks = fuse_maps(maps, region, Reporter())
    return bricks, maps, region, *extract(bricks, Reporter())


@pytest.fixture(scope="module")
def ball() -> tuple[Bricks, MapArrays, Region, np.ndarray, np.ndarray]:
    return scene(sphere(RADIUS))


def torn(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Of a ball the cap above z = −0.2, frayed by waves of 0.04, with a round hole and an island in its middle: bool (F,)."""
    x, y, z = vertices[faces].mean(1).T
    away = np.linalg.norm(vertices[faces].mean(1) - SIDE, axis=1)
    return (z > -0.2 + 0.04 * np.sin(40 * np.arctan2(y, x))) & ((away > HOLE) | (away < ISLAND))


def unveiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if no view looked anywhere: the views of the ball's far side look past what is torn off."""
    monkeypatch.setattr(
        "fieldwork.nerfcore.mesh.gaps.looked_through", lambda vertices, faces, *_: np.zeros(len(faces), bool)
    )


@pytest.mark.parametrize("width", [0.35, 0.7])  # on the grid itself, and sought on coarser ones first
def test_holes_and_frayed_borders_close_and_straight_borders_stay(ball, monkeypatch, width) -> None:
    unveiled(monkeypatch)
    bricks, maps, region, vertices, faces = ball
    kept = torn(vertices, faces)
    closed, triangles, guessed = close_gaps(bricks, vertices, faces[kept], width, maps, Reporter())
    middle, area = closed[triangles].mean(1), areas(closed, triangles)
    hole = np.linalg.norm(middle - SIDE, axis=1) < HOLE + region.voxel
    ring = np.pi * (HOLE**2 - ISLAND**2)  # of a sphere within a chord r, π r²
    assert area[guessed & hole].sum() == pytest.approx(ring, rel=0.06)
    assert components(triangles, len(closed)).max() == 0  # the island is part of it
    off = np.abs(np.linalg.norm(middle, axis=1) - RADIUS)
    assert off[~guessed].max() < 0.5 * region.voxel
    assert off[guessed & hole].max() < 0.9 * HOLE**2 / (2 * RADIUS)  # a flat lid without the island is off by all of it
    # Waves are levelled: no deeper than they were cut, and nearly as far.
    assert middle[:, 2].min() > -0.26
    assert np.isclose(area.sum(), 2 * np.pi * RADIUS * (RADIUS + 0.24), rtol=0.02)
    assert guessed.sum() + kept.sum() <= len(triangles) + 0.01 * len(faces)  # what was there is there
    outward = (unit(cross(closed, triangles)) * unit(middle)).sum(1)
    assert outward.min() > 0  # but for slivers at the seam, far more
    assert np.quantile(outward, 0.002) > 0.5


def test_what_is_wider_stays_open(ball, monkeypatch) -> None:
    unveiled(monkeypatch)
    bricks, maps, _, vertices, faces = ball
    kept = torn(vertices, faces)
    closed, triangles, guessed = close_gaps(bricks, vertices, faces[kept], 0.1, maps, Reporter())
    middle, area = closed[triangles].mean(1), areas(closed, triangles)
    hole = np.linalg.norm(middle - SIDE, axis=1) < HOLE
    assert area[guessed & hole].sum() < 0.05 * np.pi * HOLE**2
    assert area[guessed & ~hole].sum() > 0.05  # the waves are 0.08 wide
    again, same, more = close_gaps(bricks, closed, triangles, 0.1, maps, Reporter())
    assert areas(again, same).sum() == pytest.approx(area.sum(), rel=0.01)
    assert more.sum() < 0.2 * guessed.sum()


def test_views_look_through_an_opening(ball) -> None:
    """What hangs before the ball is looked through, what lies on it is not; of a part that is an opening nothing stays."""
    bricks, maps, region, vertices, faces = ball
    lid = vertices[faces].mean(1)[:, 2] > 0.4
    places, own = compact(vertices, faces[lid])
    hung = places + [0, 0, 8 * region.voxel]
    both, triangles = np.concatenate([places, hung]), np.concatenate([own, own + len(places)])
    found = looked_through(both, triangles, np.ones(len(triangles), bool), bricks, maps, Reporter())
    assert not found[: len(own)].any()
    assert found[len(own) :].all()
    assert not looked_through(both, triangles, np.zeros(len(triangles), bool), bricks, maps, Reporter()).any()
    # A part that bulges into the air is cut there; where most of it does, nothing of it stays.
    away, every = np.linalg.norm(places[:, :2], axis=1), np.ones(len(own), bool)
    for radius, whole in ((0.06, False), (0.28, True)):
        bulge = 8 * region.voxel * np.cos(np.pi / 2 * np.minimum(away / radius, 1))
        bent = places + bulge[:, None] * [0, 0, 1]
        through = looked_through(bent, own, every, bricks, maps, Reporter())
        gone = openings(bent, own, every, through)
        assert gone.all() == whole
        assert gone[away[own].max(1) < radius / 3].all()
        assert whole or not gone[away[own].min(1) > radius + 3 * region.voxel].any()


def test_a_part_that_is_an_opening_closes_by_less(ball, monkeypatch) -> None:
    """The hole at the side is looked through, the waves are not, but a width that closes both joins them to one part."""
    bricks, maps, region, vertices, faces = ball
    kept = torn(vertices, faces)

    def in_the_hole(vertices: np.ndarray, faces: np.ndarray, asked: np.ndarray, *_: object) -> np.ndarray:
        return asked & (np.linalg.norm(vertices[faces].mean(1) - SIDE, axis=1) < HOLE - 3 * region.voxel)

    monkeypatch.setattr("fieldwork.nerfcore.mesh.gaps.looked_through", in_the_hole)
    made = []
    for width in (0.12, 0.7):
        closed, triangles, guessed = close_gaps(bricks, vertices, faces[kept], width, maps, Reporter())
        middle, area = closed[triangles].mean(1), areas(closed, triangles)
        away = np.linalg.norm(middle - SIDE, axis=1)
        made.append(area[guessed & (away > HOLE + 2 * region.voxel)].sum())
        assert area[guessed & (away < HOLE - 3 * region.voxel) & (away > ISLAND + 2 * region.voxel)].sum() < 0.01
    assert made[1] > 0.95 * made[0] > 0.05


def test_harmonic_values_are_means_of_their_neighbours() -> None:
    """Beside the solution of the dense system; a grid's side, and a corner that is not there, have no say."""
    shape = np.array([5, 6, 7])
    random = np.random.default_rng(0)
    kind = random.integers(0, 3, int(shape.prod()))  # unknown, known, absent
    kind[:20] = 1
    unknown, known = np.flatnonzero(kind == 0), np.flatnonzero(kind == 1)
    values = random.normal(size=len(known))
    corners = Corners(shape, known, values, np.zeros(len(known), bool))
    found = harmonic(unknown, corners, None, Reporter())
    place = np.stack(np.unravel_index(np.arange(shape.prod()), tuple(shape)), 1)
    matrix, right = np.zeros((len(unknown), len(unknown))), np.zeros(len(unknown))
    for row, number in enumerate(unknown):
        for other in np.flatnonzero(np.abs(place - place[number]).sum(1) == 1):
            if kind[other] == 2:
                continue
            matrix[row, row] += 1
            if kind[other] == 0:
                matrix[row, np.searchsorted(unknown, other)] -= 1
            else:
                right[row] += values[np.searchsorted(known, other)]
    tied = np.linalg.matrix_rank(matrix)
    expected = np.linalg.lstsq(matrix, right, rcond=None)[0]
    assert tied > 0.9 * len(unknown)
    lone = np.isclose(matrix.diagonal(), 0)
    np.testing.assert_allclose(found[~lone], expected[~lone], atol=0.02)


def test_a_surface_with_its_gaps_closed_says_which_faces_are_guessed(ball, monkeypatch) -> None:
    """Also in fewer triangles."""
    unveiled(monkeypatch)
    bricks, maps, region, vertices, faces = ball
    tear = torn(vertices, faces)
    monkeypatch.setattr(build, "clean", lambda v, f, *_: (v, f[tear], np.zeros(int(tear.sum()), bool)))
    for most in (None, 4000):
        made = build.open_surface(bricks, maps, 4 * region.voxel, region, most, 0.35, Reporter())
        middle, guessed = made[0][made[1]].mean(1), made[2]
        away = np.linalg.norm(middle - SIDE, axis=1)
        ring = (away < HOLE - 3 * region.voxel) & (away > ISLAND + 3 * region.voxel)
        assert guessed[ring].all()
        assert not guessed[(middle[:, 2] > 0) & (away > HOLE + 3 * region.voxel)].any()
        assert len(made[1]) < (len(faces) if most is None else 1.2 * most)
    plain = build.open_surface(bricks, maps, 4 * region.voxel, region, None, 0.0, Reporter())
    assert not plain[2].any()
    assert len(border_edges(plain[1])) > 0


def test_closing_can_be_stopped(ball) -> None:
    bricks, maps, _, vertices, faces = ball

    class Stopped(Reporter):
        calls = 0

        def check(self) -> None:
            self.calls += 1
            if self.calls > 10:
                raise Cancelled

    with pytest.raises(Cancelled):
        close_gaps(bricks, vertices, faces[torn(vertices, faces)], 0.3, maps, Stopped())


def test_nothing_to_close_changes_nothing(ball) -> None:
    bricks, maps, _, vertices, faces = ball
    closed, triangles, guessed = close_gaps(bricks, vertices, faces, 0.3, maps, Reporter())
    assert not guessed.any()
    assert len(triangles) == len(faces)
    assert areas(closed, triangles).sum() == pytest.approx(areas(vertices, faces).sum())


@pytest.mark.parametrize("known", [True, False], ids=["a window", "unknown"])
def test_small_holes_are_filled_but_what_views_look_through_stays_open(known: bool) -> None:
    """A board with a window before a wall, from in front; or with a place of which no view knows anything."""
    board, wall, wide = 0.3, -0.2, 0.09

    def hit(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            to_board, to_wall = -origin[2] / direction[:, 2], (wall - origin[2]) / direction[:, 2]
        place = np.abs(origin + direction * np.nan_to_num(to_board)[:, None])[:, :2].max(1)
        there = (to_board > 0) & (place < board) & (place > wide / 2)
        return np.where(there, to_board, np.where(to_wall > 0, to_wall, np.inf))

    poses = [pose for pose in orbit(40, 1.2, (0.8, 0.9, 0.97)) if pose[2, 3] > 0]
    flats, shown = maps_of(hit, poses)
    if not known:
        for flat, map_ in zip(flats, shown):
            ray = depth_maps.pixel_directions(flat.camera) @ flat.pose[:3, :3].T
            place = flat.pose[:3, 3] - ray * (flat.pose[2, 3] / ray[..., 2])[..., None]
            map_.depth[np.abs(place[..., :2]).max(-1) <= wide / 2] = 0
    maps = depth_maps.map_arrays(flats, shown, torch.device("cpu"))
    region = choose_region(maps, (np.array([-0.35, -0.35, -0.25]), np.array([0.35, 0.35, 0.1])), 96)
    bricks = fuse_maps(maps, region, Reporter())
    vertices, faces, guessed = open_surface(bricks, maps, 4 * region.voxel, region, None, 0.0, Reporter())
    middle, area = vertices[faces].mean(1), areas(vertices, faces)
    before = middle[:, 2] > wall / 2
    inside = before & (np.abs(middle[:, :2]).max(1) < wide / 2)
    assert area[before & ~inside].sum() == pytest.approx(4 * board**2 - wide**2, rel=0.15)
    if known:
        assert not (before & (np.abs(middle[:, :2]).max(1) < wide / 4)).any()
    else:
        assert area[inside].sum() == pytest.approx(wide**2, rel=0.2)
        assert guessed[before & (np.abs(middle[:, :2]).max(1) < wide / 4)].all()
        assert np.abs(middle[inside, 2]).max() < region.voxel
