"""Walls without texture lie on planes, and what is plain before something else does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fieldwork.nerfcore.data.pixels import VOID
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.mesh.depth_maps import DepthMap, FlatView, cosines, pixel_directions
from fieldwork.nerfcore.mesh.scene_planes import Known, known_points
from fieldwork.nerfcore.mesh.walls import (
    Picture,
    Wall,
    any_plain,
    backdrops,
    on_walls,
    picture_of,
    plain_places,
    walls,
)
from fieldwork.nerfcore.progress import Reporter

LENS = Camera(width=400, height=300, fx=275.0, fy=275.0, cx=200.0, cy=150.0)
HALF = np.array([2.0, 1.5, 1.2])  # of the room along its axes
BALL, RADIUS = np.array([0.3, 1.36, -0.3]), 0.4


def looking(x: float, turn: float) -> FlatView:
    """A view from (x, -1, 0) along y, z up, turned around z."""
    pose = np.eye(4)
    right, ahead = np.array([np.cos(turn), np.sin(turn), 0]), np.array([-np.sin(turn), np.cos(turn), 0])
    pose[:3, :3] = np.stack([right, [0, 0, -1], ahead], 1)
    pose[:3, 3] = [x, -1, 0]
    return FlatView(LENS, pose, 0, np.ones((300, 400), bool))


VIEWS = [looking(x, turn) for x, turn in ((-0.9, -0.25), (-0.45, -0.1), (0.0, 0.0), (0.45, 0.1), (0.9, 0.25))]


def room(view: FlatView, ball: bool = False, papered: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Grey (H, W) and depth (H, W) of a room with a patterned floor and plain walls on which pictures hang; ball: a plain one lies
    before the wall; papered: the walls have a pattern too."""
    ray = pixel_directions(LENS) @ view.pose[:3, :3].T
    eye = view.pose[:3, 3]
    with np.errstate(divide="ignore"):
        to_sides = np.where(ray != 0, (np.sign(ray) * HALF - eye) / ray, np.inf)
    depth, side = to_sides.min(2), to_sides.argmin(2)
    place = eye + ray * depth[..., None]
    pattern = 0.5 + 0.2 * np.sin(23 * place[..., 0]) * np.sin(19 * place[..., 1] + 3) + 0.1 * np.sin(31 * place[..., 2])
    hangs = (np.abs(np.abs(place[..., 0]) - 0.8) < 0.3) & (np.abs(place[..., 2] - 0.1) < 0.25) & (side == 1)
    hangs |= (np.abs(place[..., 1] - 0.4) < 0.4) & (np.abs(place[..., 2] - 0.1) < 0.3) & (side == 0)
    floor = (side == 2) & (place[..., 2] < 0)
    grey = np.where(floor | hangs | papered, pattern, 0.85 + 0.01 * place[..., 2] - 0.05 * side)
    if ball:
        along, away = (ray * (BALL - eye)).sum(2), (ray**2).sum(2)
        root = along**2 - away * (((BALL - eye) ** 2).sum() - RADIUS**2)
        near = (along - np.sqrt(np.maximum(root, 0))) / away
        there = (root > 0) & (near < depth)
        grey, depth = np.where(there, 0.95, grey), np.where(there, near, depth)
    return np.round(grey * 255) / 255, depth


def as_map(depth: np.ndarray, spread: float) -> DepthMap:
    depth = depth.astype(np.float32)
    return DepthMap(depth, np.full_like(depth, spread), cosines(LENS, depth))


def pictures(**what: bool) -> tuple[list[Picture], list[np.ndarray]]:
    """What is known of each view, whose plain places the field has up to 12 % too near, and the true depths."""
    made, truths = [], []
    for view in VIEWS:
        grey, depth = room(view, **what)
        plain = plain_places(grey)
        y, x = np.mgrid[:300, :400] / 2.5
        bulge = 1 - 0.12 * np.exp(-(((x - 80) / 60) ** 2) - ((y - 40) / 40) ** 2)
        made.append(picture_of(view, as_map(np.where(plain, depth * bulge, depth), 0.05), ~plain, plain))
        truths.append(depth)
    return made, truths


def known(made: list[Picture]) -> Known:
    return known_points([p.view for p in made], [p.field for p in made], [p.sure for p in made])


def moved_of(made: list[Picture], found: list[Wall], asked: bool = True) -> DepthMap:
    """What becomes of the middle view; asked: the other views are."""
    around = [[other for other in range(len(made)) if asked and other != number] for number in range(len(made))]
    return on_walls(made, around, found, [p.field for p in made], [None] * len(made), Reporter())[2]


def test_an_even_slope_is_plain_and_a_pattern_is_not() -> None:
    y, x = np.mgrid[:60, :80]
    slope = np.round((0.4 + 0.0011 * x - 0.0007 * y) * 255) / 255
    inner = np.s_[4:-4, 4:-4]
    assert plain_places(slope)[inner].all()
    noise = np.random.default_rng(0).normal(0, 2 / 255, slope.shape)
    assert not plain_places(slope + noise).any()
    step = plain_places(slope + 0.1 * (x > 40))
    assert not step[:, 37:45].any()
    assert step[inner][:, :32].all()
    assert step[inner][:, 42:].all()


def test_walls_are_found_where_they_are_and_at_right_angles() -> None:
    made, _ = pictures()
    found = walls(known(made), Reporter())
    assert any_plain(made)
    for normal, offset in (([0, 0, 1], -1.2), ([0, -1, 0], -1.5)):
        (wall,) = [w for w in found if w.normal @ normal > 0.9]
        assert wall.point @ normal == pytest.approx(offset, abs=0.02)
    products = np.abs(np.array([a.normal @ b.normal for a in found for b in found]))
    assert np.minimum(products, 1 - products).max() < 1e-6


def test_a_slanting_roof_is_not_turned() -> None:
    """Points of a floor, and of a plane 5 degrees off a wall that stands at right angles to it: too many leave it if it is turned."""
    rng = np.random.default_rng(0)
    floor = np.stack([*rng.uniform(-2, 2, (2, 6000)), np.zeros(6000)], 1)
    along, up = rng.uniform(-2, 2, 4000), rng.uniform(0, 2, 4000)
    slant = np.stack([along, np.full(4000, 2.0) + np.tan(np.radians(5)) * up, up], 1)
    normals = np.repeat([[0, 0, 1], [0, -np.cos(np.radians(5)), np.sin(np.radians(5))]], [6000, 4000], axis=0)
    footprint = np.full(10000, 0.01)
    points = Known(np.concatenate([floor, slant]), normals, footprint, footprint, np.zeros(10000, np.uint8))
    tilts = [np.degrees(np.arcsin(w.normal[2])) for w in walls(points, Reporter()) if w.normal[1] < -0.9]
    assert any(tilt == pytest.approx(5, abs=0.3) for tilt in tilts)


def test_edges_alone_show_a_wall() -> None:
    """A floor that ends in a skirting, whose points face upwards."""
    rng = np.random.default_rng(0)
    floor = np.stack([*rng.uniform(-2, 2, (2, 8000)), np.zeros(8000)], 1)
    post = np.stack([np.full(3000, -1.0), rng.uniform(-2, 2, 3000), rng.uniform(0, 2, 3000)], 1)
    skirting = np.stack([np.full(400, 1.5), rng.uniform(-2, 2, 400), np.full(400, 0.05)], 1)
    normals = np.repeat([[0, 0, 1], [1, 0, 0], [-0.1, 0, 1]], [8000, 3000, 400], axis=0).astype(float)
    footprint = np.full(11400, 0.01)
    points = Known(np.concatenate([floor, post, skirting]), normals, footprint, footprint, np.zeros(11400, np.uint8))
    (wall,) = [w for w in walls(points, Reporter()) if w.normal[0] < -0.9]
    assert wall.point[0] == pytest.approx(1.5, abs=0.02)


def test_a_plain_wall_lies_on_its_plane_though_the_field_bulges() -> None:
    made, truths = pictures()
    found = walls(known(made), Reporter())
    moved = moved_of(made, found)
    plain = made[2].plain
    before, after = (np.abs(d / truths[2] - 1)[plain] for d in (made[2].field.depth, moved.depth))
    assert (before > 0.05).mean() > 0.3
    assert (after < 0.01).mean() > 0.9
    assert (moved.depth[made[2].sure] == made[2].field.depth[made[2].sure]).all()


def test_a_plain_ball_stays_before_the_wall() -> None:
    """The floor and the wall around it hold all that is known beside it, but other views show their pattern there."""
    made, truths = pictures(ball=True, papered=True)
    found = walls(known(made), Reporter())
    moved = moved_of(made, found)
    assert (made[2].plain & (truths[2] < room(VIEWS[2], papered=True)[1] - 0.05)).sum() > 300
    assert (moved.depth == made[2].field.depth).all()
    # Without other views to ask nothing tells the ball from a part of them.
    assert (moved_of(made, found, asked=False).depth != made[2].field.depth).any()


BACK, ELSEWHERE, A_BALL = 1, 2, 3


def named(made: list[Picture], truths: list[np.ndarray]) -> list[np.ndarray]:
    """Label maps of the wall with the pictures that the views look at, of a ball before it, and of the rest."""
    found = []
    for picture, depth in zip(made, truths):
        empty = room(picture.view)[1]
        y = (picture.view.pose[:3, 3] + pixel_directions(LENS) @ picture.view.pose[:3, :3].T * empty[..., None])[..., 1]
        label = np.where(np.abs(y - HALF[1]) < 1e-6, BACK, ELSEWHERE)
        found.append(np.where(depth < empty - 1e-6, A_BALL, label).astype(np.uint8))
    return found


def labelled(**what: bool) -> tuple[list[Picture], list[np.ndarray], list[np.ndarray], list[Wall], Known]:
    """Pictures, true depths, label maps, all walls and what is known."""
    made, truths = pictures(**what)
    labels = named(made, truths)
    points = known_points([p.view for p in made], [p.field for p in made], [p.sure for p in made], labels)
    return made, truths, labels, walls(points, Reporter()), points


def test_where_labels_tell_a_plain_wall_lies_on_its_plane() -> None:
    made, truths, labels, found, points = labelled()
    around = [[other for other in range(5) if other != number] for number in range(5)]
    moved = on_walls(made, around, backdrops(points, found), [p.field for p in made], labels, Reporter())[2]
    wall = made[2].plain & (labels[2] == BACK)
    before, after = (np.abs(d / truths[2] - 1)[wall] for d in (made[2].field.depth, moved.depth))
    assert (before > 0.05).mean() > 0.3
    assert (after < 0.01).mean() > 0.9


def test_where_labels_tell_a_plain_ball_stays_before_the_wall() -> None:
    """Though nothing else does: no other views are asked."""
    made, _, labels, found, points = labelled(ball=True, papered=True)
    fields = [p.field for p in made]
    assert (on_walls(made, [[]] * 5, found, fields, labels, Reporter())[2].depth != fields[2].depth).any()
    told = on_walls(made, [[]] * 5, backdrops(points, found), fields, labels, Reporter())[2]
    assert (told.depth == fields[2].depth).all()


def test_a_backdrop_has_a_class_and_nothing_behind_it() -> None:
    rng = np.random.default_rng(0)
    front = np.stack([rng.uniform(-1, 1, 4000), np.zeros(4000), rng.uniform(-1, 1, 4000)], 1)
    points = np.concatenate([front, front + [0, 1, 0]])
    kind, footprint = np.repeat([5, 6], 4000).astype(np.uint8), np.full(8000, 0.01)
    known = Known(points, np.tile([0.0, -1, 0], (8000, 1)), footprint, footprint, kind)
    made = [Wall(np.array([0.0, y, 0]), np.array([0.0, -1, 0])) for y in (0.0, 1.0)]
    (wall,) = backdrops(known, made)
    assert wall.point[1] == 1
    assert wall.classes is not None
    assert np.flatnonzero(wall.classes).tolist() == [6]
    assert backdrops(replace(known, kind=np.full(8000, VOID, np.uint8)), made) == []


def test_without_plain_places_nothing_moves() -> None:
    made, _ = pictures(papered=True)
    assert not any_plain(made)
    assert (moved_of(made, walls(known(made), Reporter())).depth == made[2].field.depth).all()


def test_a_region_whose_rim_tells_nothing_lies_where_other_pictures_have_it() -> None:
    made, truths = pictures()
    found = walls(known(made), Reporter())
    made[2] = replace(made[2], sure=np.zeros_like(made[2].sure))
    plain = made[2].plain
    after = np.abs(moved_of(made, found).depth / truths[2] - 1)[plain]
    assert (after < 0.01).mean() > 0.7
    assert (moved_of(made, found, asked=False).depth == made[2].field.depth).all()


def test_cancelling_is_heard() -> None:
    made, _ = pictures()
    report = Reporter()
    report.cancel()
    with pytest.raises(Cancelled):
        on_walls(
            made,
            [[]] * 5,
            [Wall(np.array([0.0, 1.5, 0]), np.array([0.0, -1, 0]))],
            [p.field for p in made],
            [None] * 5,
            report,
        )
