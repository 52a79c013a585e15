"""What the training photos tell of each cell before anything is learned: shown by photos, unknown, or closed by a rule.

A field of few photos would explain each of them by a curtain in front of its camera, so that rules close cells that
must be empty. They go by cameras and sparse points alone; each can be switched off (`sampling.close_…`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..config import SamplingConfig
from ..geometry.cameras import Camera
from .path import cells_before_path
from .visibility import cells_at, depth_ranges, in_front, view_counts

NEAR, BETWEEN, SINGLE = "near cameras", "between cameras", "seen by one camera"
# Sparse points that stand together are something: rules never close the cells around them. Single ones are mostly
# wrong matches, of which a point cloud of thousands has some in front of cameras.
CLUSTER = 5  # not tuned


@dataclass(frozen=True)
class KnownSpace:
    """Cells of a grid, (resolution³,) each, x fastest.

    views: float32, how many cameras see the cell, 0 where it must be empty; unknown: bool, no photo shows it and no
    rule closed it; closed: bool, by rule; empty_distance: how far from every camera nothing can be (normalised units).
    """

    resolution: int
    contracted: bool
    views: torch.Tensor
    unknown: torch.Tensor
    closed: dict[str, torch.Tensor]
    empty_distance: float


def known_space(
    cameras: list[Camera],
    camera_to_box: torch.Tensor,
    points: torch.Tensor,
    focus: torch.Tensor | None,
    resolution: int,
    contracted: bool,
    config: SamplingConfig,
) -> KnownSpace:
    """Which cells photos show, and which ones the rules close.

    Args:
        camera_to_box: (V, 4, 4). points: (N, 3) sparse points, normalised. focus: (3,) what cameras surround, or None.
    """
    ranges = depth_ranges(cameras, camera_to_box, points, focus)
    views, beyond = view_counts(cameras, camera_to_box, resolution, contracted, ranges[:, 1])
    nothing = torch.zeros_like(beyond)
    closed = {NEAR: nothing, SINGLE: nothing, BETWEEN: nothing}
    if config.close_near_cameras:
        closed[NEAR] = in_front(cameras, camera_to_box, resolution, contracted, ranges)
    if config.close_single_views:
        closed[SINGLE] = (views == 1) & ~beyond
    if config.close_between_cameras and focus is not None:
        closed[BETWEEN] = cells_before_path(cameras, camera_to_box, focus, points, resolution, contracted)
    kept = beside_points(points, resolution, contracted)
    closed = {rule: cells & ~kept for rule, cells in closed.items()}
    anywhere = torch.stack(list(closed.values())).any(0)
    unknown = (views == 0) & ~anywhere
    views = torch.where(anywhere, 0.0, views)
    empty_distance = float(ranges[:, 0].min()) if config.close_near_cameras else 0.0
    return KnownSpace(resolution, contracted, views, unknown, closed, empty_distance)


def beside_points(points: torch.Tensor, resolution: int, contracted: bool) -> torch.Tensor:
    """Which cells (resolution³,) bool hold, together with their 26 neighbours, at least `CLUSTER` of the points, or are
    next to one that does."""
    counts = torch.bincount(cells_at(points, resolution, contracted), minlength=resolution**3).float()
    grid = counts.view(1, 1, resolution, resolution, resolution)
    cluster = (torch.nn.functional.avg_pool3d(grid, 3, 1, 1) * 27 > CLUSTER - 0.5).float()
    return torch.nn.functional.max_pool3d(cluster, 3, 1, 1).view(-1) > 0
