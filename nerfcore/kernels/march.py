"""Two-stage ray sampling on the occupancy grid: a coarse walk that reads the grid, then samples from its PDF.

How rays walk is in `walk.py`, the torch backend in `march_torch.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp

from . import march_torch
from .device import backend_of
from .packing import Packing
from .runtime import array, init, launch
from .walk import (
    _DEFAULT,
    BEFORE_CUBE,
    MAX_BINS,
    STOP,
    MarchSettings,
    bin_length,
    bin_weight,
    cell_index,
    closed_length,
    cube_entry,
    grid_position,
    inside,
    ray_interval,
    reciprocal,
)

LEAST = 4  # samples on a ray whose number of samples follows that of its open bins


@wp.kernel(module="fieldwork_march")
def march_weight(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    jitter: wp.array(dtype=float),
    cells: wp.array(dtype=wp.vec2),
    reach: wp.array(dtype=wp.uint8),
    n: int,
    step: float,
    near: float,
    far: float,
    contracted: int,
    mode: int,
    beta: float,
    epsilon: float,
    empty: float,
    total: wp.array(dtype=float),
    first: wp.array(dtype=float),
    last: wp.array(dtype=float),
    bins: wp.array(dtype=int),
    offset: int,
):
    r = wp.tid() + offset
    o = origins[r]
    d = directions[r]
    inverse = reciprocal(d)
    lo, hi = ray_interval(o, inverse, near, far, contracted)
    if contracted == 1 and empty > 0.0:
        lo = wp.max(lo, wp.min(empty, BEFORE_CUBE * cube_entry(o, inverse)))
    t = lo + jitter[r] * step
    transmittance = float(1.0)
    weight = float(0.0)
    opened = int(0)
    t_first = float(-1.0)
    t_last = float(-1.0)
    for _ in range(MAX_BINS):
        if t >= hi:
            break
        p = o + d * t
        length = bin_length(p, step, contracted)
        u = grid_position(p, contracted)
        cell = cells[cell_index(u, n)]
        if cell[0] > 0.0:
            through = wp.exp(-cell[0] * length)
            weight += bin_weight(cell, transmittance, through, mode, beta, epsilon)
            if t_first < 0.0:
                t_first = t
            t_last = t
            opened += 1
            if mode == _DEFAULT:
                transmittance *= through
                if transmittance < STOP:
                    break
            t += length
        else:
            t += closed_length(u, d, inverse, n, step, length, contracted, reach)
    total[r] = weight
    first[r] = t_first
    last[r] = t_last
    bins[r] = opened


@wp.kernel(module="fieldwork_march")
def march_sample(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    jitter: wp.array(dtype=float),
    shift: wp.array(dtype=float),
    cells: wp.array(dtype=wp.vec2),
    reach: wp.array(dtype=wp.uint8),
    n: int,
    step: float,
    near: float,
    far: float,
    contracted: int,
    mode: int,
    beta: float,
    epsilon: float,
    total: wp.array(dtype=float),
    first: wp.array(dtype=float),
    start: wp.array(dtype=int),
    counts: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3),
    depth: wp.array(dtype=float),
    delta: wp.array(dtype=float),
    ray: wp.array(dtype=int),
    offset: int,
):
    r = wp.tid() + offset
    count = counts[r]
    if count == 0:
        return
    base = start[r]
    o = origins[r]
    d = directions[r]
    inverse = reciprocal(d)
    _, hi = ray_interval(o, inverse, near, far, contracted)
    t = first[r]
    transmittance = float(1.0)
    below = float(0.0)  # weight of the bins behind us
    share = total[r] / float(count)
    k = int(0)  # the sample being looked for
    target = shift[base] * share
    edge = share  # weight at which sample k's interval ends
    open_length = float(0.0)  # open length gathered for sample k's interval so far
    k_edge = int(0)
    t_end = t
    for _ in range(MAX_BINS):
        if t >= hi or k_edge >= count:
            break
        p = o + d * t
        length = bin_length(p, step, contracted)
        u = grid_position(p, contracted)
        cell = cells[cell_index(u, n)]
        if cell[0] > 0.0:
            through = wp.exp(-cell[0] * length)
            weight = bin_weight(cell, transmittance, through, mode, beta, epsilon)
            above = below + weight
            while k < count and target <= above:
                tk = t + ((target - below) / weight - 0.5) * length
                depth[base + k] = tk
                points[base + k] = inside(grid_position(o + d * tk, contracted))
                ray[base + k] = r
                k += 1
                if k < count:
                    target = (float(k) + shift[base + k]) * share
            used = float(0.0)  # part of this bin already given to intervals
            while k_edge < count and edge <= above:
                upto = (edge - below) / weight
                delta[base + k_edge] = open_length + (upto - used) * length
                open_length = float(0.0)
                used = upto
                k_edge += 1
                edge = float(k_edge + 1) * share
            open_length += (1.0 - used) * length
            t_end = t
            below = above
            if mode == _DEFAULT:
                transmittance *= through
                if transmittance < STOP:
                    break
            t += length
        else:
            t += closed_length(u, d, inverse, n, step, length, contracted, reach)
    # Rounding can leave the last interval or sample just short of the total.
    while k < count:
        depth[base + k] = t_end
        points[base + k] = inside(grid_position(o + d * t_end, contracted))
        ray[base + k] = r
        k += 1
    while k_edge < count:
        delta[base + k_edge] = open_length
        open_length = float(0.0)
        k_edge += 1


@dataclass(frozen=True)
class Samples:
    """Packed samples of a batch of rays; sample order along each ray is front to back.

    points (N, 3) grid coordinates; depth (N,) distance; delta (N,) length the sample stands for;
    packing: which samples belong to which ray; first, last (R,): distance of the first and last open bin, −1 where
    there is none.
    """

    points: torch.Tensor
    depth: torch.Tensor
    delta: torch.Tensor
    packing: Packing
    first: torch.Tensor
    last: torch.Tensor

    def __len__(self) -> int:
        return len(self.depth)


def _arguments(settings: MarchSettings) -> list:
    s = settings
    return [s.resolution, s.step, s.near, s.far, int(s.contracted), s.mode, s.beta, s.epsilon]


def coarse(
    origins: torch.Tensor,
    directions: torch.Tensor,
    cells: torch.Tensor,
    reach: torch.Tensor,
    settings: MarchSettings,
    jitter: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """The coarse walk of rays, arguments as for `sample`: weight of all open bins (R,), 0 where there is none,
    distances (R,) of the first and the last of them, −1 where there is none, and their number (R,) int32."""
    device, rays = origins.device, len(origins)
    jitter = torch.full((rays,), 0.5, device=device) if jitter is None else jitter
    if not backend_of(device).warp:
        return march_torch.coarse(origins, directions, cells, settings, jitter)
    init()
    total, first, last = (torch.empty(rays, device=device) for _ in range(3))
    bins = torch.empty(rays, dtype=torch.int32, device=device)
    inputs = [array(origins, wp.vec3), array(directions, wp.vec3), array(jitter), array(cells, wp.vec2), array(reach)]
    inputs += [*_arguments(settings), settings.empty, array(total), array(first), array(last), array(bins)]
    launch(march_weight, rays, inputs, device)
    return total, first, last, bins


def sample_counts(bins: torch.Tensor, most: int, per_bin: float) -> torch.Tensor:
    """How many samples (R,) int32 rays with so many open bins get: `per_bin` for each, `most` where that is 0."""
    if per_bin == 0:
        return torch.where(bins > 0, most, 0).to(torch.int32)
    wanted = torch.ceil(bins * per_bin).clamp(min(LEAST, most), most)
    return torch.where(bins > 0, wanted, 0.0).to(torch.int32)


def sample(
    origins: torch.Tensor,
    directions: torch.Tensor,
    cells: torch.Tensor,
    reach: torch.Tensor,
    settings: MarchSettings,
    count: int,
    jitter: torch.Tensor | None = None,
    shift: torch.Tensor | None = None,
    capacity: int | None = None,
) -> Samples:
    """Draw `count` samples on every ray that meets an open cell.

    Args:
        origins, directions: (R, 3) float32 normalised frame; directions of unit length.
        cells: (resolution³, 2) float32: density per normalised unit length (0 = closed) and interest in [0, 1].
        reach: ((resolution / 4)³,) uint8, see `closed_reach`.
        jitter: (R,) in [0, 1) shift of the walk in bins; 0.5 when None.
        shift: (R · count,) in [0, 1) place of each sample within its share of the PDF; 0.5 when None.
        capacity: on CUDA, the fixed number of rays that may get samples, so that no count is read back; rays
            beyond it get none, unused places have ray −1 and delta 0.
    """
    device, rays = origins.device, len(origins)
    jitter = torch.full((rays,), 0.5, device=device) if jitter is None else jitter
    total, first, last, bins = coarse(origins, directions, cells, reach, settings, jitter)
    counts = sample_counts(bins, count, settings.per_bin)
    end = torch.cumsum(counts, 0, dtype=torch.int32)
    start = end - counts
    if capacity is None:
        n = int(end[-1]) if rays else 0
        ray = torch.empty(n, dtype=torch.int32, device=device)
    else:
        n = capacity * count
        counts = torch.where(end <= n, counts, 0).to(torch.int32)
        ray = torch.full((n,), -1, dtype=torch.int32, device=device)
    shift = torch.full((n,), 0.5, device=device) if shift is None else shift[:n]
    fill = torch.empty if capacity is None else torch.zeros
    points, depth, delta = fill(n, 3, device=device), fill(n, device=device), fill(n, device=device)
    if not backend_of(device).warp:
        out = points, depth, delta, ray
        march_torch.draw(origins, directions, cells, settings, jitter, shift, start, counts, out)
        return Samples(points, depth, delta, Packing(start, counts, ray), first, last)
    launch(
        march_sample,
        rays,
        [array(origins, wp.vec3), array(directions, wp.vec3), array(jitter), array(shift), array(cells, wp.vec2)]
        + [array(reach), *_arguments(settings), array(total), array(first), array(start), array(counts)]
        + [array(points, wp.vec3), array(depth), array(delta), array(ray)],
        device,
    )
    return Samples(points, depth, delta, Packing(start, counts, ray), first, last)
