"""Refinement of camera poses: what it corrects, what it leaves, and that it survives a checkpoint."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.config import TrainConfig
from fieldwork.nerfcore.data.camera_rays import CameraRays
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.data.pixels import Batch
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.geometry.similarity import fit_similarity, transform_pose
from fieldwork.nerfcore.params import EvaluateParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project
from fieldwork.nerfcore.render.run import load_info, read_checkpoint, refined_poses, scene_as_trained
from fieldwork.nerfcore.train.pose_refinement import PoseRefinement, level_weights, skew
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project, camera_poses
from scipy.spatial.transform import Rotation

VIEWS = 24


def disturbed(poses: list[np.ndarray], degrees: float, distance: float) -> list[np.ndarray]:
    rng = np.random.default_rng(5)
    result = []
    for pose in poses:
        moved = pose.copy()
        moved[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * _unit(rng)).as_matrix() @ pose[:3, :3]
        moved[:3, 3] += distance * _unit(rng)
        result.append(moved)
    return result


def _unit(rng: np.random.Generator) -> np.ndarray:
    value = rng.normal(size=3)
    return value / np.linalg.norm(value)


def pose_errors(found: list[np.ndarray], true: list[np.ndarray]) -> tuple[float, float]:
    """Mean error in degrees and in units, after the best similarity of the centres."""
    a, b = (np.stack([p[:3, 3] for p in poses]) for poses in (found, true))
    fit = fit_similarity(a, b)
    turn = fit[:3, :3] / np.cbrt(np.linalg.det(fit[:3, :3]))
    angles = [np.degrees(Rotation.from_matrix(turn @ f[:3, :3] @ t[:3, :3].T).magnitude()) for f, t in zip(found, true)]
    return float(np.mean(angles)), float(np.linalg.norm(a @ fit[:3, :3].T + fit[:3, 3] - b, axis=1).mean())


def train(
    folder: Path, run: str, steps: int, report: Reporter | None = None, resume: bool = False, **settings: str
) -> dict:
    values = {**SMALL, **{k.replace("__", "."): v for k, v in settings.items()}}
    params = TrainParams(project=folder, preset="draft", run=run, steps=steps, resume=resume, set=values)
    return run_verb("train", params, report or Reporter())


@pytest.fixture(scope="module")
def disturbed_project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("refine") / "ball"
    return ball_project(folder, VIEWS, 48, given=disturbed(camera_poses(VIEWS), 1.5, 0.03))


def looked_at(found: list[np.ndarray], true: list[np.ndarray], side: int = 48) -> float:
    """Mean distance in pixels between where found and true cameras see points of the ball."""
    a, b = (np.stack([p[:3, 3] for p in poses]) for poses in (found, true))
    fit = fit_similarity(b, a)
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 3))
    moved = points @ fit[:3, :3].T + fit[:3, 3]
    errors = []
    for ours, theirs in zip(found, true):
        p, q = ((x - pose[:3, 3]) @ pose[:3, :3] for x, pose in ((moved, ours), (points, theirs)))
        errors.append(1.375 * side * np.linalg.norm(p[:, :2] / p[:, 2:] - q[:, :2] / q[:, 2:], axis=1).mean())
    return float(np.mean(errors))


@pytest.mark.slow
def test_refinement_reduces_the_error_of_disturbed_poses(disturbed_project: Path) -> None:
    result = train(disturbed_project, "refined", 1500, train__refine_poses="true")
    kept = train(disturbed_project, "kept", 1500)
    file = json.loads((disturbed_project / "runs" / "refined" / "poses.json").read_text())
    names = [image["name"] for image in file["images"]]
    true = [camera_poses(VIEWS)[int(name)] for name in names]
    given = [disturbed(camera_poses(VIEWS), 1.5, 0.03)[int(name)] for name in names]
    found = [np.array(image["camera_to_world"]) for image in file["images"]]
    before, after = pose_errors(given, true), pose_errors(found, true)
    # A small turn and a small sidestep look alike, so each alone is found less well than what the camera sees.
    assert looked_at(found, true) < 0.35 * looked_at(given, true)
    assert after[0] < 0.75 * before[0]
    assert after[1] < before[1]
    assert result["psnr_train"] > kept["psnr_train"] + 4
    assert 0.3 < result["pose_shift"]["median_degrees"] < 3
    scores = run_verb("evaluate", EvaluateParams(project=disturbed_project, run="refined"), Reporter())
    assert scores["psnr"] > scores["psnr_given_poses"] + 3
    plain = run_verb("evaluate", EvaluateParams(project=disturbed_project, run="kept"), Reporter())
    assert scores["psnr"] > plain["psnr"] + 3
    assert "psnr_given_poses" not in plain


def tiny_rays(poses: list[np.ndarray]) -> CameraRays:
    camera = Camera(width=8, height=8, fx=8, fy=8, cx=4, cy=4)
    return CameraRays([camera] * len(poses), np.stack(poses), torch.device("cpu"))


def test_gradients_on_rays_lead_to_the_true_cameras() -> None:
    true = camera_poses(5)
    rays, goal = tiny_rays(disturbed(true, 1.0, 0.02)), tiny_rays(true)
    refinement = PoseRefinement(rays, TrainConfig(pose_rate=3e-3), keep_rig=False)
    image, pixel = torch.arange(5).repeat_interleave(64), torch.arange(64).repeat(5)
    wanted = goal(image, pixel)
    before = float((rays.center - goal.center).norm(dim=1).mean())
    for step in range(300):
        solid = torch.ones(320)
        batch = Batch(*rays(image, pixel), torch.zeros(320, 3), solid, image, image, pixel, solid, solid)
        batch = refinement.move(batch)
        loss = ((batch.origins - wanted[0]) ** 2).sum() + ((batch.directions - wanted[1]) ** 2).sum()
        o, d = torch.autograd.grad(loss, (batch.origins, batch.directions))
        # in parts, as the trainer's shards give them
        refinement.step([(o[:100], d[:100]), (o[100:], d[100:])], step / 300)
    found = refinement.poses(rays)
    assert float((found[:, :3, 3] - goal.center).norm(dim=1).mean()) < 0.02 * before
    assert torch.allclose(found[:, :3, :3], goal.rotation, atol=1e-4)
    assert torch.allclose(found[:, :3, :3] @ found[:, :3, :3].transpose(1, 2), torch.eye(3).expand(5, 3, 3), atol=1e-5)


def test_a_common_motion_of_all_cameras_is_taken_out_and_nothing_else() -> None:
    rays = tiny_rays(camera_poses(9))
    refinement = PoseRefinement(rays, TrainConfig())
    turn, shift, scale = torch.tensor([[0.002, -0.001, 0.003]]), torch.tensor([0.01, 0.02, -0.01]), 0.005
    with torch.no_grad():
        refinement.correction[:, :3] = turn
        refinement.correction[:, 3:] = shift + scale * rays.center + rays.center @ skew(turn)[0].T
    refinement._keep_rig()
    assert float(refinement.correction.detach().abs().max()) < 1e-5
    with torch.no_grad():
        refinement.correction[4, :3] = torch.tensor([0.01, 0.0, 0.0])
    before = refinement.correction.clone()
    refinement._keep_rig()
    assert torch.allclose(refinement.correction, before, atol=1e-7)


def test_fine_levels_move_cameras_later() -> None:
    assert level_weights(8, 0.0) == [1, 1, 1, 0, 0, 0, 0, 0]
    assert level_weights(8, 0.5) == [1.0] * 8
    middle = level_weights(8, 0.25)
    assert middle == sorted(middle, reverse=True)
    assert 3 < sum(middle) < 8


@pytest.mark.setting("train.refine_poses", "train.pose_start")
def test_refinement_starts_when_told_and_survives_a_checkpoint(tmp_path: Path) -> None:
    folder = ball_project(tmp_path / "ball", 9, 24)
    settings = {"train__refine_poses": "true", "train__pose_start": "0.5"}

    def state(run: str) -> dict[str, torch.Tensor]:
        return read_checkpoint(folder / "runs" / run / "field.safetensors", torch.device("cpu"))[0]

    class Stop(Reporter):
        left = 8 + 45  # one check a photo, one a step

        def check(self) -> None:
            self.left -= 1
            if self.left < 0:
                raise Cancelled

    train(folder, "whole", 60, **settings)
    with pytest.raises(Cancelled):
        train(folder, "parts", 60, report=Stop(), **settings)
    assert float(state("parts")["poses.correction"].abs().max()) > 0
    train(folder, "parts", 60, resume=True, **settings)
    whole, parts = state("whole"), state("parts")
    assert [name for name in whole if not torch.equal(whole[name], parts[name])] == []
    info = load_info(folder, "whole")
    used = {view.name: view.camera_to_world for view in scene_as_trained(folder, "whole", info).views}
    world_from_box = info.box(load_project(folder)).world_from_box
    refined = refined_poses(folder, "whole", info)
    assert refined
    for name, pose in refined.items():
        assert np.allclose(used[name], transform_pose(world_from_box, pose))
    given = {view.name: view.camera_to_world for view in load_scene(folder, info.holdout).views}
    assert not np.allclose(used[next(iter(refined))], given[next(iter(refined))], atol=1e-6)
    train(folder, "late", 60, **{**settings, "train__pose_start": "0.99"})
    assert float(state("late")["poses.correction"].abs().max()) == 0
