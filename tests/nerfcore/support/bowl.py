"""A court drawn from a formula: a patterned bowl seen from inside by few cameras, and a sky above its rim."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.render.verb import look_at
from fieldwork.tests.nerfcore.support.ball import ball_project, pattern
from fieldwork.tests.nerfcore.support.sky import looking, sky
from PIL import Image

RADIUS, RIM = 2.0, 0.6  # of the bowl, and height up to which it reaches


def inside_poses(views: int) -> list[np.ndarray]:
    """Camera-to-world poses on a ring that look across, level, each a little to a side."""
    poses = []
    for i in range(views):
        angle = 2 * math.pi * i / views
        across = angle + math.pi + 0.5 * math.sin(5 * angle)
        place = 0.9 * np.array([math.cos(angle), math.sin(angle), 0.1 * math.sin(3 * angle)])
        poses.append(look_at(place, RADIUS * np.array([math.cos(across), math.sin(across), 0.1])))
    return poses


def distances(camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Lengths (H, W) of the rays up to the bowl, infinite where they end in the sky."""
    direction, place = looking(camera, pose), pose[:3, 3]
    along = direction @ place
    length = -along + np.sqrt(along**2 - place @ place + RADIUS**2)
    return np.where((place + direction * length[..., None])[..., 2] < RIM, length, np.inf)


def stone(points: np.ndarray, grain: float = 0.04) -> np.ndarray:
    """Grey colours (…, 3) in [0.4, 0.6] of points (…, 3): noise with grains of that size."""
    values = np.random.default_rng(0).uniform(0.4, 0.6, (40, 40, 40))
    found = scipy.ndimage.map_coordinates(values, np.moveaxis(points, -1, 0) / grain, order=1, mode="grid-wrap")
    return np.repeat(found[..., None], 3, -1)


def bowl_project(
    folder: Path, views: int = 14, side: int = 48, colors: Callable[[np.ndarray], np.ndarray] = pattern
) -> Path:
    """Write the capture as a project without points; the bowl's `colors` (…, 3) are those of its points (…, 3)."""
    project = ball_project(folder, views=views, side=side, given=inside_poses(views))
    for view in load_scene(project).views:
        direction, length = looking(view.camera, view.camera_to_world), distances(view.camera, view.camera_to_world)
        ends = view.camera_to_world[:3, 3] + direction * np.where(np.isfinite(length), length, 1)[..., None]
        seen = np.where(np.isfinite(length)[..., None], colors(ends), sky(direction))
        Image.fromarray((seen * 255 + 0.5).astype(np.uint8)).save(view.image)
        Image.fromarray(np.zeros(length.shape, np.uint8)).save(project / "labels" / view.image.name)
    return project
