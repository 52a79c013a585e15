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
    """One ray, as it stays: its samples share its weight evenly."""

    origin: wp.vec3
    direction: wp.vec3
    inverse: wp.vec3
    high: float  # distance at which the march ends
    share: float  # weight of an interval


ENDED = wp.constant(1 << 30)  # more than a ray has samples


@wp.struct
class Walk:
    """How far along a ray is, from bin to bin and from sample to sample."""

    t: float
    t_last: float  # distance of the last occupied bin
    transmittance: float
    below: float  # weight of the bins behind
    width: float  # of the present bin; 0 until it is read
    weight: float  # of the present bin
    bin_transmittance: float  # of the present bin alone
    used: float  # part of the present bin given to intervals already
    gathered: float  # occupied length of the next sample's interval so far
    sample: int  # number of the next sample; ENDED: there is nothing behind the last one


@wp.func
def ray_of(rays: MarchedRays, index: int, m: MarchParams):
    """A ray by its index."""
    ray = Ray()
    ray.origin = rays.origins[index]
    ray.direction = rays.directions[index]
    ray.inverse = reciprocal(ray.direction)
    _, high = ray_interval(ray.origin, ray.inverse, m)
    ray.high = high
    ray.share = rays.total_weight[index] / float(rays.counts[index])
    return ray


@wp.func
def started(rays: MarchedRays, index: int):
    """The walk before a ray's first sample."""
    walk = Walk()
    walk.t = rays.t_first[index]
    walk.t_last = walk.t
    walk.transmittance = 1.0
    return walk


@wp.func
def advanced(ray: Ray, walk: Walk, shift: float, grid: GridArrays, m: MarchParams):
    """The walk after the ray's next sample, with the sample's distance and length; `shift` in [0, 1): where in its
    interval's weight the sample lies."""
    target = (float(walk.sample) + shift) * ray.share
    edge = float(walk.sample + 1) * ray.share
    t = float(NOT_FOUND)
    length = float(0.0)
    complete = int(0)
    for _ in range(MAX_BINS):
        if complete == 1 or walk.t >= ray.high:
            break
        if walk.width == 0.0:
            p = ray.origin + ray.direction * walk.t
            width = bin_length(p, m)
            u = grid_position(p, m.contracted)
            cell = grid.cells[cell_index(u, m.n)]
            if cell[0] > 0.0:
                walk.width = width
                walk.bin_transmittance = wp.exp(-cell[0] * width)
                walk.weight = bin_weight(cell, walk.transmittance, walk.bin_transmittance, m)
                walk.t_last = walk.t
            else:
                walk.t += skip_length(u, ray.direction, ray.inverse, width, m, grid.skip_distance)
        if walk.width > 0.0:
            above = walk.below + walk.weight
            if t == NOT_FOUND and target <= above:
                t = walk.t + ((target - walk.below) / walk.weight - 0.5) * walk.width
            if edge <= above:
                fraction = (edge - walk.below) / walk.weight
                length = walk.gathered + (fraction - walk.used) * walk.width
                walk.gathered = 0.0
                walk.used = fraction
                complete = 1
            else:
                walk.gathered += (1.0 - walk.used) * walk.width
                walk.used = 0.0
                walk.below = above
                walk.t += walk.width
                walk.width = 0.0
                if m.mode == _DEFAULT:
                    walk.transmittance *= walk.bin_transmittance
                    if walk.transmittance < EARLY_STOP:
                        walk.t = ray.high
    if complete == 0:
        # Rounding left this interval just short of the total; nothing is behind it.
        length = walk.gathered
        walk.gathered = 0.0
        if t == NOT_FOUND:
            t = walk.t_last
    walk.sample = wp.where(complete == 1, walk.sample + 1, ENDED)
    return walk, t, length
