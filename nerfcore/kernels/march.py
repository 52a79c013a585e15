"""Two-stage ray sampling on the occupancy grid: a coarse walk that reads the grid, then samples from its PDF.

Positions are in the *normalised* frame, whose unit cube [−1, 1]³ is the region of interest. `contracted` maps all of
space into the grid (Barron et al., "Mip-NeRF 360", 2022, eq. 10, with the infinity norm); otherwise the grid covers
just the cube. A ray is walked in bins of about half a grid cell; bins in closed cells are skipped.

Bin weights (`mode`):
  PDF_DEFAULT  T·α·(1 + β·interest) + ε        transmittance-weighted, ε keeps every open bin alive
  PDF_UNIFORM  1                               the same number of samples spread over the open bins
  PDF_LITERAL  σ·max softmax(s)                the original formulation: no transmittance
The torch twins are in `march_torch.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp

from .packing import Packing
from .runtime import array, init, launch

PDF_DEFAULT, PDF_UNIFORM, PDF_LITERAL = 0, 1, 2
_DEFAULT, _UNIFORM, _LITERAL = wp.constant(PDF_DEFAULT), wp.constant(PDF_UNIFORM), wp.constant(PDF_LITERAL)
MAX_BINS = wp.constant(4096)
MACRO = wp.constant(4)  # cells along a side of a block that can be skipped at once
BEFORE_CUBE = wp.constant(0.8)  # share of the way to the cube that may be taken to be empty
STOP = wp.constant(1.0e-4)  # transmittance below which the walk ends
FARTHEST = 8  # blocks that can be skipped at once, from the middle one on
LEAST = 4  # samples on a ray whose number of samples follows that of its open bins


@dataclass(frozen=True)
class MarchSettings:
    """How rays are walked. `step` is the bin length inside the cube; `near`, `far` clip the ray (normalised units).

    `empty`: where space is contracted, rays from outside of the cube start as far away as this, but before they reach
    the cube. `per_bin`: samples for each open bin of a ray, at most the number asked for and at least `LEAST`; all
    rays get the number asked for when it is 0.
    """

    resolution: int
    step: float
    near: float = 0.02
    far: float = 1000.0
    contracted: bool = False
    mode: int = PDF_DEFAULT
    beta: float = 1.0
    epsilon: float = 0.01
    empty: float = 0.0
    per_bin: float = 0.0


@wp.func
def grid_position(p: wp.vec3, contracted: int):
    """Normalised position → grid coordinates in [0, 1]³."""
    if contracted == 0:
        return p * 0.5 + wp.vec3(0.5, 0.5, 0.5)
    r = wp.max(wp.abs(p[0]), wp.max(wp.abs(p[1]), wp.abs(p[2])))
    q = p
    if r > 1.0:
        q = p * ((2.0 - 1.0 / r) / r)
    return q * 0.25 + wp.vec3(0.5, 0.5, 0.5)


@wp.func
def inside(u: wp.vec3):
    """Bins at the border reach out of the grid by half their length."""
    return wp.vec3(wp.clamp(u[0], 0.0, 1.0), wp.clamp(u[1], 0.0, 1.0), wp.clamp(u[2], 0.0, 1.0))


@wp.func
def cell_index(u: wp.vec3, n: int):
    ix = wp.clamp(int(u[0] * float(n)), 0, n - 1)
    iy = wp.clamp(int(u[1] * float(n)), 0, n - 1)
    iz = wp.clamp(int(u[2] * float(n)), 0, n - 1)
    return (iz * n + iy) * n + ix


@wp.func
def ray_interval(o: wp.vec3, inverse: wp.vec3, near: float, far: float, contracted: int):
    """Entry and exit distance of the walk."""
    lo = near
    hi = far
    if contracted == 0:
        for a in range(3):
            t0 = (-1.0 - o[a]) * inverse[a]
            t1 = (1.0 - o[a]) * inverse[a]
            lo = wp.max(lo, wp.min(t0, t1))
            hi = wp.min(hi, wp.max(t0, t1))
    return lo, hi


@wp.func
def cube_entry(o: wp.vec3, inverse: wp.vec3):
    """Distance at which a ray enters the cube [−1, 1]³; negative from inside."""
    entry = float(-1.0e9)
    for a in range(3):
        entry = wp.max(entry, wp.min((-1.0 - o[a]) * inverse[a], (1.0 - o[a]) * inverse[a]))
    return entry


@wp.func
def bin_length(p: wp.vec3, step: float, contracted: int):
    """Bins grow outside the cube, where the grid's cells do."""
    if contracted == 0:
        return step
    r = wp.max(wp.abs(p[0]), wp.max(wp.abs(p[1]), wp.abs(p[2])))
    if r <= 1.0:
        return step
    return step * r * wp.sqrt(r)


@wp.func
def way_out(u: float, d: float, inverse: float, low: float, high: float):
    """Way until a ray at u leaves the interval low … high of one axis."""
    return (wp.where(d > 0.0, high, low) - u) * inverse


@wp.func
def leave_distance(u: wp.vec3, d: wp.vec3, inverse: wp.vec3, n: float, reach: float, border: float):
    """Way, in grid coordinates, until a ray at grid position u leaves its cell of an n³ grid and the `reach` cells
    around it, or the part of the grid that is `border` away from its sides."""
    away = float(1.0e9)
    for a in range(3):
        cell = wp.floor(u[a] * n)
        low = wp.max((cell - reach) / n, border)
        high = wp.min((cell + 1.0 + reach) / n, 1.0 - border)
        away = wp.min(away, way_out(u[a], d[a], inverse[a], low, high))
    return wp.max(away, 0.0)


@wp.func
def closed_length(
    u: wp.vec3,
    d: wp.vec3,
    inverse: wp.vec3,
    n: int,
    step: float,
    length: float,
    contracted: int,
    reach: wp.array(dtype=wp.uint8),
):
    """How far to move from a closed cell: in whole steps until the ray leaves it, or the closed reach around it; one
    bin where space is contracted."""
    side = float(2.0)
    border = float(0.0)
    if contracted == 1:
        side = 4.0
        border = 0.25
        c = u - wp.vec3(0.5, 0.5, 0.5)
        if wp.max(wp.abs(c[0]), wp.max(wp.abs(c[1]), wp.abs(c[2]))) >= 0.25:
            return length
    leave = float(0.0)
    closed = int(reach[cell_index(u, n / MACRO)])
    if closed > 0:
        leave = leave_distance(u, d, inverse, float(n / MACRO), float(closed - 1), border)
    else:
        leave = leave_distance(u, d, inverse, float(n), 0.0, border)
    return wp.max(1.0, wp.floor(leave * side / step + 0.5)) * step


@wp.func
def reciprocal(d: wp.vec3):
    return wp.vec3(
        1.0 / wp.where(wp.abs(d[0]) < 1.0e-9, 1.0e-9, d[0]),
        1.0 / wp.where(wp.abs(d[1]) < 1.0e-9, 1.0e-9, d[1]),
        1.0 / wp.where(wp.abs(d[2]) < 1.0e-9, 1.0e-9, d[2]),
    )


@wp.func
def bin_weight(cell: wp.vec2, transmittance: float, through: float, mode: int, beta: float, epsilon: float):
    """Weight of one open bin; `cell` holds (density, interest), `through` is the bin's own transmittance."""
    if mode == _UNIFORM:
        return 1.0
    if mode == _LITERAL:
        return cell[0] * cell[1] + 1.0e-6
    return transmittance * (1.0 - through) * (1.0 + beta * cell[1]) + epsilon


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


def closed_reach(opened: torch.Tensor) -> torch.Tensor:
    """How many blocks of 4³ cells around one, itself included, are closed in all directions: ((n / 4)³,) uint8 from
    the open cells (n, n, n) bool of a grid; 0 for blocks with an open cell."""
    m = len(opened) // int(MACRO)
    near = opened.view(m, int(MACRO), m, int(MACRO), m, int(MACRO)).any(5).any(3).any(1).float()[None]
    closed = 1 - near
    for _ in range(FARTHEST - 1):
        near = torch.nn.functional.max_pool3d(near, 3, 1, 1)
        closed += 1 - near
    return closed.to(torch.uint8).reshape(-1)


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
    init()
    device, rays = origins.device, len(origins)
    jitter = torch.full((rays,), 0.5, device=device) if jitter is None else jitter
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
    launch(
        march_sample,
        rays,
        [array(origins, wp.vec3), array(directions, wp.vec3), array(jitter), array(shift), array(cells, wp.vec2)]
        + [array(reach), *_arguments(settings), array(total), array(first), array(start), array(counts)]
        + [array(points, wp.vec3), array(depth), array(delta), array(ray)],
        device,
    )
    return Samples(points, depth, delta, Packing(start, counts, ray), first, last)
