"""Where the photos of something were taken from: new viewpoints are mostly there as well, and nothing may hang before
them.

No photo looks at what is beside its camera, so a field may leave haze there which the photos from the other side show in
the colours of what is behind it.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from ..geometry.cameras import Camera
from .visibility import FEWEST_POINTS, cells_at, depth_ranges, grid_centers, in_front

# Measured: docs/experiments.md, “What may be closed in front of and between cameras?” (clearance) and “How far apart may
# neighbouring cameras look?” (angle). The other two are not tuned.
CLEARANCE = 0.125  # of their distance to what they surround, that nothing comes nearer to the way between cameras
NEIGHBOURS = 6  # of a camera, to which that way leads
LEAST_COSINE = math.cos(math.radians(55))  # of viewing directions: a round of seven photos has ways between them
LEAST_SPACING = 0.1  # of that distance: cameras nearer to others add nothing


def cells_before_path(
    cameras: list[Camera],
    camera_to_box: torch.Tensor,
    focus: torch.Tensor,
    points: torch.Tensor,
    resolution: int,
    contracted: bool,
) -> torch.Tensor:
    """Which cells (resolution³,) bool must be empty because cameras that surround `focus` (3,) went past them: those
    close to the way between neighbours, and those nearer to a camera half way than anything it would show. Sparse
    points (N, 3) near the way keep it at half their distance."""
    apart = _apart(camera_to_box[:, :3, 3], focus)  # hundreds of photos would take long and add nothing
    cameras, camera_to_box = [cameras[i] for i in apart], camera_to_box[apart]
    free = {
        pair: _clearance(camera_to_box[list(pair), :3, 3], focus, points) for pair in _neighbours(camera_to_box, focus)
    }
    # Less than half a cell: something stands on the way, so nobody went there.
    free = {pair: radius for pair, radius in free.items() if radius >= 1 / resolution}
    lenses, between = cameras_between(cameras, camera_to_box, list(free), focus)
    ranges = depth_ranges(lenses, between, points, focus)
    near = _along(camera_to_box, free, resolution, contracted)
    return near | in_front(lenses, between, resolution, contracted, ranges)


def cameras_between(
    cameras: list[Camera], camera_to_box: torch.Tensor, pairs: list[tuple[int, int]], focus: torch.Tensor
) -> tuple[list[Camera], torch.Tensor]:
    """Cameras half way between those of each pair, with the lens of one: lenses and poses (M, 4, 4). Left out where
    another is near."""
    lenses, poses = [], list(camera_to_box)
    for i, j in pairs:
        pose = (camera_to_box[i] + camera_to_box[j]) / 2
        u, _, v = torch.linalg.svd(pose[:3, :3])
        pose[:3, :3] = u @ v  # the nearest rotation
        gap = (torch.stack(poses)[:, :3, 3] - pose[:3, 3]).norm(dim=1).min()
        if gap > LEAST_SPACING * (pose[:3, 3] - focus).norm():
            lenses.append(cameras[i])
            poses.append(pose)
    return lenses, torch.stack(poses)[len(camera_to_box) :]


def _clearance(ends: torch.Tensor, focus: torch.Tensor, points: torch.Tensor) -> float:
    """How far around the line between two cameras (2, 3) there is nothing."""
    radius = CLEARANCE * float((ends - focus).norm(dim=1).min())
    if len(points) < FEWEST_POINTS:
        return radius
    return min(radius, float(_distance_to(ends[0], ends[1], points).kthvalue(FEWEST_POINTS).values) / 2)


def _along(
    camera_to_box: torch.Tensor, free: dict[tuple[int, int], float], resolution: int, contracted: bool
) -> torch.Tensor:
    """Cells (resolution³,) around the lines between pairs of cameras, as far as these are `free`."""

    from scipy.spatial import KDTree  # takes a tenth of a second, and few trainings come here

    device = camera_to_box.device
    tree = KDTree(grid_centers(resolution, contracted, device).cpu().numpy())
    close = torch.zeros(resolution**3, dtype=torch.bool, device=device)
    centers = camera_to_box[:, :3, 3]
    for (i, j), radius in free.items():
        count = 2 + math.ceil(float((centers[j] - centers[i]).norm()) / (radius / 4))
        steps = torch.lerp(centers[i], centers[j], torch.linspace(0, 1, count, device=device)[:, None])
        found = np.concatenate(tree.query_ball_point(steps.cpu().numpy(), radius))
        close[torch.from_numpy(found.astype(np.int64)).to(device)] = True
        # Where space is contracted, a cell may be larger than what is free around the way.
        close[cells_at(steps, resolution, contracted)] = True
    return close


def _apart(centers: torch.Tensor, focus: torch.Tensor) -> list[int]:
    """Indices of cameras, in order, that are not near to one before."""
    gap, least = torch.cdist(centers, centers), LEAST_SPACING * (centers - focus).norm(dim=1)
    kept: list[int] = []
    for index in range(len(centers)):
        if not kept or bool(gap[index, kept].min() > least[index]):
            kept.append(index)
    return kept


def _neighbours(camera_to_box: torch.Tensor, focus: torch.Tensor) -> list[tuple[int, int]]:
    """Pairs of cameras that look within 55° of each other and are nearer to each other than to the focus: of each
    camera the nearest few."""
    centers, axes = camera_to_box[:, :3, 3], camera_to_box[:, :3, 2]
    gap = torch.cdist(centers, centers).fill_diagonal_(math.inf)
    gap[(axes @ axes.T < LEAST_COSINE) | (gap > (centers - focus).norm(dim=1))] = math.inf
    nearest = gap.topk(min(NEIGHBOURS, len(gap)), largest=False)
    found = zip(nearest.indices.tolist(), nearest.values.isfinite().tolist())
    return sorted({(min(i, j), max(i, j)) for i, (row, near) in enumerate(found) for j, ok in zip(row, near) if ok})


def _distance_to(start: torch.Tensor, end: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Distances (N,) of points (N, 3) from the line between two points."""
    along, offset = end - start, points - start
    share = (offset @ along / (along @ along).clamp(min=1e-12)).clamp(0, 1)
    return (offset - share[:, None] * along).norm(dim=1)
