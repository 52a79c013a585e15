"""The three states of space (unknown, empty, occupied), and how much of a ray lies in what no photo shows.

Unknown is not empty: a field holds nothing there because nothing was looked at. Points are in grid coordinates, cells
x fastest, as everywhere in `kernels`.
"""

from __future__ import annotations

import torch

from ..geometry.contraction import grid_position
from ..kernels.cells_torch import cell_index

UNKNOWN, EMPTY, OCCUPIED = 0, 1, 2
# Not tuned:
STEPS = 96  # a ray is read at: half of them in the cube's neighbourhood, half beyond; a cell of 128³ is 1.3 steps long
CUBE_LENGTH = 4.0  # normalised units: longer than the cube's diagonal
FARTHEST = 1000.0  # where rays end, as in `MarchSettings.far`
RAYS = 1 << 15  # at once, for the sake of memory


def cell_states(unknown: torch.Tensor, occupied: torch.Tensor) -> torch.Tensor:
    """States (n³,) uint8 of cells from which are unknown and which are occupied (n³,) bool; a cell that is both counts
    as unknown."""
    states = torch.full(unknown.shape, EMPTY, dtype=torch.uint8, device=unknown.device)
    states[occupied] = OCCUPIED
    states[unknown] = UNKNOWN
    return states


def state_at(states: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """State (N,) uint8 of points (N, 3) in grid coordinates; points outside of [0, 1]³ are unknown."""
    resolution = round(len(states) ** (1 / 3))
    inside = ((points >= 0) & (points <= 1)).all(1)
    found = states[cell_index(points.clamp(0, 1), resolution)]
    return torch.where(inside, found, UNKNOWN)


def unknown_share(
    states: torch.Tensor,
    contracted: bool,
    origins: torch.Tensor,
    directions: torch.Tensor,
    distance: torch.Tensor,
) -> torch.Tensor:
    """Which share (R,) in [0, 1] of rays' way through the grid lies in unknown cells: up to `distance` (R,), where a
    ray meets something, or for NaN all the way. Lengths are those in grid coordinates, so that what is far away does
    not count for more than it fills of the grid; a ray that misses the grid is unknown as a whole.

    Args:
        origins, directions: (R, 3) normalised frame, directions of unit length.
    """
    if len(origins) > RAYS:
        parts = zip(origins.split(RAYS), directions.split(RAYS), distance.split(RAYS))
        return torch.cat([unknown_share(states, contracted, *part) for part in parts])
    device, half = origins.device, STEPS // 2
    first = origins.norm(dim=1, keepdim=True).clamp(min=2.0) - 2.0  # the cube's corners are √3 from its centre
    t = first + torch.linspace(0, CUBE_LENGTH, half + 1, device=device)
    if contracted:
        before = torch.linspace(0, 1, half // 2 + 1, device=device)[:-1] * first
        start = t[:, -1:]
        beyond = 1 / torch.lerp(
            1 / start, torch.full_like(start, 1 / FARTHEST), torch.linspace(0, 1, half, device=device)
        )
        t = torch.cat([before, t, beyond[:, 1:]], 1)
    end = torch.where(distance.isnan(), torch.inf, distance)[:, None]
    t = torch.minimum(t, end)
    middle = (t[:, 1:] + t[:, :-1]) / 2
    corners, points = (
        grid_position(origins[:, None] + directions[:, None] * x[..., None], contracted) for x in (t, middle)
    )
    length = corners.diff(dim=1).norm(dim=2)
    inside = ((points >= 0) & (points <= 1)).all(2)
    length = torch.where(inside, length, 0.0)
    unknown = state_at(states, points.reshape(-1, 3)).view(length.shape) == UNKNOWN
    total = length.sum(1)
    return torch.where(total > 1e-9, (length * unknown).sum(1) / total.clamp(min=1e-9), 1.0)
