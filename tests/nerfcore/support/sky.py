"""The ball's capture under a sky drawn from a formula, in opaque photos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from fieldwork.nerfcore.config import make_config
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.geometry.cameras import Camera, pixel_centers
from fieldwork.nerfcore.kernels.device import use_device
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import SemanticClass
from fieldwork.nerfcore.project.store import load_project, save_project
from fieldwork.nerfcore.train.prepare import make_trainer, plan_run
from fieldwork.nerfcore.train.trainer import Trainer
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project, camera_poses
from PIL import Image

VIEWS = 48
FLOOR = -2.0  # height of the floor


def sky(directions: np.ndarray) -> np.ndarray:
    """Colours (…, 3) of directions (…, 3): a gradient with soft clouds."""
    height = directions[..., 2:] * [0.25, 0.1, -0.2]
    clouds = 0.1 * np.sin(directions @ [3.0, 2.0, 1.0])[..., None]
    return 0.55 + height + clouds


def looking(camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Unit directions (H, W, 3) of a pinhole's pixels in the world."""
    place = (pixel_centers(camera.width, camera.height) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    d = np.concatenate([place, np.ones_like(place[..., :1])], -1) @ pose[:3, :3].T
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def floor(directions: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Colours (…, 3) of a floor with waves far below, as a camera at `center` (3,) sees it in directions (…, 3)."""
    place = center[:2] + directions[..., :2] * ((FLOOR - center[2]) / np.minimum(directions[..., 2:], -1e-6))
    return np.repeat(0.5 + 0.3 * np.sin(4 * place[..., :1]) * np.sin(4 * place[..., 1:]), 3, -1)


def under_the_sky(folder: Path, named: str | None = None, outward: bool = False, above_a_floor: bool = False) -> Path:
    """The ball's capture with opaque photos, in which the sky is behind it, on all sides or above the horizon alone; a class
    of its own where it is `named`. `outward`: the cameras turn their backs to the ball, which no photo shows."""
    poses = [pose @ np.diag([-1.0, 1, -1, 1]) if outward else pose for pose in camera_poses(VIEWS)]
    project = ball_project(folder, views=VIEWS, given=poses)
    camera = load_scene(project).views[0].camera
    for i, pose in enumerate(poses):
        path = project / "images" / f"{i:02d}.png"
        rgba = np.asarray(Image.open(path))
        directions = looking(camera, pose)
        colors = sky(directions)
        if above_a_floor:
            colors = np.where(directions[..., 2:] < 0, floor(directions, pose[:3, 3]), colors)
        behind = (colors * 255 + 0.5).astype(np.uint8)
        ball = (rgba[..., 3:] > 0) & (not outward)
        Image.fromarray(np.where(ball, rgba[..., :3], behind)).save(path)
        if named:
            labels = project / "labels" / path.name
            label = np.asarray(Image.open(labels))
            Image.fromarray(np.where(label == 0, 3, label).astype(np.uint8)).save(labels)
    if named:
        saved = load_project(project)
        saved.classes.append(SemanticClass(id=3, name=named, color=(0.3, 0.5, 0.9)))
        save_project(project, saved)
    return project


def environment_trainer(project: Path, **settings: str) -> Trainer:
    """The trainer of a small field with an environment; `settings`: by name, `__` for a dot."""
    values = {**SMALL, "scene.background": "environment", **{k.replace("__", "."): v for k, v in settings.items()}}
    info, scene = plan_run(project, "draft", make_config("draft", values), use_device())
    return make_trainer(project, info, scene, use_device(), Reporter())
