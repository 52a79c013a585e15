"""Which pixels may show the sky, and that the environment is behind no others while surfaces form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy
import torch
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.data.pixels import PixelStore
from fieldwork.nerfcore.data.scene import Scene
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.geometry.points import Points
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.train import sky_masks as module
from fieldwork.nerfcore.train.composite_loss import composite_loss
from fieldwork.nerfcore.train.infinity import between_points
from fieldwork.nerfcore.train.sky_masks import sky_masks
from fieldwork.tests.nerfcore.support.bowl import bowl_project, distances, stone
from fieldwork.tests.nerfcore.support.sky import environment_trainer, under_the_sky

CPU = torch.device("cpu")


def masks_of(scene: Scene, longest: int = 10_000) -> list[np.ndarray]:
    """The masks of all views of a scene, each at the size of the store's photo."""
    views = list(range(len(scene.views)))
    store = PixelStore(scene, views, [], np.eye(4), longest, CPU, Reporter())
    masks = sky_masks(store.views, store.cameras, scene.points.xyz, CPU)
    found = []
    for i, camera in enumerate(store.cameras):
        pixel = torch.arange(camera.width * camera.height)
        mask = masks.at(torch.full_like(pixel, i), pixel)
        found.append(mask.reshape(camera.height, camera.width).numpy())
    return found


def test_the_sky_above_a_court_and_not_its_walls(tmp_path: Path) -> None:
    scene = load_scene(bowl_project(tmp_path / "p", views=80, side=96, colors=stone))
    true = [~np.isfinite(distances(view.camera, view.camera_to_world)) for view in scene.views]
    found = masks_of(scene)
    sky, seen = np.concatenate([m.ravel() for m in true]), np.concatenate([m.ravel() for m in found])
    assert 0.1 < sky.mean() < 0.6
    assert seen[sky].mean() > 0.95
    beside = np.concatenate([scipy.ndimage.maximum_filter(m, 2 * module.RIM + 3).ravel() for m in true])
    assert seen[~beside].mean() < 0.1


def test_what_has_no_texture_may_be_sky(tmp_path: Path) -> None:
    scene = load_scene(under_the_sky(tmp_path / "p", outward=True))
    assert np.mean(masks_of(scene)) == 1.0


def test_cameras_in_one_place_tell_nothing(tmp_path: Path) -> None:
    scene = load_scene(bowl_project(tmp_path / "p"))
    turned = [
        replace(view, camera_to_world=np.block([[view.camera_to_world[:3, :3], np.zeros((3, 1))], [0, 0, 0, 1]]))
        for view in scene.views
    ]
    assert np.mean(masks_of(replace(scene, views=turned))) == 1.0


def test_where_nobody_else_looks_it_may_be_sky(tmp_path: Path) -> None:
    """All cameras but one look away from its wall."""
    scene = load_scene(bowl_project(tmp_path / "p", side=96, colors=stone))
    alone, *others = scene.views
    facing = alone.camera_to_world[:3, 2]
    away = [view for view in others if view.camera_to_world[:3, 2] @ facing < -0.5]
    assert len(away) > 2
    assert np.all(masks_of(replace(scene, views=[alone, *away]))[0])


def test_masks_are_read_at_the_size_of_the_photos_trained_on(tmp_path: Path) -> None:
    scene = load_scene(bowl_project(tmp_path / "p", side=96))
    for large, small in zip(masks_of(scene), masks_of(scene, longest=48)):
        assert small.shape == (48, 48)
        assert (large[::2, ::2] == small).all()


def test_what_lies_between_close_points_is_not_sky(tmp_path: Path) -> None:
    scene = load_scene(under_the_sky(tmp_path / "p"))
    alone = np.mean(masks_of(replace(scene, points=Points.empty())))
    directions = np.random.default_rng(0).normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    around = Points(30 * directions, np.zeros((20_000, 3), np.uint8), np.zeros(20_000))
    assert alone > 0.2
    assert np.mean(masks_of(replace(scene, points=around))) < 0.05


def test_points_far_apart_have_nothing_between_them(tmp_path: Path) -> None:
    """Towers have sky between them."""
    view = load_scene(under_the_sky(tmp_path / "p")).views[0]
    side = view.camera.width
    generator = np.random.default_rng(0)
    column = np.concatenate([generator.uniform(2, 6, 50), generator.uniform(side - 6, side - 2, 50)])
    pixel = np.stack([column, generator.uniform(2, side - 2, 100)], 1)
    local = np.concatenate([(pixel - [view.camera.cx, view.camera.cy]) / view.camera.fx, np.ones((100, 1))], 1)
    points = local @ view.camera_to_world[:3, :3].T + view.camera_to_world[:3, 3]
    whole = between_points(view, points).reshape(side, side)
    near = between_points(view, points, 0.2).reshape(side, side)
    middle = slice(side // 2 - 4, side // 2 + 4)
    assert whole[middle, middle].all()
    assert not near[middle, middle].any()
    assert near[middle, 3:5].any()


@pytest.fixture(scope="module")
def court(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bowl_project(tmp_path_factory.mktemp("court") / "p")


def test_the_environment_is_behind_the_sky_alone(court: Path) -> None:
    trainer = environment_trainer(court)
    batch = trainer.store.batch(torch.arange(256))
    rendered = trainer.model.render(batch.origins, batch.directions, 12)
    assert rendered.environment is not None
    behind, config = torch.rand(256, 3), trainer.config.loss.model_copy(update={"regularization": 0.0})
    half = torch.arange(256) % 2 == 0
    rendered.environment.color.retain_grad()
    total, error = composite_loss(replace(batch, sky=half), rendered, behind, 0.0, config, trainer.model)
    total.backward()
    gradient = rendered.environment.color.grad
    assert gradient is not None
    assert float(gradient[~half].abs().max()) == 0
    assert float(gradient[half].abs().sum(1).min()) > 0
    left = rendered.environment.weight[:, None]
    shown = rendered.color + left * torch.where(half[:, None], rendered.environment.color, behind)
    assert float(error) == pytest.approx(float(((shown - batch.rgb) ** 2).mean().detach()), rel=1e-5)


def test_opacity_has_a_price_before_the_sky_alone(court: Path) -> None:
    trainer = environment_trainer(court)
    batch = trainer.store.batch(torch.arange(256))
    rendered = trainer.model.render(batch.origins, batch.directions, 12)
    half = torch.arange(256) < 128
    prices = []
    for weight in (0.0, 1.0):
        config = trainer.config.loss.model_copy(update={"environment_weight": weight})
        total, _ = composite_loss(replace(batch, sky=half), rendered, torch.zeros(256, 3), 0.0, config, trainer.model)
        prices.append(float(total.detach()))
    assert prices[1] - prices[0] == pytest.approx(float(rendered.opacity[half].sum().detach()) / 256, rel=1e-3)


def test_masks_are_cancelled_between_photos(court: Path) -> None:
    scene, calls = load_scene(court), []

    def check() -> None:
        calls.append(1)
        if len(calls) == 3:
            raise Cancelled

    with pytest.raises(Cancelled):
        sky_masks(scene.views, [view.camera for view in scene.views], scene.points.xyz, CPU, check)
    assert len(calls) == 3
