"""Depth maps moved to where painted photos agree."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.data.pixels import VOID
from fieldwork.nerfcore.geometry.cameras import pixel_centers, rays
from fieldwork.nerfcore.kernels.depth_arrays import FREE, MapArrays
from fieldwork.nerfcore.kernels.patch_sums import quads
from fieldwork.nerfcore.mesh import depth_maps, refine
from fieldwork.nerfcore.mesh.refine import refined_maps
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.depth_views import CAMERA, box, look_at, maps_of, orbit, sphere

CPU = torch.device("cpu")


def painted_photos(flats: list[depth_maps.FlatView], true: list[depth_maps.DepthMap]) -> SimpleNamespace:
    """Photos of a surface with these depths that is painted all over, as a store of pixels."""
    rgba = []
    for flat, map_ in zip(flats, true):
        local, _ = rays(flat.camera, pixel_centers(flat.camera.width, flat.camera.height).reshape(-1, 2))
        z = np.where(map_.hit, map_.depth, 1).reshape(-1, 1)
        points = (local / local[:, 2:] * z) @ flat.pose[:3, :3].T + flat.pose[:3, 3]
        tone = 0.5 + 0.2 * np.sin(31 * points + 5 * np.sin(17 * points[:, [1, 2, 0]])).sum(1) / 1.5
        grey = np.where(map_.hit.reshape(-1), tone, 0.1).clip(0, 1) * 255
        rgba.append(np.concatenate([np.repeat(grey[:, None], 3, 1), np.full((len(grey), 1), 255)], 1))
    pose = np.stack([flat.pose for flat in flats])
    return SimpleNamespace(
        rgba=torch.from_numpy(np.concatenate(rgba).round().astype(np.uint8)),
        first=torch.arange(len(flats) + 1) * len(rgba[0]),
        cameras=[flat.camera for flat in flats],
        rays=SimpleNamespace(rotation=torch.from_numpy(pose[:, :3, :3])),
        label=torch.zeros(sum(map(len, rgba)), dtype=torch.uint8),
    )


@pytest.fixture(scope="module")
def sphere_views() -> SimpleNamespace:
    """Views of a painted sphere: their depths, those of a field that lies 1.5 % too deep here and too near there, photos."""
    flats, true = maps_of(sphere(0.5), orbit(24, 1.8))
    soft = []
    for number, (flat, map_) in enumerate(zip(flats, true)):
        wave = 1 + 0.015 * np.sin(number + np.linspace(0, 5, map_.depth.shape[1]))[None, :]
        depth = np.where(map_.hit, map_.depth * wave, map_.depth).astype(np.float32)
        cosine = depth_maps.cosines(flat.camera, depth)
        soft.append(depth_maps.DepthMap(depth, np.where(map_.hit, 0.05, 0).astype(np.float32), cosine))
    return SimpleNamespace(flats=flats, true=true, soft=soft, store=painted_photos(flats, true))


def refined(views: SimpleNamespace) -> tuple[MapArrays, float]:
    return refined_maps(views.flats, views.soft, views.store, CPU, Reporter())


def test_photos_move_soft_depths_onto_the_surface(sphere_views: SimpleNamespace) -> None:
    before = depth_maps.confirmed_maps(sphere_views.flats, sphere_views.soft, CPU, Reporter())
    after, share = refined(sphere_views)
    assert share > 0.9
    truth = torch.from_numpy(np.concatenate([m.depth.reshape(-1) for m in sphere_views.true]))

    def error(maps: MapArrays) -> float:
        hit = (maps.depth > 0) & (maps.depth < FREE) & (truth < FREE)
        return float((maps.depth - truth)[hit].abs().median())

    assert error(before) > 0.008
    assert error(after) < 0.6 * error(before)  # 0.4 pixels
    assert float(((after.depth > 0) & (after.depth < FREE)).float().mean()) > 0.9 * float(
        ((before.depth > 0) & (before.depth < FREE)).float().mean()
    )


@pytest.mark.slow
def test_what_label_maps_leave_out_is_there_where_photos_say_so(
    sphere_views: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, count = sphere_views.store, len(sphere_views.flats)
    row = torch.arange(CAMERA.height * CAMERA.width) // CAMERA.width

    def labelled_below(share: float) -> MapArrays:
        label = torch.where(row < share * CAMERA.height, VOID, 0).to(torch.uint8).repeat(count)
        monkeypatch.setattr(store, "label", label)
        return refined(sphere_views)[0]

    def there(maps: MapArrays) -> torch.Tensor:
        return (row < 0.4 * CAMERA.height).repeat(count) & (maps.depth > 0) & (maps.depth < FREE)

    unnamed = int(there(refined(sphere_views)[0]).sum())
    assert int(there(labelled_below(0.4)).sum()) > 0.9 * unnamed > 900
    # Label maps that name little of what photos confirm say nothing of the rest: it is as without any.
    torch.testing.assert_close(labelled_below(0.7).depth, labelled_below(1.0).depth)
    # And nowhere else: of a plain part nothing is left of the field's own depths.
    plain = (row < 0.45 * CAMERA.height).repeat(count)[:, None]
    monkeypatch.setattr(store, "rgba", torch.where(plain, 128, store.rgba).to(torch.uint8))
    named = labelled_below(0.4)
    field = torch.from_numpy(np.concatenate([m.depth.reshape(-1) for m in sphere_views.soft]))
    assert bool((named.depth != field)[there(named)].all())
    assert int(there(named).sum()) < 0.1 * unnamed


def test_steps_of_the_field_on_flat_ground_do_not_tilt_what_photos_compare(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ground seen at a flat angle, in a field that has it in steps."""
    poses = [look_at(np.array([0.15 * k - 0.5, -2.0, 0.8]), np.array([0.1 * k - 0.3, 0, 0])) for k in range(8)]
    flats, true = maps_of(box(np.array([-9, -9, -1.0]), np.array([9, 9, 0.0])), poses)
    stepped = []
    for flat, map_ in zip(flats, true):
        ramp = (map_.depth / 0.25) % 1 - 0.5
        depth = np.where(map_.hit, map_.depth * (1 + 0.02 * ramp), map_.depth).astype(np.float32)
        spread = np.where(map_.hit, 0.05, 0).astype(np.float32)
        stepped.append(depth_maps.DepthMap(depth, spread, depth_maps.cosines(flat.camera, depth)))

    arrays = depth_maps.map_arrays(flats, stepped, CPU)
    greys = refine.grey_pictures(flats, painted_photos(flats, true), Reporter())  # type: ignore[arg-type]
    photos = torch.cat([quads(torch.from_numpy(grey)) for grey in greys])

    def error(sizes: tuple[int, ...]) -> float:
        """Of the depths of two photos from among the others, median."""
        monkeypatch.setattr(refine, "SMOOTH", sizes)
        off = []
        for number in (3, 4):
            near = torch.tensor([k for k in range(1, 7) if k != number], dtype=torch.int32)
            depth, _ = refine.where_photos_agree(photos, flats[number], stepped[number], arrays, number, near)
            truth = true[number].depth.reshape(-1)
            off.append(np.abs(depth.numpy() - truth)[truth < 4])
        return float(np.median(np.concatenate(off)))

    few, many = refine.SMOOTH
    assert error((few, many)) < 0.85 * error((few,))
