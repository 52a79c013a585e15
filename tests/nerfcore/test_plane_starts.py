"""Depths that a field has wrong by more than photos move them, found from the plane of what is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.kernels.patch_sums import quads
from fieldwork.nerfcore.mesh import depth_maps, refine
from fieldwork.nerfcore.mesh.plane_starts import depth_of, from_planes
from fieldwork.nerfcore.mesh.scene_planes import ScenePlane, known_points, scene_planes
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.depth_views import box, look_at, maps_of
from fieldwork.tests.nerfcore.test_refine import painted_photos

CPU = torch.device("cpu")
GRASS, POND = 3, 7


@pytest.fixture(scope="module")
def ground() -> tuple[list[depth_maps.FlatView], list[depth_maps.DepthMap]]:
    """A floor seen at a flat angle by eight cameras side by side, and what they see of it."""
    poses = [look_at(np.array([0.15 * k - 0.5, -2.0, 0.8]), np.array([0.1 * k - 0.3, 0, 0])) for k in range(8)]
    return maps_of(box(np.array([-9, -9, -1.0]), np.array([9, 9, 0.0])), poses)


def floor_of(
    flats: list[depth_maps.FlatView],
    true: list[depth_maps.DepthMap],
    near: list[np.ndarray],
    labels: list[np.ndarray | None] | None = None,
) -> ScenePlane:
    planes = scene_planes(known_points(flats, true, near, labels), Reporter())
    assert len(planes) == 1
    return planes[0]


def test_a_plane_is_as_deep_as_views_see_it(
    ground: tuple[list[depth_maps.FlatView], list[depth_maps.DepthMap]],
) -> None:
    flats, true = ground
    near = [map_.hit & (map_.depth < 2.3) for map_ in true]
    found = depth_of(flats[0], floor_of(flats, true, near))
    seen = true[0].hit & (true[0].depth < 8)
    assert np.abs(found / np.where(seen, true[0].depth, 1) - 1)[seen].max() < 0.02
    up = (depth_maps.pixel_directions(flats[0].camera) @ flats[0].pose[:3, :3].T)[..., 2] >= 0
    assert up.any()
    assert (found[up] == 0).all(), "above the horizon"


@pytest.mark.parametrize(("painted", "far_class"), [(True, None), (True, GRASS), (True, POND), (False, None)])
def test_photos_find_far_ground_from_the_plane_of_near_ground(
    ground: tuple[list[depth_maps.FlatView], list[depth_maps.DepthMap]], painted: bool, far_class: int | None
) -> None:
    """The field has what is farther than 2.3 too near by a fifth. Where nothing is painted, photos say nothing of it, and
    where label maps name it, it lies on planes of this class alone: near ground is grass."""
    flats, true = ground
    sure = [map_.hit & (map_.depth < 2.3) for map_ in true]
    wrong = []
    for flat, map_, safe in zip(flats, true, sure):
        depth = np.where(map_.hit & ~safe, 0.8 * map_.depth, map_.depth).astype(np.float32)
        spread = np.where(map_.hit, 0.02, 0).astype(np.float32)
        wrong.append(depth_maps.DepthMap(depth, spread, depth_maps.cosines(flat.camera, depth)))
    arrays = depth_maps.map_arrays(flats, wrong, CPU)
    greys = refine.grey_pictures(flats, painted_photos(flats, true), Reporter())  # type: ignore[arg-type]
    photos = torch.cat([quads(torch.from_numpy(grey if painted else np.full_like(grey, 0.5))) for grey in greys])
    around = [torch.tensor([k for k in range(8) if k != i][:5], dtype=torch.int32) for i in range(8)]
    moved = [refine.where_photos_agree(photos, flats[i], wrong[i], arrays, i, around[i]) for i in range(8)]
    agreed = [score.numpy().reshape(wrong[0].depth.shape) for _, score in moved]
    depths = [
        depth_maps.DepthMap(depth.numpy().reshape(map_.depth.shape), map_.spread, map_.cosine)
        for (depth, _), map_ in zip(moved, wrong)
    ]
    labels = [None if far_class is None else np.where(s, GRASS, far_class).astype(np.uint8) for s in sure]
    planes = [floor_of(flats, true, sure, labels)]
    found = from_planes(photos, flats, depths, agreed, sure, arrays, around, planes, labels, Reporter())
    off = [np.abs(map_.depth / np.where(t.hit, t.depth, 1) - 1) for map_, t in zip(found, true)]
    far = [t.hit & ~safe & (t.depth < 3.2) for t, safe in zip(true, sure)]
    right = np.mean(np.concatenate([o[f] < 0.01 for o, f in zip(off, far)]))
    before = [np.abs(map_.depth / np.where(t.hit, t.depth, 1) - 1) for map_, t in zip(depths, true)]
    assert np.mean(np.concatenate([o[f] < 0.01 for o, f in zip(before, far)])) < 0.1
    if painted and far_class != POND:
        assert right > 0.5  # the pattern is finer than pixels far away
    else:
        assert all(np.array_equal(a.depth, b.depth) for a, b in zip(found, depths))
    assert all(np.array_equal(a.depth[s], b.depth[s]) for a, b, s in zip(found, depths, sure)), "what is sure stays"
