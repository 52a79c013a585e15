"""A capture drawn from a formula: a patterned opaque ball with labels, depth maps and sparse points, exact in all."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.geometry.points import Points
from fieldwork.nerfcore.project.schema import ImageRecord, PosedImage, Poses, Project, SemanticClass
from fieldwork.nerfcore.project.store import save_poses, save_project
from fieldwork.nerfcore.render.verb import look_at
from PIL import Image

RADIUS = 0.5
# Training small enough for tests.
SMALL = {
    "field.levels": "3",
    "field.finest": "48",
    "field.table_log2": "14",
    "field.width": "16",
    "sampling.resolution": "32",
    "sampling.warmup": "32",
    "train.batch_start": "2048",
    "train.batch_samples": "4096",
    "sampling.outline_rays": "0",  # such small photos are nearly all outline
    "train.seed": "3",
}


def pattern(points: np.ndarray) -> np.ndarray:
    """Smooth colours (…, 3) in [0.1, 0.9] of points (…, 3)."""
    phase = np.stack([points @ [9.0, 4.0, 2.0], points @ [-3.0, 8.0, 5.0] + 1, points @ [2.0, -5.0, 9.0] + 2], -1)
    return 0.5 + 0.4 * np.sin(phase)


def draw(camera: Camera, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """RGBA (H, W, 4) uint8, labels (1 above z = 0, 2 below, 0 beside) and depth along the axis (0 beside) (H, W)."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
    length = np.linalg.norm(local, axis=-1)
    d = local / length[..., None] @ pose[:3, :3].T
    o = pose[:3, 3]
    b = d @ o
    root = b * b - (o @ o - RADIUS**2)
    hit = root > 0
    distance = -b - np.sqrt(np.maximum(root, 0))
    point = o + d * distance[..., None]
    rgba = np.zeros((*x.shape, 4), np.uint8)
    rgba[hit, :3] = (pattern(point[hit]) * 255 + 0.5).astype(np.uint8)
    rgba[hit, 3] = 255
    label = np.where(hit, np.where(point[..., 2] > 0, 1, 2), 0).astype(np.uint8)
    return rgba, label, np.where(hit, distance / length, 0).astype(np.float32)


def camera_poses(views: int, distance: float = 1.8) -> list[np.ndarray]:
    """Camera-to-world poses around the ball, at changing heights."""
    return [
        look_at(
            distance * np.array([math.cos(2 * math.pi * i / views), math.sin(2 * math.pi * i / views), 0.0])
            + [0, 0, 0.9 * math.sin(i * 2.4)],
            np.zeros(3),
        )
        for i in range(views)
    ]


def ball_project(
    folder: Path,
    views: int = 16,
    side: int = 40,
    given: list[np.ndarray] | None = None,
    depth: bool = False,
    points: int = 0,
) -> Path:
    """Write the capture as a project.

    Args:
        given: poses that the project claims, when not the true ones the photos are drawn with.
        depth: with depth maps.
        points: number of sparse points on the ball, each seen by the views it faces.
    """
    camera = Camera(width=side, height=side, fx=1.375 * side, fy=1.375 * side, cx=side / 2, cy=side / 2)
    true = camera_poses(views)
    images, posed = [], []
    for kind in ("images", "labels", "depth"):
        (folder / kind).mkdir(parents=True)
    for i, pose in enumerate(true):
        name = f"{i:02d}"
        rgba, label, far = draw(camera, pose)
        Image.fromarray(rgba).save(folder / "images" / f"{name}.png")
        Image.fromarray(label).save(folder / "labels" / f"{name}.png")
        if depth:
            oiio.ImageBuf(np.ascontiguousarray(far[..., None])).write(str(folder / "depth" / f"{name}.exr"))
        images.append(
            ImageRecord(
                name=name,
                file=f"images/{name}.png",
                label=f"labels/{name}.png",
                depth=f"depth/{name}.exr" if depth else None,
                width=side,
                height=side,
            )
        )
        posed.append(PosedImage(name=name, camera=0, camera_to_world=(given or true)[i].tolist()))
    classes = [
        SemanticClass(id=1, name="top", color=(0.8, 0.2, 0.2)),
        SemanticClass(id=2, name="bottom", color=(0.2, 0.3, 0.8)),
    ]
    save_project(folder, Project(images=images, classes=classes))
    sparse, visibility = _sparse(points, true)
    save_poses(folder, Poses(source="test", cameras=[camera], images=posed), sparse, visibility)
    return folder


def _sparse(count: int, poses: list[np.ndarray]) -> tuple[Points, tuple[np.ndarray, np.ndarray] | None]:
    if count == 0:
        return Points.empty(), None
    xyz = np.random.default_rng(1).normal(size=(count, 3))
    xyz *= RADIUS / np.linalg.norm(xyz, axis=1, keepdims=True)
    pairs = [
        (i, k) for i, pose in enumerate(poses) for k in range(count) if xyz[k] @ (pose[:3, 3] - xyz[k]) > 0.1 * RADIUS
    ]
    view, point = np.array(pairs).T
    return Points(xyz, (pattern(xyz) * 255).astype(np.uint8), np.ones(count)), (view, point)
