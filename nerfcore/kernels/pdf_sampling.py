"""Samples of one ray drawn from the PDF of its occupied bins, front to back.

A ray with n samples is cut into n intervals of equal weight; each holds one sample, which stands for the occupied
length of its interval. `march.march_sample` and the fused kernel both draw by these functions; the torch backend is in
`march_torch.py`.
"""

from __future__ import annotations

import warp as wp

from .traversal import (
    _DEFAULT,
    EARLY_STOP,
    MAX_BINS,
    GridArrays,
    MarchParams,
    bin_length,
    bin_weight,
    cell_index,
    grid_position,
    ray_interval,
    reciprocal,
    skip_length,
)

NOT_FOUND = wp.constant(-1.0e30)  # distance of a sample that is still being looked for


@wp.struct
class MarchedRays:
    """Rays (R,) after the coarse march, see `march.coarse_march`; counts: samples that each gets."""

    origins: wp.array(dtype=wp.vec3)
    directions: wp.array(dtype=wp.vec3)
    total_weight: wp.array(dtype=float)
    t_first: wp.array(dtype=float)
    counts: wp.array(dtype=int)


@wp.struct
class Ray:
    """One ray on its way, from bin to bin and from sample to sample."""

    index: int
    origin: wp.vec3
    direction: wp.vec3
    inverse: wp.vec3
    high: float  # distance at which the march ends
    share: float  # weight of an interval
    t: float
    t_last: float  # distance of the last occupied bin
    transmittance: float
    below: float  # weight of the bins behind
    width: float  # of the present bin; 0 until it is read
    weight: float  # of the present bin
    bin_transmittance: float  # of the present bin alone
    used: float  # part of the present bin given to intervals already
    gathered: float  # occupied length of the next sample's interval so far
    sample: int
    count: int
    ended: int


@wp.func
def started(rays: MarchedRays, index: int, m: MarchParams):
    """A ray before its first sample."""
    ray = Ray()
    ray.index = index
    ray.origin = rays.origins[index]
    ray.direction = rays.directions[index]
    ray.inverse = reciprocal(ray.direction)
    _, high = ray_interval(ray.origin, ray.inverse, m)
    ray.high = high
    ray.count = rays.counts[index]
    ray.share = rays.total_weight[index] / float(ray.count)
    ray.t = rays.t_first[index]
    ray.t_last = ray.t
    ray.transmittance = 1.0
    return ray


@wp.func
def advanced(ray: Ray, shift: float, grid: GridArrays, m: MarchParams):
    """The ray after its next sample, with the sample's distance and length; `shift` in [0, 1): where in its interval's
    weight the sample lies."""
    target = (float(ray.sample) + shift) * ray.share
    edge = float(ray.sample + 1) * ray.share
    t = float(NOT_FOUND)
    length = float(0.0)
    complete = int(0)
    for _ in range(MAX_BINS):
        if complete == 1 or ray.t >= ray.high:
            break
        if ray.width == 0.0:
            p = ray.origin + ray.direction * ray.t
            width = bin_length(p, m)
            u = grid_position(p, m.contracted)
            cell = grid.cells[cell_index(u, m.n)]
            if cell[0] > 0.0:
                ray.width = width
                ray.bin_transmittance = wp.exp(-cell[0] * width)
                ray.weight = bin_weight(cell, ray.transmittance, ray.bin_transmittance, m)
                ray.t_last = ray.t
            else:
                ray.t += skip_length(u, ray.direction, ray.inverse, width, m, grid.skip_distance)
        if ray.width > 0.0:
            above = ray.below + ray.weight
            if t == NOT_FOUND and target <= above:
                t = ray.t + ((target - ray.below) / ray.weight - 0.5) * ray.width
            if edge <= above:
                fraction = (edge - ray.below) / ray.weight
                length = ray.gathered + (fraction - ray.used) * ray.width
                ray.gathered = 0.0
                ray.used = fraction
                complete = 1
            else:
                ray.gathered += (1.0 - ray.used) * ray.width
                ray.used = 0.0
                ray.below = above
                ray.t += ray.width
                ray.width = 0.0
                if m.mode == _DEFAULT:
                    ray.transmittance *= ray.bin_transmittance
                    if ray.transmittance < EARLY_STOP:
                        ray.t = ray.high
    if complete == 0:
        # Rounding left this interval just short of the total; nothing is behind it.
        length = ray.gathered
        ray.gathered = 0.0
        ray.ended = 1
        if t == NOT_FOUND:
            t = ray.t_last
    ray.sample += 1
    return ray, t, length
