"""Planes of a scene: a wall that is known at one end goes on where photos say nothing, and only there."""

from __future__ import annotations

import numpy as np
import pytest
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.mesh.depth_maps import DepthMap, FlatView, cosines, pixel_directions
from fieldwork.nerfcore.mesh.scene_planes import Known, ground, known_points, on_scene_planes, scene_planes
from fieldwork.nerfcore.progress import Reporter

LENS = Camera(width=120, height=90, fx=100.0, fy=100.0, cx=60.0, cy=45.0)


def looking(x: float, turn: float) -> FlatView:
    """A view from (x, 0, 0) along z, turned around y."""
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    pose[0, 3] = x
    return FlatView(LENS, pose, 0, np.ones((90, 120), bool))


def wall_depth(view: FlatView, z: float = 3.0) -> np.ndarray:
    """Depths (H, W) of the wall at `z`."""
    return ((z - view.pose[2, 3]) / (pixel_directions(LENS) @ view.pose[:3, :3].T)[..., 2]).astype(np.float32)


def as_map(depth: np.ndarray, spread: float) -> DepthMap:
    depth = depth.astype(np.float32)
    return DepthMap(depth, np.full_like(depth, spread), cosines(LENS, depth))


@pytest.fixture(scope="module")
def walls() -> tuple[list[FlatView], list[np.ndarray], list[np.ndarray]]:
    """Views of one wall, its depths, and where they are sure: on the left two thirds of the pictures."""
    views = [looking(-0.3, 0.1), looking(0.0, 0.0), looking(0.3, -0.1)]
    sure = np.zeros((90, 120), bool)
    sure[:, :80] = True
    return views, [wall_depth(view) for view in views], [sure] * 3


def test_one_plane_is_found_where_it_is(walls) -> None:
    views, depths, sure = walls
    rng = np.random.default_rng(0)
    maps = [as_map(d * (1 + 0.002 * rng.standard_normal(d.shape)), 0.01) for d in depths]
    (plane,) = scene_planes(known_points(views, maps, sure), Reporter())
    assert plane.normal == pytest.approx([0, 0, -1], abs=0.01)  # towards the cameras
    assert plane.point[2] == pytest.approx(3.0, abs=0.005)
    assert plane.holds(np.array([[0.0, 0, 3]])).all()
    assert not plane.holds(np.array([[9.0, 0, 3], [0, -7, 3]])).any()


@pytest.mark.parametrize(("spread", "found"), [(0.05, 1), (0.6, 0)])
def test_what_a_soft_field_takes_for_a_plane_is_none(walls, spread: float, found: int) -> None:
    """Depths may be wrong by half their spread: by less than a footprint of 0.03, and by ten."""
    views, depths, sure = walls
    assert len(scene_planes(known_points(views, [as_map(d, spread) for d in depths], sure), Reporter())) == found


def test_a_little_that_is_sharp_makes_no_plane_of_a_soft_scene(walls) -> None:
    views, depths, sure = walls
    spread = np.full(depths[0].shape, 0.6, np.float32)
    spread[:8, :8] = 0.05
    maps = [DepthMap(d, spread, cosines(LENS, d)) for d in depths]
    assert not scene_planes(known_points(views, maps, sure), Reporter())


def test_unsure_depths_that_agree_lie_on_the_plane(walls) -> None:
    views, depths, sure = walls
    maps = [as_map(d, 0.01) for d in depths]
    planes = scene_planes(known_points(views, maps, sure), Reporter())
    off = np.where(sure[1], 1, 1.04)  # the field is 4 % too far where photos say nothing
    blurred = as_map(depths[1] * off, 0.2)
    found, _ = on_scene_planes(views[1], blurred, sure[1], blurred, planes)
    near = slice(80, 100)
    assert found.depth[:, near] == pytest.approx(depths[1][:, near], rel=1e-3)
    assert (found.spread[:, near] < 0.1).all()
    assert (found.depth[sure[1]] == blurred.depth[sure[1]]).all()
    # A field that is sure of another depth is believed: a picture that hangs before the wall.
    sharp = as_map(depths[1] * np.where(sure[1], 1, 0.95), 0.01)
    assert (on_scene_planes(views[1], sharp, sure[1], sharp, planes)[0].depth == sharp.depth).all()


def test_a_plane_ends_and_has_one_side(walls) -> None:
    views, depths, sure = walls
    planes = scene_planes(known_points(views, [as_map(d, 0.01) for d in depths], sure), Reporter())
    aside = looking(6.0, 0.0)  # the same wall, far from what is known of it
    blurred = as_map(wall_depth(aside) * 1.04, 0.2)
    nothing = np.zeros((90, 120), bool)
    assert (on_scene_planes(aside, blurred, nothing, blurred, planes)[0].depth == blurred.depth).all()
    behind = looking(0.0, np.pi)
    behind.pose[2, 3] = 6.0
    seen = as_map(np.full((90, 120), 3.1), 0.2)
    assert (on_scene_planes(behind, seen, nothing, seen, planes)[0].depth == seen.depth).all()


def test_nothing_known_is_no_plane_and_cancelling_is_heard(walls) -> None:
    views, depths, sure = walls
    maps = [as_map(d, 0.01) for d in depths]
    assert scene_planes(known_points(views, maps, [np.zeros_like(s) for s in sure]), Reporter()) == []
    report = Reporter()
    report.cancel()
    with pytest.raises(Cancelled):
        scene_planes(known_points(views, maps, sure), report)


def before_wall(share: float) -> Known:
    """A wall at z = 3 and, of `share` of all that is known, a lawn at y = 1, two centimetres uneven; y points down."""
    rng, count = np.random.default_rng(0), 50_000
    few = round(share * count)
    wall = np.stack([rng.uniform(-2, 2, count), rng.uniform(-2, 1, count), np.full(count, 3.0)], 1)
    lawn = np.stack([rng.uniform(-2, 0, few), 1 + rng.uniform(-0.01, 0.01, few), rng.uniform(2, 3, few)], 1)
    normals = np.concatenate([np.tile([0.0, 0, -1], (count, 1)), np.tile([0.0, -1, 0], (few, 1))])
    points = np.concatenate([wall, lawn])
    kind = np.concatenate([np.full(count, 1, np.uint8), np.full(few, 2, np.uint8)])
    return Known(points, normals, np.full(len(points), 0.03), np.full(len(points), 0.03), kind)


def test_a_ground_is_found_of_which_little_is_known() -> None:
    known, views = before_wall(0.004), [looking(x, 0.0) for x in (-0.3, 0.0, 0.3)]
    planes = scene_planes(known, Reporter())
    assert all(abs(plane.normal[1]) < 0.1 for plane in planes)
    plane = ground(known, views, planes, Reporter())
    assert plane is not None
    assert plane.normal == pytest.approx([0, -1, 0], abs=0.02)
    assert plane.point[1] == pytest.approx(1.0, abs=0.01)
    # The lawn's class lies on it, of the wall's only its foot.
    assert plane.partly[2]
    assert not plane.partly[1]
    assert ground(known, views, [*planes, plane], Reporter()) is None, "it is known"
    assert ground(before_wall(0.0005), views, planes, Reporter()) is None
    turned = [FlatView(view.camera, view.pose.copy(), 0, view.inside) for view in views]
    for number, view in enumerate(turned):  # a third of a turn each: nothing is up
        c, s = np.cos(2 * np.pi * number / 3), np.sin(2 * np.pi * number / 3)
        view.pose[:3, :3] = view.pose[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    assert ground(known, turned, planes, Reporter()) is None


def of_class(number: int) -> list[np.ndarray]:
    """Label maps in which three views show nothing but one class."""
    return [np.full((90, 120), number, np.uint8)] * 3


def test_the_plane_of_a_class_goes_on_wherever_label_maps_give_it(walls) -> None:
    views, depths, sure = walls
    planes = scene_planes(known_points(views, [as_map(d, 0.01) for d in depths], sure, of_class(4)), Reporter())
    aside, nothing = looking(6.0, 0.0), np.zeros((90, 120), bool)
    true = wall_depth(aside)
    blurred = as_map(true * 1.3, 0.01)  # a field that is sure of another depth
    label = np.where(np.arange(120) < 60, 4, 5) * np.ones((90, 1), int)
    found, named = on_scene_planes(aside, blurred, nothing, blurred, planes, label.astype(np.uint8))
    assert found.depth[:, :60] == pytest.approx(true[:, :60], rel=1e-3)
    assert (found.depth[:, 60:] == blurred.depth[:, 60:]).all()
    assert named[:, :57].all()
    assert not named[:, 57:].any()  # the class ends at column 60
    # A field that has it at twice the depth shows something else, and so does what photos confirm.
    for field, sure_there in ((as_map(true * 2.2, 0.01), nothing), (blurred, ~nothing)):
        found, named = on_scene_planes(aside, field, sure_there, field, planes, of_class(4)[0])
        assert (found.depth == field.depth).all()
        assert not named.any()


def test_a_class_that_lies_elsewhere_too_has_no_plane(walls) -> None:
    views, depths, sure = walls
    bent = [np.where(np.arange(120) < 40, d, 0.8 * d) for d in depths]  # half of it before the wall
    planes = scene_planes(known_points(views, [as_map(d, 0.01) for d in bent], sure, of_class(4)), Reporter())
    assert planes
    assert not any(plane.classes.any() for plane in planes)
    far = [np.where(np.arange(90)[:, None] < 60, d, 1.5 * d) for d in depths]  # a table's top, and what is under it
    labels = [np.where(np.arange(90)[:, None] < 60, 4, 5).astype(np.uint8) * np.ones((1, 120), np.uint8)] * 3
    planes = scene_planes(known_points(views, [as_map(d, 0.01) for d in far], sure, labels), Reporter())
    top = min(planes, key=lambda plane: plane.point[2])
    assert top.point[2] == pytest.approx(3.0, abs=0.02)
    assert not top.classes.any()
    unnamed = scene_planes(known_points(views, [as_map(d, 0.01) for d in depths], sure, [None] * 3), Reporter())
    assert not any(plane.classes.any() for plane in unnamed)


def test_depths_lie_at_the_height_of_what_is_known_around(walls) -> None:
    """The upper half of the wall stands out by a pixel and a half: less than what tells planes apart."""
    views, _, sure = walls
    upper = np.arange(90)[:, None] < 30
    stepped = [np.where(upper, wall_depth(view, 2.955), wall_depth(view)) for view in views]
    planes = scene_planes(known_points(views, [as_map(d, 0.01) for d in stepped], sure), Reporter())
    blurred = as_map(stepped[1] * np.where(sure[1], 1, 1.04), 0.2)
    found, _ = on_scene_planes(views[1], blurred, sure[1], blurred, planes)
    for rows in (slice(0, 15), slice(60, 90)):
        assert found.depth[rows, 82:90] == pytest.approx(stepped[1][rows, 82:90], abs=0.015)


def test_what_is_known_well_does_not_set_the_height_of_what_lies_beside_it() -> None:
    """A paving of many sharp points, and beside it a meadow two footprints lower, of few that are less sharp."""
    pixel = 0.01
    paving = np.stack(np.meshgrid(np.arange(-3, 0, 0.02), np.arange(-2, 2, 0.02)), -1).reshape(-1, 2)
    meadow = np.stack(np.meshgrid(np.arange(0, 3, 0.08), np.arange(-2, 2, 0.08)), -1).reshape(-1, 2)
    place = np.concatenate([paving, meadow])
    low = place[:, 0] >= 0
    points = np.column_stack([place, np.where(low, -2 * pixel, 0)])
    known = Known(
        points,
        np.tile([0.0, 0, 1], (len(points), 1)),
        np.full(len(points), pixel),
        np.where(low, 2, 1) * pixel,
        np.zeros(len(points), np.uint8),
    )
    (plane,) = scene_planes(known, Reporter())
    beside = np.array([[0.5, 0, 0], [-0.5, 0, 0]])  # half of what heights are averaged over away from the edge
    height = plane.height_at(beside) + plane.point[2]
    assert height[0] < -0.8 * pixel
    assert height[1] > -0.8 * pixel
