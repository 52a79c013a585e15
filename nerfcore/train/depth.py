"""Depth supervision: training rays whose length to the surface is known, from SfM points and from depth maps.

Source: Deng et al., "Depth-supervised NeRF", 2022: rays through the keypoints of sparse points, weighted by how well
each point reprojects. Sensor depth, where a capture has it, is the same with many more rays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ..data.pixels import PixelStore
from ..data.scene import Scene, View
from ..geometry.cameras import Camera, project, rays
from ..geometry.similarity import similarity_scale, transform_points
from ..images.working import read_depth

# Not tuned: the next two.
RAYS = 512  # a step
MAP_PIXELS = 20000  # of one depth map


@dataclass(frozen=True)
class DepthRays:
    """M rays of known length: image (M,) int64 index into the store; direction (M, 3) unit, camera axes; distance (M,)
    to the surface in normalised units; weight (M,) in [0, 1], how far it is to be trusted."""

    image: torch.Tensor
    direction: torch.Tensor
    distance: torch.Tensor
    weight: torch.Tensor

    def __len__(self) -> int:
        return len(self.image)

    def draw(
        self, rotation: torch.Tensor, center: torch.Tensor, generator: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Origins and directions (R, 3), distances and weights (R,) of a random part of the rays.

        `rotation` (V, 3, 3), `center` (V, 3): camera-to-box poses of the store's views.
        """
        count = min(RAYS, len(self))
        chosen = torch.randint(0, len(self), (count,), device=center.device, generator=generator)
        image = self.image[chosen]
        directions = torch.einsum("nij,nj->ni", rotation[image], self.direction[chosen])
        return center[image].contiguous(), directions.contiguous(), self.distance[chosen], self.weight[chosen]


def find_depths(
    scene: Scene,
    store: PixelStore,
    visibility: dict[str, np.ndarray],
    box_from_world: np.ndarray,
    scale: float,
    contracted: bool,
) -> DepthRays:
    """The rays of known length of a store's views.

    Args:
        scene: where the sparse points are, in the world frame.
        visibility: for each image name, the points it saw.
        scale: normalised units per unit of the depth maps.
        contracted: False drops what lies outside the cube [−1, 1]³, where the field cannot be.
    Raises:
        InputError: a depth map cannot be read.
    """
    points = transform_points(box_from_world, scene.points.xyz)
    trust = point_trust(scene.points.error)
    poses = store.rays.rotation.cpu().double().numpy(), store.rays.center.cpu().double().numpy()
    counted = store.rgba[:, 3].cpu().numpy() > 127
    if store.usable is not None:
        usable = np.zeros(len(store), bool)
        usable[store.usable.cpu().numpy()] = True
        counted &= usable
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
    for index, (view, camera) in enumerate(zip(store.views, store.cameras)):
        rotation, center = poses[0][index], poses[1][index]
        first = int(store.first[index])
        free = counted[first : first + camera.width * camera.height].reshape(camera.height, camera.width)
        for direction, distance, weight in (
            _of_points(points, trust, visibility.get(view.name), camera, rotation, center, free),
            _of_map(view, camera, scale, free),
        ):
            ends = center + (direction * distance[:, None]) @ rotation.T
            kept = np.isfinite(distance) & (distance > 0.02)
            kept &= contracted | (np.abs(ends).max(1, initial=0) < 1)
            parts.append((np.full(kept.sum(), index), direction[kept], distance[kept], weight[kept]))
    columns = [np.concatenate(column) for column in zip(*parts)]
    image = torch.from_numpy(columns[0]).long().to(store.device)
    return DepthRays(image, *(torch.from_numpy(c.astype(np.float32)).to(store.device) for c in columns[1:]))


def point_trust(error: np.ndarray) -> np.ndarray:
    """Weights (N,) in (0, 1] of sparse points from their reprojection errors (N,) in pixels: exp(−(e / ē)²)."""
    if len(error) == 0 or not error.max() > 0:
        return np.ones(len(error))
    return np.exp(-((error / error.mean()) ** 2))


Found = tuple[np.ndarray, np.ndarray, np.ndarray]


def _of_points(
    points: np.ndarray,
    trust: np.ndarray,
    seen: np.ndarray | None,
    camera: Camera,
    rotation: np.ndarray,
    center: np.ndarray,
    free: np.ndarray,
) -> Found:
    """Direction, distance and weight of the sparse points that a view saw; `free` (H, W): its pixels that count."""
    if seen is None or len(seen) == 0:
        return np.zeros((0, 3)), np.zeros(0), np.zeros(0)
    local = (points[seen] - center) @ rotation
    distance = np.linalg.norm(local, axis=1)
    with np.errstate(invalid="ignore"):
        pixel = project(camera, local)
        inside = (pixel >= 0).all(1) & (pixel < [camera.width, camera.height]).all(1)
    column, row = np.where(inside[:, None], pixel, 0).astype(int).T
    inside &= free[row, column] & (distance > 0)
    return (local / np.maximum(distance, 1e-12)[:, None])[inside], distance[inside], trust[seen][inside]


def _of_map(view: View, camera: Camera, scale: float, free: np.ndarray) -> Found:
    """The same of evenly spread pixels of a view's depth map (distance along the optical axis, of a panorama along the ray;
    0 unknown)."""
    if view.depth is None:
        return np.zeros((0, 3)), np.zeros(0), np.zeros(0)
    depth = read_depth(view.depth)
    stride = max(1, int(np.ceil(np.sqrt(camera.width * camera.height / MAP_PIXELS))))
    y, x = (
        axis.ravel() for axis in np.mgrid[stride // 2 : camera.height : stride, stride // 2 : camera.width : stride]
    )
    z = depth[y * depth.shape[0] // camera.height, x * depth.shape[1] // camera.width] * scale
    direction, valid = rays(camera, np.stack([x, y], 1) + 0.5)
    along = np.ones(len(z)) if camera.model == "EQUIRECTANGULAR" else direction[:, 2]
    valid &= (z > 0) & np.isfinite(z) & free[y, x] & (along > 1e-3)
    return direction[valid], z[valid] / along[valid], np.ones(valid.sum())


def depth_scale(world_from_sfm: np.ndarray, box_from_world: np.ndarray) -> float:
    """Normalised units per unit of a project's depth maps, which are in the SfM frame."""
    return similarity_scale(box_from_world) * similarity_scale(world_from_sfm)


def depth_loss(expected: torch.Tensor, distance: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Weighted mean of smooth-L1 of the relative error of expected termination depths (R,), Σ T α t / D − 1.

    Depths are not divided by opacity: a ray that lets light through behind its point is too short and is corrected too.
    """
    error = torch.nn.functional.smooth_l1_loss(
        expected / distance, torch.ones_like(distance), beta=0.1, reduction="none"
    )
    return (error * weight).sum() / weight.sum().clamp(min=1e-6)
