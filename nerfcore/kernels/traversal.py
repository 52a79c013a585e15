"""How rays traverse the occupancy grid, bin by bin: what the coarse march and `pdf_sampling.py` share.

Positions are in the *normalised* frame, whose unit cube [−1, 1]³ is the region of interest. `contracted` maps all of
space into the grid (Barron et al., "Mip-NeRF 360", 2022, eq. 10, with the infinity norm); otherwise the grid covers
just the cube. A ray is marched in bins of about a grid cell; bins in empty cells are skipped.

Bin weights (`mode`):
  PDF_DEFAULT  T·α·(1 + β·importance) + ε      transmittance-weighted, ε keeps every occupied bin alive
  PDF_UNIFORM  1                               the same number of samples spread over the occupied bins
  PDF_LITERAL  σ·max softmax(s)                the original formulation: no transmittance
The torch backend is in `march_torch.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
import warp as wp

from .runtime import array

PDF_DEFAULT, PDF_UNIFORM, PDF_LITERAL = 0, 1, 2
_DEFAULT, _UNIFORM, _LITERAL = wp.constant(PDF_DEFAULT), wp.constant(PDF_UNIFORM), wp.constant(PDF_LITERAL)
MAX_BINS = wp.constant(4096)
BLOCK = wp.constant(4)  # cells along a side of a block that can be skipped at once
BEFORE_CUBE = wp.constant(0.8)  # share of the way to the cube that may be taken to be empty
EARLY_STOP = wp.constant(1.0e-4)  # transmittance below which a ray ends; not tuned
MAX_SKIP = 8  # blocks that can be skipped at once, from the middle one on


@dataclass(frozen=True)
class MarchSettings:
    """How rays are marched. `step` is the bin length inside the cube; `near`, `far` clip the ray (normalised units).

    `empty_distance`: where space is contracted, rays from outside of the cube start as far away as this, but before they reach
    the cube. `per_bin`: samples for each occupied bin of a ray, at most the number asked for and at least `march.FEWEST_SAMPLES`; all
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
    empty_distance: float = 0.0
    per_bin: float = 0.0


@wp.struct
class GridArrays:
    """An occupancy grid, see `march.sample`."""

    cells: wp.array(dtype=wp.vec2)
    skip_distance: wp.array(dtype=wp.uint8)


def grid_arrays(cells: torch.Tensor, skip_distance: torch.Tensor) -> GridArrays:
    """The grid as kernels take it."""
    grid = GridArrays()
    grid.cells, grid.skip_distance = array(cells, wp.vec2), array(skip_distance)
    return grid


@wp.struct
class MarchParams:
    """`MarchSettings` as kernels take them; n: cells along a side of the grid."""

    n: int
    step: float
    near: float
    far: float
    contracted: int
    mode: int
    beta: float
    epsilon: float
    empty_distance: float


@lru_cache(64)
def march_params(settings: MarchSettings) -> MarchParams:
    """The settings as kernels take them; made once, and never changed."""
    m = MarchParams()
    m.n, m.step, m.near, m.far = settings.resolution, settings.step, settings.near, settings.far
    m.contracted, m.mode, m.beta, m.epsilon = int(settings.contracted), settings.mode, settings.beta, settings.epsilon
    m.empty_distance = settings.empty_distance
    return m


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
def ray_interval(o: wp.vec3, inverse: wp.vec3, m: MarchParams):
    """Entry and exit distance of the march."""
    lo = m.near
    hi = m.far
    if m.contracted == 0:
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
def bin_length(p: wp.vec3, m: MarchParams):
    """Bins grow outside the cube, where the grid's cells do."""
    if m.contracted == 0:
        return m.step
    r = wp.max(wp.abs(p[0]), wp.max(wp.abs(p[1]), wp.abs(p[2])))
    if r <= 1.0:
        return m.step
    return m.step * r * wp.sqrt(r)


@wp.func
def axis_exit(u: float, d: float, inverse: float, low: float, high: float):
    """Distance until a ray at u leaves the interval low … high of one axis."""
    return (wp.where(d > 0.0, high, low) - u) * inverse


@wp.func
def exit_distance(u: wp.vec3, d: wp.vec3, inverse: wp.vec3, n: float, radius: float, border: float):
    """Distance, in grid coordinates, until a ray at grid position u leaves its cell of an n³ grid and the `radius` cells
    around it, or the part of the grid that is `border` away from its sides."""
    away = float(1.0e9)
    for a in range(3):
        cell = wp.floor(u[a] * n)
        low = wp.max((cell - radius) / n, border)
        high = wp.min((cell + 1.0 + radius) / n, 1.0 - border)
        away = wp.min(away, axis_exit(u[a], d[a], inverse[a], low, high))
    return wp.max(away, 0.0)


@wp.func
def skip_length(
    u: wp.vec3,
    d: wp.vec3,
    inverse: wp.vec3,
    length: float,
    m: MarchParams,
    skip_distance: wp.array(dtype=wp.uint8),
):
    """How far to move from an empty cell: in whole steps until the ray leaves it, or the empty blocks around it; one
    bin where space is contracted."""
    side = float(2.0)
    border = float(0.0)
    if m.contracted == 1:
        side = 4.0
        border = 0.25
        c = u - wp.vec3(0.5, 0.5, 0.5)
        if wp.max(wp.abs(c[0]), wp.max(wp.abs(c[1]), wp.abs(c[2]))) >= 0.25:
            return length
    leave = float(0.0)
    skip = int(skip_distance[cell_index(u, m.n / BLOCK)])
    if skip > 0:
        leave = exit_distance(u, d, inverse, float(m.n / BLOCK), float(skip - 1), border)
    else:
        leave = exit_distance(u, d, inverse, float(m.n), 0.0, border)
    return wp.max(1.0, wp.floor(leave * side / m.step + 0.5)) * m.step


@wp.func
def reciprocal(d: wp.vec3):
    return wp.vec3(
        1.0 / wp.where(wp.abs(d[0]) < 1.0e-9, 1.0e-9, d[0]),
        1.0 / wp.where(wp.abs(d[1]) < 1.0e-9, 1.0e-9, d[1]),
        1.0 / wp.where(wp.abs(d[2]) < 1.0e-9, 1.0e-9, d[2]),
    )


@wp.func
def bin_weight(cell: wp.vec2, transmittance: float, bin_transmittance: float, m: MarchParams):
    """Weight of one occupied bin; `cell` holds (density, importance), `bin_transmittance` is the bin's own transmittance."""
    if m.mode == _UNIFORM:
        return 1.0
    if m.mode == _LITERAL:
        return cell[0] * cell[1] + 1.0e-6
    return transmittance * (1.0 - bin_transmittance) * (1.0 + m.beta * cell[1]) + m.epsilon


def skip_distances(occupied: torch.Tensor) -> torch.Tensor:
    """How many blocks of 4³ cells around one, itself included, are empty in all directions: ((n / 4)³,) uint8 from
    the occupied cells (n, n, n) bool of a grid; 0 for blocks with an occupied cell."""
    m = len(occupied) // int(BLOCK)
    near = occupied.view(m, int(BLOCK), m, int(BLOCK), m, int(BLOCK)).any(5).any(3).any(1).float()[None]
    skip = 1 - near
    for _ in range(MAX_SKIP - 1):
        near = torch.nn.functional.max_pool3d(near, 3, 1, 1)
        skip += 1 - near
    return skip.to(torch.uint8).reshape(-1)
