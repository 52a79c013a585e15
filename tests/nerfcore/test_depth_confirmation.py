"""Which depths of the field are believed: those that other views confirm, whichever views these are."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.kernels.depth_arrays import FREE, MapArrays
from fieldwork.nerfcore.mesh import depth_maps, refine
from fieldwork.nerfcore.mesh.sky import farthest
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.depth_views import box, look_at, maps_of

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


def test_more_views_can_be_asked_to_confirm(room: Room) -> None:
    flats, maps = room
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


def test_holes_are_filled_and_nothing_else() -> None:
    def arrays(*depths: float) -> MapArrays:
        depth = torch.tensor(depths)
        nothing = torch.zeros(1)
        return MapArrays(depth, depth + 1, depth + 2, nothing, nothing, nothing, nothing, nothing)

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
    """Plain walls: planes of neighbouring views do not meet, and photos confirm what is nearer than `reach` or nothing."""
    flats, maps = room
    size = flats[0].camera.width * flats[0].camera.height

    def moved(grey, facing, arrays, number, near, least, gain):
        depth = torch.from_numpy(maps[number].depth.reshape(-1))
        near = (depth < reach) & (depth < FREE) if np.isfinite(reach) else torch.zeros(len(depth), dtype=torch.bool)
        return torch.where(near, depth * 1.0005, depth), depth

    def planes(view, map_, sure):
        tilted = 1 + 0.04 * (1 + [id(flat) for flat in flats].index(id(view)))
        return replace(map_, depth=np.where(map_.hit & ~sure, map_.depth * tilted, map_.depth))

    monkeypatch.setattr(refine, "refine", moved)
    monkeypatch.setattr(refine, "with_planes", planes)
    monkeypatch.setattr(refine, "grey_pictures", lambda views, store, report: [np.zeros(size, np.float32)] * len(flats))
    monkeypatch.setattr(refine, "nameless", lambda view, store: None)
    field = depth_maps.map_arrays(flats, maps, CPU).depth
    final, _ = refine.refined_maps(flats, maps, SimpleNamespace(), CPU, Reporter())  # type: ignore[arg-type]
    theirs = known(final) & (final.depth == field)
    asked = depth_maps.confirmed_maps(flats, maps, CPU, Reporter(), needed=3)
    if np.isinf(reach):
        assert int(theirs.sum()) > 0.95 * int(known(asked).sum())
        assert torch.equal(theirs & ~known(asked), torch.zeros_like(theirs))
    else:
        assert not bool((known(final) & (field > reach)).any())
        assert int(known(final).sum()) > 1000  # what photos confirm
