"""Depth maps of a field: what rays meet, where photos move it, and which of it other views confirm."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy
import torch
from fieldwork.nerfcore.config import SamplingConfig
from fieldwork.nerfcore.data.scene import View
from fieldwork.nerfcore.geometry.cameras import Camera, pixel_centers, rays
from fieldwork.nerfcore.kernels.depth_arrays import FREE, MapArrays
from fieldwork.nerfcore.mesh import depth_maps, planes, refine
from fieldwork.nerfcore.mesh.refine import refined_maps
from fieldwork.nerfcore.mesh.sky import FAR, farthest
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.sampling.occupancy import OccupancyGrid
from fieldwork.nerfcore.sampling.render_grid import present_grid
from fieldwork.tests.nerfcore.support.depth_views import CAMERA, box, look_at, maps_of, orbit, sphere

CPU = torch.device("cpu")
Room = tuple[list[depth_maps.FlatView], list[depth_maps.DepthMap]]


@pytest.fixture(scope="module")
def room() -> Room:
    """A room seen from near its middle, all around: each wall by many photos, each part of a photo by other ones."""
    poses = []
    for k in range(36):
        angle, side = 2 * np.pi * k / 36, 0.5 * (-1) ** k
        place = np.array([0.6 * np.cos(3 * angle), 0.6 * np.sin(3 * angle), 0.1 * side])
        poses.append(look_at(place, place + [np.cos(angle), np.sin(angle), side]))
    return maps_of(box(np.array([-2, -1.5, -1.0]), np.array([2, 1.5, 1.0])), poses)


def known(maps: MapArrays) -> torch.Tensor:
    return (maps.depth > 0) & (maps.depth < FREE)


def test_the_rim_of_a_picture_is_confirmed_by_views_that_share_little_else() -> None:
    """A wall: twenty photos of its left part, two of its right part, and one between them."""
    places = [*np.linspace(0.1, 0.5, 20), 1.4, 3.0, 3.2]
    poses = [look_at(np.array([x, 0.05 * (k % 3), 0]), np.array([x, 2.0, 0])) for k, x in enumerate(places)]
    flats, maps = maps_of(box(np.array([-9, 2.0, -9.0]), np.array([9, 3.0, 9.0])), poses)
    width = flats[20].camera.width

    def right_part(maps_: MapArrays) -> float:
        begin = int(maps_.first[20])
        rows = known(maps_)[begin : begin + maps[20].depth.size].reshape(-1, width)
        return float(rows[:, -width // 10 :].float().mean())

    assert 21 not in depth_maps.neighbours(flats, maps, 8)[20]
    few = depth_maps.confirmed_maps(flats, maps, CPU, Reporter(), depth_maps.neighbours(flats, maps, 8))
    assert right_part(few) == 0
    assert right_part(depth_maps.confirmed_maps(flats, maps, CPU, Reporter())) > 0.9


def partly_wrong(room: Room) -> Room:
    """The room with every third map a tenth too far."""
    flats, maps = room
    return flats, [replace(m, depth=m.depth * np.float32(1.1 if k % 3 == 0 else 1)) for k, m in enumerate(maps)]


def test_more_views_can_be_asked_to_confirm(room: Room) -> None:
    flats, maps = partly_wrong(room)
    counts = [
        int(known(depth_maps.confirmed_maps(flats, maps, CPU, Reporter(), needed=needed)).sum())
        for needed in (2, 3, 12)
    ]
    assert counts[0] > counts[1] > counts[2]
    # Of three views two others are all there are.
    three = flats[:3], maps[:3]
    assert torch.equal(
        depth_maps.confirmed_maps(*three, CPU, Reporter(), needed=2).depth,
        depth_maps.confirmed_maps(*three, CPU, Reporter(), needed=9).depth,
    )


def test_where_one_other_view_could_show_a_place_it_is_enough() -> None:
    """A wall: two photos of its right part, which two of its left part do not show."""
    poses = [look_at(np.array([x, 0.0, 0.1 * k]), np.array([x, 2.0, 0])) for k, x in enumerate([-3.0, -2.8, 1.4, 1.7])]
    flats, maps = maps_of(box(np.array([-9, 2.0, -9.0]), np.array([9, 3.0, 9.0])), poses)

    def right(maps_: MapArrays) -> float:
        return float(known(maps_)[int(maps_.first[2]) :].float().mean())

    assert right(depth_maps.confirmed_maps(flats, maps, CPU, Reporter())) > 0.7
    assert right(depth_maps.confirmed_maps(flats, maps, CPU, Reporter(), few_suffice=False)) == 0
    # Another one that looks there and sees something else contradicts it; a thing before it hides it.
    beside = look_at(np.array([1.5, 0.0, -0.1]), np.array([1.5, 2.0, 0]))
    for factor, most, least in ((1.5, 0.1, 0.0), (0.5, 1.0, 0.6)):
        more, other = maps_of(box(np.array([-9, 2.0, -9.0]), np.array([9, 3.0, 9.0])), [*poses, beside])
        other[4] = replace(other[4], depth=other[4].depth * np.float32(factor))
        arrays = depth_maps.confirmed_maps(more, other, CPU, Reporter())
        part = known(arrays)[int(arrays.first[2]) : int(arrays.first[4])].float().mean()
        assert least <= float(part) <= most


def test_one_other_view_is_enough_where_it_is_said_to_be(room: Room) -> None:
    flats, maps = partly_wrong(room)
    half = [np.arange(m.depth.shape[1]) * np.ones((len(m.depth), 1)) < m.depth.shape[1] / 2 for m in maps]
    strict, loose, mixed = (
        known(depth_maps.confirmed_maps(flats, maps, CPU, Reporter(), needed=needed, one_suffices=where))
        for needed, where in ((3, None), (1, None), (3, half))
    )
    chosen = torch.from_numpy(np.concatenate([h.reshape(-1) for h in half]))
    assert int((loose & ~strict & chosen).sum()) > 0
    assert torch.equal(mixed, torch.where(chosen, loose, strict))
    alone = depth_maps.confirmed_maps(flats[:1], maps[:1], CPU, Reporter(), one_suffices=half[:1])
    assert torch.equal(known(alone), known(depth_maps.map_arrays(flats[:1], maps[:1], CPU)))


def test_holes_are_filled_and_nothing_else() -> None:
    def arrays(*depths: float) -> MapArrays:
        depth = torch.tensor(depths)
        nothing = torch.zeros(1)
        return MapArrays(depth, depth + 1, depth + 2, nothing, nothing, nothing, nothing, nothing, nothing)

    filled = refine.with_holes_filled(arrays(0, 0, 0, 1, FREE), arrays(3, 0, FREE, 4, 5))
    assert filled.depth.tolist() == arrays(3, 0, 0, 1, FREE).depth.tolist()
    assert filled.cosine[:4].tolist() == [4, 1, 1, 2]
    assert filled.spread[:4].tolist() == [5, 2, 2, 3]


def test_how_far_photos_confirm_depths() -> None:
    depth = np.concatenate([np.linspace(1, 2, 101), [FREE, 0, 9]])
    sure = np.ones(len(depth), bool)
    sure[-1] = False
    assert farthest(depth, sure) == pytest.approx(1.95)
    assert farthest(depth, ~sure) == 9
    assert farthest(depth, np.zeros(len(depth), bool)) == np.inf


@pytest.mark.parametrize("reach", [np.inf, 1.6])
def test_where_planes_contradict_each_other_the_field_is_believed_as_far_as_photos_reach(
    room: Room, reach: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Plain walls: planes of neighbouring views do not meet, and photos confirm what is nearer than `reach`, or nothing."""
    flats, maps = room
    pattern = np.random.default_rng(0).random((flats[0].camera.height, flats[0].camera.width)).astype(np.float32)

    def moved(grey, facing, arrays, number, near, least, gain):
        depth = torch.from_numpy(maps[number].depth.reshape(-1))
        near = (depth < reach) & (depth < FREE) if np.isfinite(reach) else torch.zeros(len(depth), dtype=torch.bool)
        return torch.where(near, depth * 1.0005, depth), depth

    def apart(view, map_, sure):
        tilted = 1.04 ** (1 + [id(flat) for flat in flats].index(id(view)))
        return replace(map_, depth=np.where(map_.hit & ~sure, map_.depth * tilted, map_.depth))

    monkeypatch.setattr(refine, "refine", moved)
    monkeypatch.setattr(refine, "with_planes", apart)
    monkeypatch.setattr(refine, "scene_planes", lambda known, report: [])
    monkeypatch.setattr(refine, "grey_pictures", lambda views, store, report: [pattern] * len(flats))
    monkeypatch.setattr(refine, "label_picture", lambda view, store: None)
    field = depth_maps.map_arrays(flats, maps, CPU).depth
    final, _ = refined_maps(flats, maps, SimpleNamespace(), CPU, Reporter())  # type: ignore[arg-type]
    theirs = known(final) & (final.depth == field)
    roughly = {"agree": refine.FIELD_AGREES, "round_trip": refine.FIELD_RETURNS}
    asked = depth_maps.confirmed_maps(flats, maps, CPU, Reporter(), **roughly)
    if np.isinf(reach):
        assert int(theirs.sum()) > 0.95 * int(known(asked).sum())
        assert torch.equal(theirs & ~known(asked), torch.zeros_like(theirs))
    else:
        assert not bool((known(final) & (field > FAR * reach)).any())
        assert int(known(final).sum()) > 1000  # what photos confirm


@pytest.mark.parametrize("outward", [False, True])
def test_walls_are_looked_for_where_cameras_look_around(
    room: Room, outward: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Photos that show nothing at all: plain everywhere."""
    flats, maps = room
    asked = []
    plain = np.full(maps[0].depth.shape, 0.8, np.float32)
    monkeypatch.setattr(refine, "walls", lambda known, report: asked.append(known) or [])
    monkeypatch.setattr(refine, "grey_pictures", lambda views, store, report: [plain] * len(flats))
    monkeypatch.setattr(refine, "label_picture", lambda view, store: None)
    refined_maps(flats, maps, SimpleNamespace(), CPU, Reporter(), outward=outward)  # type: ignore[arg-type]
    assert len(asked) == outward


def wall_maps(camera: Camera) -> tuple[depth_maps.FlatView, depth_maps.DepthMap]:
    """A slanted wall, and a pillar half as far away in the middle of the picture."""
    view = View("wall", camera, np.eye(4), image=None)  # type: ignore[arg-type]
    flat = depth_maps.flat_views([view], np.eye(4), camera.width)[0]
    local, _ = rays(camera, pixel_centers(camera.width, camera.height).reshape(-1, 2))
    flat_direction = local / local[:, 2:]
    depth = (2 / (1 + 0.3 * flat_direction[:, 0])).reshape(camera.height, camera.width)
    depth[:, 50:70] = 1.0
    depth = depth.astype(np.float32)
    return flat, depth_maps.DepthMap(depth, np.full_like(depth, 0.2), depth_maps.cosines(camera, depth))


def test_noisy_depths_of_plain_walls_fall_on_planes_and_others_stay() -> None:
    flat, true = wall_maps(CAMERA)
    random = np.random.default_rng(0)
    wrong = (true.depth * random.normal(1, 0.02, true.depth.shape)).astype(np.float32)
    sure = random.random(true.depth.shape) < 0.1
    noisy = depth_maps.DepthMap(np.where(sure, true.depth, wrong), true.spread, true.cosine)
    found = planes.with_planes(flat, noisy, sure)
    assert (found.depth[sure] == true.depth[sure]).all()
    before, after = (np.abs(m.depth / true.depth - 1) for m in (noisy, found))
    wall = np.ones(true.depth.shape, bool)
    wall[:, 44:76] = False  # windows across the pillar's edges are no planes
    assert np.median(after[wall & ~sure]) < 0.2 * np.median(before[wall & ~sure])
    assert (found.spread[wall] < true.spread[wall]).mean() > 0.8
    assert np.quantile(after, 0.99) < 1.2 * np.quantile(before, 0.99)  # nothing is smeared over the edges
    nothing = depth_maps.DepthMap(np.full_like(wrong, FREE), true.spread, true.cosine)
    assert (planes.with_planes(flat, nothing, sure).depth == FREE).all()


def test_a_smaller_depth_map_is_enlarged_without_new_depths_at_outlines() -> None:
    wide = CAMERA.model_copy(update={"width": 480, "height": 360, "fx": 440.0, "fy": 448.0, "cx": 232.0, "cy": 184.0})
    view = View("wall", wide, np.eye(4), image=None)  # type: ignore[arg-type]
    flat = depth_maps.flat_views([view], np.eye(4), 480)[0]
    small = depth_maps.reduced(flat)
    assert (small.camera.width, small.camera.height) == small.inside.shape[::-1] == (240, 180)
    assert depth_maps.reduced(small).camera.width == 160
    _, rendered = wall_maps(small.camera)
    rendered.depth[:20] = FREE
    found = depth_maps.enlarged(rendered, flat)
    local, _ = rays(wide, pixel_centers(480, 360).reshape(-1, 2))
    true = (2 / (1 + 0.3 * (local / local[:, 2:])[:, 0])).reshape(360, 480)
    pillar = np.abs(found.depth - 1) < 1e-6
    assert (found.depth[:38] == FREE).all()
    assert np.flatnonzero(pillar[180]).tolist() == list(range(100, 140))
    wall = (found.depth < FREE) & ~pillar
    assert np.abs(found.depth / true - 1)[wall].max() < 0.003
    assert depth_maps.enlarged(found, flat) is found


def test_rays_say_what_they_meet_that_nothing_is_there_or_nothing() -> None:
    """A slab that is 95 %, 30 % and 5 % opaque: a depth, unknown, free; unknown too where the photo shows nothing."""
    camera, pose, thick = Camera(width=4, height=1, fx=4.0, fy=4.0, cx=2.0, cy=0.5), np.eye(4), 0.5
    pose[2, 3] = -1.5
    slope = (torch.arange(4) - 1.5) / 4
    depth_of = -torch.log(1 - torch.tensor([0.95, 0.3, 0.05, 0.95]))  # optical
    density = depth_of / (thick * torch.sqrt(1 + slope**2))

    def slab(points: torch.Tensor) -> torch.Tensor:
        x, _, z = (2 * points - 1).unbind(1)
        column = (x / (z + 1.5) * 4 + 1.5).round().long().clamp(0, 3)
        return torch.where((z > 0) & (z < thick), density[column], 0.0)

    grid = OccupancyGrid(SamplingConfig(resolution=32), False)
    model = SimpleNamespace(
        priorities=torch.ones(1),
        render_grid=lambda: present_grid(grid, 0.0),
        config=SimpleNamespace(render=SimpleNamespace(samples=256)),
        field=SimpleNamespace(density_until=lambda _, points, *packed: slab(points)),
    )
    view = depth_maps.FlatView(camera, pose, 0, np.array([[True, True, True, False]]))
    found = depth_maps.render_depth(model, view, lambda: None).depth[0]  # type: ignore[arg-type]
    half = 1.5 + thick * np.log(2) / float(depth_of[0])
    assert found == pytest.approx(np.array([half, 0, FREE, 0], np.float32), abs=0.03)


def test_an_enlarged_depth_map_knows_nothing_where_its_photo_shows_nothing() -> None:
    camera = Camera(width=4, height=2, fx=4.0, fy=4.0, cx=2.0, cy=1.0)
    inside = np.ones((4, 8), bool)
    inside[:, 6:] = False
    view = depth_maps.FlatView(camera.resized(8, 4), np.eye(4), 0, inside)
    free = np.full((2, 4), FREE, np.float32)
    small = depth_maps.DepthMap(free, np.zeros_like(free), np.zeros_like(free))
    assert (depth_maps.enlarged(small, view).depth == np.where(inside, np.float32(FREE), 0)).all()


def test_borders_of_a_lens_picture_leave_no_gaps() -> None:
    """Three photos of a wall, the other two shifted: what lies just beside one of them need not be confirmed by it."""
    lens = CAMERA.model_copy(update={"model": "OPENCV", "distortion": (0.06, 0.0, 0.0, 0.0)})
    poses = []
    for shift in (0.0, 0.5, -0.5):
        pose = np.eye(4)
        pose[:3, 3] = shift, 0.3 * shift, -2.0
        poses.append(pose)

    def wall(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        return -origin[2] / directions[:, 2]

    flats, maps = maps_of(wall, poses, lens)
    assert 0.001 < 1 - flats[1].inside.mean() < 0.2
    kept = depth_maps.confirmed_maps(flats, maps, CPU, Reporter())
    width, height = flats[0].camera.width, flats[0].camera.height
    first = known(kept)[: width * height].reshape(height, width).numpy()
    local = depth_maps.pixel_directions(flats[0].camera) * 2.0
    shown = np.zeros((height, width), int)
    for flat in flats[1:]:
        c = flat.camera
        x, y = ((local - (flat.pose - flats[0].pose)[:3, 3]) / 2.0)[..., :2].transpose(2, 0, 1)
        u, v = x * c.fx + c.cx, y * c.fy + c.cy
        there = (u >= 0) & (v >= 0) & (u < c.width) & (v < c.height)
        inside = flat.inside[v.astype(int).clip(0, c.height - 1), u.astype(int).clip(0, c.width - 1)]
        shown += there & inside
    lost = (shown > 0) & flats[0].inside & ~first
    assert lost.sum() <= 2  # on the edges of pixels, where rounding decides
    assert not first[scipy.ndimage.maximum_filter(shown, 3) == 0].any()


def test_what_is_seen_at_a_grazing_angle_is_unknown_not_free() -> None:
    camera = Camera(width=4, height=1, fx=4.0, fy=4.0, cx=2.0, cy=0.5)
    depth, cosine = np.array([[1, 1, FREE, 0]], np.float32), np.array([[0.9, 0.1, 0, 0]], np.float32)
    view = depth_maps.FlatView(camera, np.eye(4), 0, np.ones((1, 4), bool))
    arrays = depth_maps.map_arrays([view], [depth_maps.DepthMap(depth, np.zeros_like(depth), cosine)], CPU)
    assert arrays.depth.tolist() == np.array([1, 0, FREE, 0], np.float32).tolist()


def test_slopes_are_relied_on_where_photos_confirm_or_the_field_is_sharp() -> None:
    flats, maps = maps_of(sphere(0.5), orbit(2, 1.8))
    soft = [replace(m, spread=30 * m.depth / view.camera.fx) for view, m in zip(flats, maps)]
    sure = [np.zeros(m.depth.shape, bool) for m in maps]
    sure[0][:, ::2] = True
    sharp = refine.relied_on(flats, maps, sure).reshape(2, *maps[0].depth.shape) > 0
    assert torch.equal(sharp[1], torch.from_numpy(maps[1].hit))
    found = refine.relied_on(flats, soft, sure).reshape(2, *maps[0].depth.shape)
    assert torch.equal(found[0] > 0, torch.from_numpy(sure[0]))
    assert not found[1].any()


@pytest.mark.parametrize("focal", [180.0, 260.0, 400.0, pytest.param(1400.0, marks=pytest.mark.slow)])  # the last: 26°
def test_maps_of_wide_lenses_have_as_many_pixels_as_those_of_others(
    focal: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is planned is the size of the pictures that the photos are cut into."""
    monkeypatch.setattr(depth_maps, "CPU_PIXELS", 4e5)
    place = {"width": 640, "height": 480, "fx": focal, "fy": focal, "cx": 320, "cy": 240}
    wide = Camera(model="OPENCV_FISHEYE", distortion=(0.0, 0.0, 0.0, 0.0), **place)
    views = [View(f"{i:02d}", wide, np.eye(4), Path("none")) for i in range(4)]
    flats = depth_maps.flat_views(views, np.eye(4), depth_maps.map_size(views, CPU))
    assert 0.9 < sum(flat.inside.size for flat in flats) / depth_maps.CPU_PIXELS < 1.1
    for flat in flats:
        assert flat.inside.shape == (flat.camera.height, flat.camera.width)
        for side in (flat.inside[0], flat.inside[-1], flat.inside[:, 0], flat.inside[:, -1]):
            assert side.any(), "nothing is rendered beside the photo"


def test_of_a_narrow_fisheye_only_the_part_of_the_cube_that_it_sees_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    lens = {"model": "OPENCV_FISHEYE", "width": 64, "height": 48, "cx": 33.0, "cy": 23.5, "k1": 0.01}
    narrow, wide = Camera(fx=150.0, fy=150.0, **lens), Camera(fx=30.0, fy=30.0, **lens)
    (found,) = depth_maps._faces(narrow, np.eye(4), 0)
    assert len(depth_maps._faces(wide, np.eye(4), 0)) > 1
    monkeypatch.setattr(depth_maps, "_ahead", lambda camera: None)
    (whole,) = depth_maps._faces(narrow, np.eye(4), 0)
    assert found.camera == whole.camera
    assert (found.inside == whole.inside).all()
    monkeypatch.undo()
    (far,) = depth_maps._faces(Camera(fx=40000.0, fy=40000.0, **lens), np.eye(4), 0)  # whole faces have 6 · 10⁹ pixels
    assert far.inside.size < 1.2 * 64 * 48
