"""Two-stage ray sampling on the occupancy grid: a coarse march that reads the grid, then samples from its PDF.

How rays traverse the grid is in `traversal.py`, how samples are drawn in `pdf_sampling.py`, the torch backend in
`march_torch.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp

from . import march_host, march_torch
from .device import backend_of, on_host
from .march_host import LANES, RAYS, CoarseArrays, SampleArrays
from .packed_info import PackedInfo
from .pdf_sampling import MarchedRays, advanced, ray_of, started
from .runtime import array, init, launch
from .traversal import (
    _DEFAULT,
    BEFORE_CUBE,
    EARLY_STOP,
    MAX_BINS,
    GridArrays,
    MarchParams,
    MarchSettings,
    bin_length,
    bin_weight,
    cell_index,
    cube_entry,
    grid_arrays,
    grid_position,
    inside,
    march_params,
    ray_interval,
    reciprocal,
    skip_length,
)

FEWEST_SAMPLES = 4  # samples on a ray whose number of samples follows that of its occupied bins; not tuned


@wp.kernel(module="fieldwork_march")
def march_weight(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    ends: wp.array(dtype=float),
    jitter: wp.array(dtype=float),
    grid: GridArrays,
    m: MarchParams,
    out: CoarseArrays,
    offset: int,
):
    r = wp.tid() + offset
    o = origins[r]
    d = directions[r]
    inverse = reciprocal(d)
    lo, hi = ray_interval(o, inverse, m)
    hi = wp.min(hi, ends[r])
    if m.contracted == 1 and m.empty_distance > 0.0:
        lo = wp.max(lo, wp.min(m.empty_distance, BEFORE_CUBE * cube_entry(o, inverse)))
    t = lo + jitter[r] * m.step
    transmittance = float(1.0)
    weight = float(0.0)
    occupied = int(0)
    front = float(-1.0)
    back = float(-1.0)
    for _ in range(MAX_BINS):
        if t >= hi:
            break
        p = o + d * t
        length = bin_length(p, m)
        u = grid_position(p, m.contracted)
        cell = grid.cells[cell_index(u, m.n)]
        if cell[0] > 0.0:
            bin_transmittance = wp.exp(-cell[0] * length)
            weight += bin_weight(cell, transmittance, bin_transmittance, m)
            if front < 0.0:
                front = t
            back = t
            occupied += 1
            if m.mode == _DEFAULT:
                transmittance *= bin_transmittance
                if transmittance < EARLY_STOP:
                    break
            t += length
        else:
            t += skip_length(u, d, inverse, length, m, grid.skip_distance)
    out.total_weight[r] = weight
    out.t_first[r] = front
    out.t_last[r] = back
    out.bin_counts[r] = occupied


@wp.kernel(module="fieldwork_march")
def march_sample(
    rays: MarchedRays,
    ends: wp.array(dtype=float),
    shift: wp.array(dtype=float),
    grid: GridArrays,
    m: MarchParams,
    out: SampleArrays,
    offset: int,
):
    r = wp.tid() + offset
    count = rays.counts[r]
    if count == 0:
        return
    ray = ray_of(rays, r, m)
    ray.high = wp.min(ray.high, ends[r])
    walk = started(rays, r)
    begin = out.starts[r]
    for i in range(begin, begin + count):
        walk, t, length = advanced(ray, walk, shift[i], grid, m)
        out.points[i] = inside(grid_position(ray.origin + ray.direction * t, m.contracted))
        out.t[i] = t
        out.deltas[i] = length
        out.ray_indices[i] = r


@dataclass(frozen=True)
class Samples:
    """Packed samples of a batch of rays; sample order along each ray is front to back.

    points (N, 3) grid coordinates; t (N,) distance along the ray; deltas (N,) length the sample stands for;
    packed_info: which samples belong to which ray; t_first, t_last (R,): distance of the first and last occupied bin,
    −1 where there is none.
    """

    points: torch.Tensor
    t: torch.Tensor
    deltas: torch.Tensor
    packed_info: PackedInfo
    t_first: torch.Tensor
    t_last: torch.Tensor

    def __len__(self) -> int:
        return len(self.t)


def coarse_march(
    origins: torch.Tensor,
    directions: torch.Tensor,
    cells: torch.Tensor,
    skip_distance: torch.Tensor,
    settings: MarchSettings,
    jitter: torch.Tensor | None = None,
    ends: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """The coarse march of rays, arguments as for `sample`: weight of all occupied bins (R,), 0 where there is none,
    distances (R,) of the first and the last of them, −1 where there is none, and their number (R,) int32."""
    device, rays = origins.device, len(origins)
    jitter = torch.full((rays,), 0.5, device=device) if jitter is None else jitter
    ends = torch.full((rays,), settings.far, device=device) if ends is None else ends
    if not backend_of(device).warp:
        return march_torch.coarse_march(origins, directions, ends, cells, settings, jitter)
    init()
    total_weight, t_first, t_last = (torch.empty(rays, device=device) for _ in range(3))
    bin_counts = torch.empty(rays, dtype=torch.int32, device=device)
    out = CoarseArrays()
    out.total_weight, out.bin_counts = array(total_weight), array(bin_counts)
    out.t_first, out.t_last = array(t_first), array(t_last)
    rays_in = [array(origins, wp.vec3), array(directions, wp.vec3), array(ends), array(jitter)]
    inputs = [*rays_in, grid_arrays(cells, skip_distance)]
    if on_host(device):
        launch(march_host.march_weight, -(-rays // LANES), [*inputs, march_params(settings), out, rays], device)
    else:
        launch(march_weight, rays, [*inputs, march_params(settings), out], device)
    return total_weight, t_first, t_last, bin_counts


def sample_counts(bin_counts: torch.Tensor, most: int, per_bin: float) -> torch.Tensor:
    """How many samples (R,) int32 rays with so many occupied bins get: `per_bin` for each, `most` where that is 0."""
    if per_bin == 0:
        return torch.where(bin_counts > 0, most, 0).to(torch.int32)
    wanted = torch.ceil(bin_counts * per_bin).clamp(min(FEWEST_SAMPLES, most), most)
    return torch.where(bin_counts > 0, wanted, 0.0).to(torch.int32)


def marched_rays(
    origins: torch.Tensor,
    directions: torch.Tensor,
    total_weight: torch.Tensor,
    t_first: torch.Tensor,
    counts: torch.Tensor,
) -> MarchedRays:
    """Rays after the coarse march as kernels take them."""
    rays = MarchedRays()
    rays.origins, rays.directions = array(origins, wp.vec3), array(directions, wp.vec3)
    rays.total_weight, rays.t_first, rays.counts = array(total_weight), array(t_first), array(counts)
    return rays


def sample(
    origins: torch.Tensor,
    directions: torch.Tensor,
    cells: torch.Tensor,
    skip_distance: torch.Tensor,
    settings: MarchSettings,
    count: int,
    jitter: torch.Tensor | None = None,
    shift: torch.Tensor | None = None,
    capacity: int | None = None,
    ends: torch.Tensor | None = None,
) -> Samples:
    """Draw `count` samples on every ray that meets an occupied cell.

    Args:
        origins, directions: (R, 3) float32 normalised frame; directions of unit length.
        cells: (resolution³, 2) float32: density per normalised unit length (0 = empty) and importance in [0, 1].
        skip_distance: ((resolution / 4)³,) uint8, see `skip_distances`.
        jitter: (R,) in [0, 1) shift of the bins along the ray, in bins; 0.5 when None.
        shift: (R · count,) in [0, 1) position of each sample within its share of the PDF; 0.5 when None.
        capacity: the fixed number of rays that may get samples, so that no count is read back from the device; rays
            beyond it are left out, unused entries have ray index −1 and delta 0.
        ends: (R,) distances at which single rays end before the settings' far end.
    """
    device, rays = origins.device, len(origins)
    jitter = torch.full((rays,), 0.5, device=device) if jitter is None else jitter
    ends = torch.full((rays,), settings.far, device=device) if ends is None else ends
    total_weight, t_first, t_last, bin_counts = coarse_march(
        origins, directions, cells, skip_distance, settings, jitter, ends
    )
    counts = sample_counts(bin_counts, count, settings.per_bin)
    end = torch.cumsum(counts, 0, dtype=torch.int32)
    starts, left_out = end - counts, None
    if capacity is None:
        n = int(end[-1]) if rays else 0
        ray_indices = torch.empty(n, dtype=torch.int32, device=device)
    else:
        n, wanted = capacity * count, counts
        counts = torch.where(end <= n, counts, 0).to(torch.int32)
        starts = torch.where(counts > 0, starts, 0)
        left_out = (wanted > 0) & (counts == 0)
        ray_indices = torch.full((n,), -1, dtype=torch.int32, device=device)
    shift = torch.full((n,), 0.5, device=device) if shift is None else shift[:n]
    fill = torch.empty if capacity is None else torch.zeros
    points, t, deltas = fill(n, 3, device=device), fill(n, device=device), fill(n, device=device)
    packed_info = PackedInfo(starts, counts, ray_indices, left_out)
    if not backend_of(device).warp:
        out = points, t, deltas, ray_indices
        march_torch.draw(origins, directions, ends, cells, settings, jitter, shift, starts, counts, out)
        return Samples(points, t, deltas, packed_info, t_first, t_last)
    out = SampleArrays()
    out.starts, out.ray_indices = array(starts), array(ray_indices)
    out.points, out.t, out.deltas = array(points, wp.vec3), array(t), array(deltas)
    marched = marched_rays(origins, directions, total_weight, t_first, counts)
    inputs = [marched, array(ends), array(shift), grid_arrays(cells, skip_distance), march_params(settings), out]
    if on_host(device):
        launch(march_host.march_sample, -(-rays // RAYS), inputs, device)
    else:
        launch(march_sample, rays, inputs, device)
    return Samples(points, t, deltas, packed_info, t_first, t_last)
