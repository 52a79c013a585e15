"""Which cells of the field's domain are in how many cameras' view (no occlusion)."""

from __future__ import annotations

import math

import torch

from ..geometry.cameras import Camera
from ..geometry.contraction import grid_position, uncontract

# The width is measured (docs/experiments.md, “What may be closed in front of and between cameras?”), the number not tuned.
FEWEST_POINTS = 20  # in a photo, from which its depths are believed
VIEW_SCALE = 2.0  # view that all of what is photographed from around it fits in, relative to the photos'


def grid_centers(resolution: int, contracted: bool, device: torch.device) -> torch.Tensor:
    """Normalised positions (resolution³, 3) of cell centres, x fastest."""
    axis = (torch.arange(resolution, device=device) + 0.5) / resolution
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    u = torch.stack([x, y, z], -1).reshape(-1, 3)
    return uncontract(u) if contracted else u * 2 - 1


def depth_ranges(
    cameras: list[Camera], camera_to_box: torch.Tensor, points: torch.Tensor, focus: torch.Tensor | None = None
) -> torch.Tensor:
    """How near the sparse points (N, 3) come to each camera and where they mostly are: (V, 2) depths along the optical
    axis, the nearest with a margin and the median; zeros for cameras that see too few points to tell.

    The margin is half the depth that 96 % of the points span, at most half of their distance: surfaces without points
    may come nearer than the points. Where there are no points, cameras that surround `focus` (3,) are taken to show a
    ball there that just fits a view twice as wide as theirs: with φ the half angle of that view, the ball comes as near
    as d (1 − sin φ).
    """
    ranges = torch.zeros(len(cameras), 2, device=camera_to_box.device)
    for index, (camera, pose) in enumerate(zip(cameras, camera_to_box)):
        u, v, z = _project(camera, pose, points)
        depth = z[(z > 1e-6) & (u > 0) & (u < 1) & (v > 0) & (v < 1)]
        if len(depth) >= FEWEST_POINTS and not _sees_everything(camera):
            low, middle, high = depth.quantile(torch.tensor([0.02, 0.5, 0.98], device=depth.device))
            ranges[index, 0] = torch.maximum(low / 2, low - (high - low) / 2)
            ranges[index, 1] = middle
        elif focus is not None and not _sees_everything(camera):
            distance = (focus - pose[:3, 3]) @ pose[:3, 2]
            slope = VIEW_SCALE * max(camera.width / camera.fx, camera.height / camera.fy) / 2
            ranges[index, 0] = (distance * (1 - slope / math.hypot(1, slope))).clamp(min=0)
            ranges[index, 1] = distance.clamp(min=0)
    return ranges


def _sees_everything(camera: Camera) -> bool:
    return camera.model in ("EQUIRECTANGULAR", "OPENCV_FISHEYE")


def _project(
    camera: Camera, pose: torch.Tensor, points: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Position (u, v) of points (N, 3) in the undistorted image as shares of its size, and depth."""
    x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).unbind(1)
    depth = z.clamp(min=1e-6)
    u = (camera.fx * x / depth + camera.cx) / camera.width
    v = (camera.fy * y / depth + camera.cy) / camera.height
    return u, v, z


def cells_at(points: torch.Tensor, resolution: int, contracted: bool) -> torch.Tensor:
    """Indices (M,) of the cells that hold those of the normalised positions (N, 3) that lie in the grid."""
    cell = (grid_position(points, contracted) * resolution).floor().long()
    cell = cell[((cell >= 0) & (cell < resolution)).all(1)]
    return (cell[:, 2] * resolution + cell[:, 1]) * resolution + cell[:, 0]


def _frustum(camera: Camera, pose: torch.Tensor, depth: float) -> torch.Tensor:
    """Points (N, 3) that fill what a camera sees up to a depth: where space is contracted, a cell may hold all of it
    and have its centre elsewhere."""
    side, steps = torch.linspace(0, 1, 16, device=pose.device), torch.linspace(0, 1, 48, device=pose.device)
    v, u, z = torch.meshgrid(side, side, steps * depth, indexing="ij")
    x, y = (u * camera.width - camera.cx) / camera.fx * z, (v * camera.height - camera.cy) / camera.fy * z
    return torch.stack([x, y, z], -1).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]


def in_front(
    cameras: list[Camera], camera_to_box: torch.Tensor, resolution: int, contracted: bool, ranges: torch.Tensor
) -> torch.Tensor:
    """Which cells (resolution³,) bool are nearer to a camera, in its view, than anything in its photo; `ranges` (V, 2)
    of `depth_ranges`."""
    points = grid_centers(resolution, contracted, camera_to_box.device)
    empty = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for camera, pose, near in zip(cameras, camera_to_box, ranges[:, 0].tolist()):
        if near > 0 and not _sees_everything(camera):
            u, v, z = _project(camera, pose, points)
            empty |= (z > 1e-6) & (z < near) & (u > 0) & (u < 1) & (v > 0) & (v < 1)
            empty[cells_at(_frustum(camera, pose, near), resolution, contracted)] = True
    return empty


def view_counts(
    cameras: list[Camera],
    camera_to_box: torch.Tensor,
    resolution: int,
    contracted: bool,
    middle: torch.Tensor,
    margin: float = 0.1,
) -> tuple[torch.Tensor, torch.Tensor]:
    """How many cameras see each cell centre, (resolution³,) float32, and which centres (resolution³,) bool some camera
    sees at least as far away as most of its photo, `middle` (V,) of `depth_ranges`.

    A camera sees what its undistorted image, widened by `margin` of its size, holds in front of it. Equirectangular
    and fisheye cameras see everything. Cells that only one camera sees, nearer than most of its photo, would let a
    field explain that photo by a curtain.
    """
    device = camera_to_box.device
    points = grid_centers(resolution, contracted, device)
    counts, beyond = torch.zeros(len(points), device=device), torch.zeros(len(points), dtype=torch.bool, device=device)
    for camera, pose, depth in zip(cameras, camera_to_box, middle):
        if _sees_everything(camera):
            counts += 1
            beyond |= True
            continue
        u, v, z = _project(camera, pose, points)
        seen = (z > 1e-6) & (u > -margin) & (u < 1 + margin) & (v > -margin) & (v < 1 + margin)
        counts += seen
        beyond |= seen & (z >= depth)
    return counts, beyond
