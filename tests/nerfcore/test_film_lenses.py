"""Rays of Blender’s lenses, apertures and shutters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.film.fields import FieldStore
from fieldwork.nerfcore.film.lens_rays import camera_directions, on_aperture, scene_rays
from fieldwork.nerfcore.film.shot import Aperture, Lens
from fieldwork.nerfcore.geometry.cameras import Camera

from .support.film import SIDE, H, W, ball, lens, store, take

__all__ = ["ball", "store"]


def test_a_perspective_lens_is_the_pinhole_of_the_engine() -> None:
    camera = Camera(width=W, height=H, fx=90, fy=80, cx=41, cy=37)
    from fieldwork.nerfcore.geometry.cameras import rays

    pixels = np.random.default_rng(0).uniform(0, 60, (50, 2))
    expected, _ = rays(camera, pixels)
    own = Lens.model_validate(lens(scale=(90, 80), center=(41, 37)))
    _, found = camera_directions(own, torch.tensor(pixels, dtype=torch.float32))
    assert np.allclose(found.numpy() * [1, -1, -1], expected, atol=1e-6)


def test_panoramas_look_where_cycles_looks() -> None:
    full = Lens.model_validate(
        lens(kind="equirectangular", longitudes=(-np.pi, np.pi), latitudes=(-np.pi / 2, np.pi / 2))
    )
    points = torch.tensor([[W / 2, H / 2], [0.75 * W, H / 2], [W / 4, H / 2], [W / 2, 0.0]])
    _, found = camera_directions(full, points)
    ahead, right, left, up = [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0]
    assert np.allclose(found.numpy(), [ahead, right, left, up], atol=1e-6)
    half = Lens.model_validate(lens(kind="equirectangular", longitudes=(-np.pi / 2, np.pi / 2), latitudes=(0, 1.0)))
    _, found = camera_directions(half, torch.tensor([[0.0, H], [W, H]]))
    assert np.allclose(found.numpy(), [left, right], atol=1e-6)
    fish = Lens.model_validate(lens(kind="equidistant", angle=np.pi))
    _, found = camera_directions(fish, torch.tensor([[W / 2, H / 2], [W, H / 2], [W / 2, 0.0], [0.0, 0.0]]))
    assert np.allclose(found[:3].numpy(), [ahead, right, up], atol=1e-6)
    assert found[3].isnan().all()
    solid = Lens.model_validate(lens(kind="equisolid", angle=np.pi, focal=10.5, sensor=(36, 24)))
    _, found = camera_directions(solid, torch.tensor([[W / 2 + W / 36 * 10.5, H / 2]]))
    # r = 2 f sin(θ / 2) with r = f
    assert np.allclose(found.numpy(), [[np.sin(np.pi / 3), 0, -np.cos(np.pi / 3)]], atol=1e-6)


def test_an_aperture_keeps_what_is_in_focus_and_has_its_shape() -> None:
    aperture = Aperture(radius=0.2, focus=3.0)
    own = Lens.model_validate(lens(aperture=aperture.model_dump()))
    chance = torch.rand(500, 3, generator=torch.Generator().manual_seed(0))
    pixels = torch.tensor([[20.0, 11.0]]).expand(500, 2)
    origins, directions = scene_rays(own, pixels, chance)
    _, straight = scene_rays(own, pixels[:1])
    sharp = torch.tensor(SIDE[:3, 3]).float() + straight[0] * 3 / straight[0, 1]
    length = ((sharp - origins) * directions).sum(1, keepdim=True)
    assert (origins + directions * length - sharp).abs().max() < 1e-5
    assert (origins - origins.mean(0)).norm(dim=1).max() > 0.15
    for blades in (3, 6):
        one = Aperture(radius=1, focus=1, blades=blades)
        u, v = torch.rand(2, 4000, generator=torch.Generator().manual_seed(1))
        places = on_aperture(one, u, v)
        radius = places.norm(dim=1)
        assert radius.max() <= 1 + 1e-6
        # A regular polygon has a corner at the angle 0 and reaches the circle there, and cos(π / n) in between.
        angle = torch.atan2(places[:, 1], places[:, 0]) % (2 * np.pi / blades)
        middle = (angle - np.pi / blades).abs() < 0.05
        assert radius[middle].max() < np.cos(np.pi / blades) + 0.01


def test_a_shutter_spreads_rays_over_the_poses() -> None:
    later = SIDE.copy()
    later[0, 3] = 1.0
    own = Lens.model_validate({**lens(), "poses": [SIDE.tolist(), later.tolist()]})
    chance = torch.tensor([[0.5, 0.5, 0.0], [0.5, 0.5, 0.25], [0.5, 0.5, 1.0]])
    origins, _ = scene_rays(own, torch.tensor([[W / 2, H / 2]]).expand(3, 2), chance)
    assert np.allclose(origins[:, 0].numpy(), [0, 0.25, 1], atol=1e-6)
    middle, _ = scene_rays(own, torch.tensor([[W / 2, H / 2]]))
    assert float(middle[0, 0]) == pytest.approx(0.5)


@pytest.mark.parametrize("baked", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_field_that_moves_is_blurred_as_by_a_camera_that_moves_the_other_way(
    ball: Path, store: FieldStore, baked: bool
):
    """With the crop box that goes along, and the names of instances that stay what they are."""
    places = [np.eye(4), np.eye(4)]
    places[0][0, 3], places[1][0, 3] = -0.25, 0.25
    crop = np.diag([0.3, 1.0, 1.0, 1.0])
    passes = ["Combined", "CryptoObject00", "Depth"]
    item = {"baked": baked, "crop": crop.tolist()}
    still = take(ball, store, passes, item, samples=24)
    moving = {"motion": [p.tolist() for p in places], "crop_motion": [(p @ crop).tolist() for p in places]}
    moved = take(ball, store, passes, item | moving, samples=24)
    poses = [(np.linalg.inv(place) @ SIDE).tolist() for place in places]
    other = take(ball, store, passes, item, samples=24, lens=lens(poses=poses))
    assert np.abs(moved["Combined"] - other["Combined"]).mean() < 2e-3
    assert np.abs(moved["Depth"] - other["Depth"])[still["Depth"] < 10].mean() < 1e-2
    assert np.abs(moved["CryptoObject00"] - other["CryptoObject00"])[..., 1].mean() < 2e-3
    solid = lambda found: ((found["Combined"][32, :, 3] > 0.05) & (found["Combined"][32, :, 3] < 0.95)).sum()  # noqa: E731
    assert solid(moved) > solid(still) + 20
    # The shutter's middle is where geometry is read: there it stands where it stood.
    near = (still["Depth"] < 10) & (moved["Depth"] < 10)
    assert near.sum() > 100
    assert np.abs(moved["Depth"] - still["Depth"])[near].mean() < 1e-3
