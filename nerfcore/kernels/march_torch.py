"""Torch backend of `march.py`: all bins of some rays at once, without skipping empty ones.

Skipping goes in whole bins and never past an occupied one, so that both backends meet the same occupied bins.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..geometry.contraction import grid_position
from .cells_torch import cell_index
from .traversal import BEFORE_CUBE, EARLY_STOP, MAX_BINS, PDF_DEFAULT, PDF_UNIFORM, MarchSettings

MOST_BINS = 1 << 21  # of the rays that are marched at once


@dataclass(frozen=True)
class _Bins:
    """The bins of R rays, front to back: middle, length, weight (0 where empty or behind the ray's end), and which
    count as occupied, each (R, M)."""

    middle: torch.Tensor
    length: torch.Tensor
    weight: torch.Tensor
    occupied: torch.Tensor


def _interval(
    origins: torch.Tensor, directions: torch.Tensor, ends: torch.Tensor, s: MarchSettings
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Where rays begin and end (R,), and where rays enter the cube [−1, 1]³, negative from inside."""
    inverse = 1 / torch.where(directions.abs() < 1e-9, 1e-9, directions)
    one, other = (-1 - origins) * inverse, (1 - origins) * inverse
    entry, leave = torch.minimum(one, other).amax(1), torch.maximum(one, other).amin(1)
    low, high = torch.full_like(entry, s.near), ends.clamp(max=s.far)
    if not s.contracted:
        return torch.maximum(low, entry), torch.minimum(high, leave), entry
    if s.empty_distance > 0:
        low = torch.maximum(low, (float(BEFORE_CUBE) * entry).clamp(max=s.empty_distance))
    return low, high, entry


def _bin_midpoints(
    origins: torch.Tensor, directions: torch.Tensor, ends: torch.Tensor, jitter: torch.Tensor, s: MarchSettings
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Middle and length of each bin of R rays, and whether the ray gets there: (R, M) each."""
    low, high, _ = _interval(origins, directions, ends, s)
    begin = low + jitter * s.step
    most = int(MAX_BINS)
    if not s.contracted:
        longest = float(((high - begin) / s.step).clamp(min=0).amax()) if len(begin) else 0.0
        number = torch.arange(min(most, int(longest) + 2), device=begin.device)
        middle = begin[:, None] + number * s.step
        return middle, torch.full_like(middle, s.step), middle < high[:, None]
    # Outside the cube a bin's length follows from where it is, so that bins come one after the other.
    t, columns, lengths = begin, [], []
    while len(columns) < most and bool((t < high).any()):
        radius = (origins + directions * t[:, None]).abs().amax(1)
        length = torch.where(radius <= 1, s.step, s.step * radius * radius.sqrt())
        columns.append(t)
        lengths.append(length)
        t = t + length
    if not columns:
        nothing = begin.new_zeros(len(begin), 0)
        return nothing, nothing, nothing.bool()
    middle = torch.stack(columns, 1)
    return middle, torch.stack(lengths, 1), middle < high[:, None]


def _bins(
    origins: torch.Tensor,
    directions: torch.Tensor,
    ends: torch.Tensor,
    cells: torch.Tensor,
    s: MarchSettings,
    jitter: torch.Tensor,
) -> _Bins:
    middle, length, there = _bin_midpoints(origins, directions, ends, jitter, s)
    points = origins[:, None] + directions[:, None] * middle[..., None]
    cell = cells[cell_index(grid_position(points, s.contracted).view(-1, 3), s.resolution)].view(*middle.shape, 2)
    occupied = there & (cell[..., 0] > 0)
    if s.mode == PDF_UNIFORM:
        weight = torch.ones_like(middle)
    elif s.mode == PDF_DEFAULT:
        depth = torch.where(occupied, cell[..., 0] * length, 0.0)
        transmittance = torch.exp(depth - torch.cumsum(depth, 1))
        occupied = occupied & (transmittance >= float(EARLY_STOP))
        weight = transmittance * (1 - torch.exp(-depth)) * (1 + s.beta * cell[..., 1]) + s.epsilon
    else:
        weight = cell[..., 0] * cell[..., 1] + 1e-6
    return _Bins(middle, length, torch.where(occupied, weight, 0.0), occupied)


def _parts(origins: torch.Tensor, s: MarchSettings) -> list[slice]:
    """Rays in numbers that are marched at once"""
    side = 4.0 if s.contracted else 3.5  # about how long a ray is
    rays = max(1, MOST_BINS // max(1, int(side / s.step) * (2 if s.contracted else 1)))
    return [slice(begin, begin + rays) for begin in range(0, len(origins), rays)]


@torch.no_grad()
def coarse_march(
    origins: torch.Tensor,
    directions: torch.Tensor,
    ends: torch.Tensor,
    cells: torch.Tensor,
    s: MarchSettings,
    jitter: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """As `march.coarse_march`."""
    rays, device = len(origins), origins.device
    total_weight, t_first, t_last = (
        torch.zeros(rays, device=device),
        *(torch.full((rays,), -1.0, device=device) for _ in range(2)),
    )
    bin_counts = torch.zeros(rays, dtype=torch.int32, device=device)
    for part in _parts(origins, s):
        bins = _bins(origins[part], directions[part], ends[part], cells, s, jitter[part])
        if bins.occupied.shape[1] == 0:
            continue
        some = bins.occupied.any(1)
        total_weight[part] = bins.weight.sum(1)
        bin_counts[part] = bins.occupied.sum(1).to(torch.int32)
        t_first[part] = torch.where(some, torch.where(bins.occupied, bins.middle, torch.inf).amin(1), -1.0)
        t_last[part] = torch.where(some, torch.where(bins.occupied, bins.middle, -1.0).amax(1), -1.0)
    return total_weight, t_first, t_last, bin_counts


@torch.no_grad()
def draw(
    origins: torch.Tensor,
    directions: torch.Tensor,
    ends: torch.Tensor,
    cells: torch.Tensor,
    s: MarchSettings,
    jitter: torch.Tensor,
    shift: torch.Tensor,
    starts: torch.Tensor,
    counts: torch.Tensor,
    out: tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor],
) -> None:
    """Write the samples of rays (`starts`, `counts` (R,)) into `out`: points (N, 3), t, deltas, ray_indices (N,)."""
    for part in _parts(origins, s):
        count = counts[part]
        some = (count > 0).nonzero()[:, 0]
        if len(some) == 0:
            continue
        ray = some + part.start
        o, d = origins[ray], directions[ray]
        bins = _bins(o, d, ends[ray], cells, s, jitter[ray])
        number = torch.arange(int(count.max()), device=o.device)
        used = number < count[some][:, None]
        index = (starts[ray].long()[:, None] + number)[used]
        shifts = torch.full(used.shape, 0.5, device=o.device).masked_scatter(used, shift[index])
        t, lengths = _invert(bins, count[some], number + shifts, number)
        row = torch.arange(len(some), device=o.device)[:, None].expand_as(used)[used]
        points, sample_t, deltas, ray_indices = out
        sample_t[index], deltas[index] = t[used], lengths[used]
        points[index] = grid_position(o[row] + d[row] * t[used][:, None], s.contracted).clamp(0, 1)
        ray_indices[index] = ray[row].to(ray_indices.dtype)


def _invert(
    bins: _Bins, count: torch.Tensor, quantile: torch.Tensor, number: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance and length (R, K) of samples at `quantile` (R, K) of `count` (R,) equal shares of the bins' weight;
    sample k's length is what share `number` (K,) covers of the occupied bins."""
    above = torch.cumsum(bins.weight, 1)
    length = torch.where(bins.occupied, bins.length, 0.0)
    passed = torch.cumsum(length, 1) - length  # occupied length in front of each bin
    share = above[:, -1:] / count[:, None]
    bin_number = torch.arange(above.shape[1], device=above.device)
    first = torch.where(bins.occupied, bin_number, above.shape[1]).amin(1, keepdim=True)
    last = torch.where(bins.occupied, bin_number, 0).amax(1, keepdim=True)

    def find(target: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The bins in which the weight reaches `target` (R, K), and how far into them that is, in [0, 1]."""
        index = torch.searchsorted(above, target.contiguous()).clamp(first, last)
        weight = bins.weight.gather(1, index)
        return index, ((target - above.gather(1, index)) / weight + 1).clamp(0, 1)

    index, into = find(quantile * share)
    t = bins.middle.gather(1, index) + (into - 0.5) * bins.length.gather(1, index)
    edges = torch.cat([number, number[-1:] + 1]) * share
    index, into = find(edges)
    cumulative = passed.gather(1, index) + into * length.gather(1, index)
    return t, cumulative.diff(dim=1)
