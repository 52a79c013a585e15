"""Depth supervision: which rays are known, how the loss values them, and that it moves the surface."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from fieldwork.nerfcore.config import make_config
from fieldwork.nerfcore.data.box import box_poses
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.data.scene import View
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.images.working import read_picture
from fieldwork.nerfcore.params import TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.render.image import render_view
from fieldwork.nerfcore.render.run import load_trained
from fieldwork.nerfcore.train.depth import DepthRays, _of_map, depth_loss, point_trust
from fieldwork.nerfcore.train.prepare import make_trainer, plan_run
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import RADIUS, SMALL, ball_project


def known_rays(folder: Path, **settings: str) -> tuple[DepthRays, torch.Tensor]:
    """The known rays of a project, and where they end in the world (M, 3)."""
    values = {**SMALL, "loss.depth_weight": "0.1", **{k.replace("__", "."): v for k, v in settings.items()}}
    info, scene = plan_run(folder, "draft", make_config("draft", values), torch.device("cpu"))
    trainer = make_trainer(folder, info, scene, torch.device("cpu"), Reporter())
    known, rays = trainer.depths, trainer.store.rays
    assert known is not None
    direction = torch.einsum("nij,nj->ni", rays.rotation[known.image], known.direction)
    end = rays.center[known.image] + direction * known.distance[:, None]
    from_box = torch.tensor(info.sfm_from_box)
    return known, end @ from_box[:3, :3].T + from_box[:3, 3]


@pytest.mark.setting("loss.depth_weight")
def test_rays_through_sparse_points_end_on_them(tmp_path: Path) -> None:
    known, ends = known_rays(ball_project(tmp_path / "ball", 8, 40, points=60))
    assert len(known) > 100
    assert torch.allclose(ends.norm(dim=1), torch.full((len(ends),), RADIUS), atol=1e-4)
    assert torch.allclose(known.weight, torch.full((len(ends),), math.exp(-1)))
    assert set(known.image.tolist()) == set(range(7))  # the held-out view has no say


def test_rays_of_depth_maps_end_on_the_surface(tmp_path: Path) -> None:
    known, ends = known_rays(ball_project(tmp_path / "ball", 8, 40, depth=True))
    assert len(known) > 7 * 100
    assert torch.allclose(ends.norm(dim=1), torch.full((len(ends),), RADIUS), atol=1e-3)
    assert bool((known.weight == 1).all())


def test_depth_of_a_panorama_is_along_the_ray(tmp_path: Path) -> None:
    camera = Camera(model="EQUIRECTANGULAR", width=32, height=16, fx=16, fy=16, cx=16, cy=8)
    depth = tmp_path / "depth.exr"
    oiio.ImageBuf(np.full((16, 32, 1), 2.0, np.float32)).write(str(depth))
    view = View("all around", camera, np.eye(4), Path(), depth=depth)
    direction, distance, weight = _of_map(view, camera, 0.5, np.ones((16, 32), bool))
    assert len(direction) == len(weight) == 32 * 16
    assert np.allclose(distance, 1.0)
    assert (direction[:, 2] < 0).sum() == 32 * 16 // 2  # behind it as well


def test_points_that_reproject_badly_are_trusted_less() -> None:
    trust = point_trust(np.array([0.1, 1.0, 3.0]))
    assert trust[0] > 0.9
    assert trust[2] < 0.2
    assert np.array_equal(point_trust(np.zeros(3)), np.ones(3))
    assert len(point_trust(np.zeros(0))) == 0


def test_the_loss_is_zero_at_the_right_depth_and_weighs_rays() -> None:
    distance = torch.tensor([1.0, 2.0, 4.0])
    assert float(depth_loss(distance, distance, torch.ones(3))) == 0
    short = torch.tensor([1.0, 1.0, 4.0], requires_grad=True)
    loss = depth_loss(short, distance, torch.tensor([1.0, 0.5, 0.25]))
    assert float(loss.detach()) == pytest.approx(0.5 * (0.5 - 0.05) / 1.75)
    loss.backward()
    assert short.grad is not None
    assert short.grad[1] < 0
    assert short.grad[0] == short.grad[2] == 0
    assert float(depth_loss(short, distance, torch.zeros(3)).detach()) == 0


def surface_error(folder: Path, run: str) -> float:
    """Mean distance of the rendered surface from the ball, over rays of a view that was not trained on."""
    trained, scene = load_trained(folder, run), load_scene(folder)
    view = next(v for v in scene.views if v.name not in trained.info.images)
    to_world = np.array(trained.info.sfm_from_box)
    pose = box_poses([view], np.linalg.inv(to_world))[0]
    frame = render_view(trained.model, view.camera, pose, 0.0, semantics=False)
    points = frame.position.reshape(-1, 3) @ to_world[:3, :3].T + to_world[:3, 3]
    ball = (read_picture(view.image).pixels[..., 3] > 127).ravel() & np.isfinite(points).all(1)
    return float(np.abs(np.linalg.norm(points[ball], axis=1) - RADIUS).mean())


@pytest.mark.slow
def test_depth_pulls_the_surface_into_place(tmp_path: Path) -> None:
    """Three views leave the shape open; points on it do not."""
    folder = ball_project(tmp_path / "ball", 4, 40, points=150)
    for run, weight in (("without", "0"), ("with", "0.3")):
        settings = {**SMALL, "loss.depth_weight": weight, "train.view_share": "0.75"}
        params = TrainParams(project=folder, preset="draft", run=run, steps=600, set=settings)
        run_verb("train", params, Reporter())
    assert surface_error(folder, "with") < 0.9 * surface_error(folder, "without")


def test_a_project_without_depths_says_so(tmp_path: Path) -> None:
    told: list[str] = []

    class Listener(Reporter):
        def warn(self, message: str) -> None:
            told.append(message)

    folder = ball_project(tmp_path / "ball", 4, 24)
    settings = {**SMALL, "loss.depth_weight": "0.1"}
    run_verb("train", TrainParams(project=folder, preset="draft", steps=3, set=settings), Listener())
    assert any("depth_weight" in message for message in told)
