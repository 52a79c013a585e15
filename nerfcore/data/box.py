"""Where the field's unit cube lies in the world, and whether all of space is contracted into it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..config import SceneConfig
from ..geometry.frames import focus_point
from ..geometry.similarity import make_similarity, similarity_scale
from .scene import Scene, View

# Not tuned: the next two.
FEWEST_POINTS = 100  # sparse points that say where things are
POINTS_MARGIN = 1.3  # surfaces reach beyond their points


@dataclass(frozen=True)
class Box:
    """`world_from_box` (4, 4) maps the cube [−1, 1]³ to the region of interest; `contracted`: see kernels/traversal.py."""

    world_from_box: np.ndarray
    contracted: bool

    @property
    def box_from_world(self) -> np.ndarray:
        return np.linalg.inv(self.world_from_box)


def looks_inward(views: list[View]) -> bool:
    """True when the cameras surround what they look at: their focus is in front of nearly all of them."""
    focus = focus_point([view.camera_to_world for view in views])
    offsets = np.stack([focus - view.camera_to_world[:3, 3] for view in views])
    axes = np.stack([view.camera_to_world[:3, 2] for view in views])
    cosine = (offsets * axes).sum(1) / np.maximum(np.linalg.norm(offsets, axis=1), 1e-9)
    return float((cosine > 0.7).mean()) > 0.9


def choose_box(scene: Scene, config: SceneConfig, empty_around: bool) -> Box:
    """Fit the cube to a scene in the world frame.

    - Bounds given by the capture (or the crop box): the cube around them, nothing outside.
    - Photos or masks with empty surroundings (`empty_around`), photos in front of black or white too: the cube holds
      what the cameras surround, nothing outside.
    - Inward-looking captures with visible surroundings: the cube reaches from the focus to the cameras, or holds the
      sparse points (without points: what fills the photos) where those all lie closer together; space beyond is
      contracted.
    - Everything else (rooms, walks): the cube holds all cameras and most sparse points; beyond is contracted.
    """
    centers = np.stack([view.camera_to_world[:3, 3] for view in scene.views])
    if scene.bounds is not None:
        low, high = scene.bounds
        return _box((low + high) / 2, float((high - low).max()) / 2 * config.margin, config.contraction == "on")
    if looks_inward(scene.views):
        focus = focus_point([view.camera_to_world for view in scene.views])
        reach = np.linalg.norm(centers - focus, axis=1)
        if empty_around and config.contraction != "on":
            return _box(focus, _object_radius(scene, focus, reach) * config.margin, False)
        # Cameras just inside the cube: what stands between and behind them is resolved finely too.
        extent = float(np.abs(centers - focus).max())
        middle, half = _points_extent(scene)
        if not np.isfinite(half):
            middle, half = focus, _object_radius(scene, focus, reach)
        if half * POINTS_MARGIN < extent:
            return _box(middle, half * POINTS_MARGIN * config.margin, config.contraction != "off")
        return _box(focus, extent * config.margin, config.contraction != "off")
    low, high = centers.min(0), centers.max(0)
    if len(scene.points) >= FEWEST_POINTS:
        inside = np.percentile(scene.points.xyz, [2, 98], axis=0)
        low, high = np.minimum(low, inside[0]), np.maximum(high, inside[1])
    half = float((high - low).max()) / 2
    return _box((low + high) / 2, max(half, 1e-6) * config.margin, config.contraction != "off")


def _points_extent(scene: Scene) -> tuple[np.ndarray, float]:
    """Centre (3,) and half side of the cube around nearly all sparse points; infinite when there are few."""
    if len(scene.points) < FEWEST_POINTS:
        return np.zeros(3), np.inf
    low, high = np.percentile(scene.points.xyz, [1, 99], axis=0)
    return (low + high) / 2, float((high - low).max()) / 2


def _object_radius(scene: Scene, focus: np.ndarray, reach: np.ndarray) -> float:
    """Half side of the cube that an object seen whole from all sides fits in."""
    sizes = []
    for view, distance in zip(scene.views, reach):
        camera = view.camera
        sizes.append(distance * max(camera.width / camera.fx, camera.height / camera.fy) / 2)
    return float(np.median(sizes))


def _box(center: np.ndarray, half: float, contracted: bool) -> Box:
    return Box(make_similarity(half, np.eye(3), center), contracted)


def box_poses(views: list[View], box_from_world: np.ndarray) -> np.ndarray:
    """Camera-to-box poses (N, 4, 4), rotations kept orthonormal."""
    poses = np.stack([view.camera_to_world for view in views])
    moved = box_from_world @ poses
    moved[:, :3, :3] /= similarity_scale(box_from_world)
    return moved
