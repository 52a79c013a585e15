"""How a baked field must change to look as rays say: what each of its vertices has to do with the error of each ray.

A ray is marched twice: for its colour, and then to hand its error to the vertices it met. The torch version is in
`voxel_march_torch.py`, what the CPU runs in `voxel_host.py`.
"""

from __future__ import annotations

from functools import partial

import torch
import warp as wp

from . import voxel_host, voxel_march_torch
from .device import backend_of, on_host
from .runtime import array, init, launch, run_parallel, worker_count
from .traversal import (
    EARLY_STOP,
    MAX_BINS,
    MarchParams,
    MarchSettings,
    bin_length,
    grid_position,
    inside,
    march_params,
    ray_interval,
    reciprocal,
)
from .voxel_arrays import VoxelArrays, voxel_arrays
from .voxel_field import VoxelField
from .voxel_lanes import groups
from .voxel_march import (
    block_of,
    cell_of,
    channel,
    color_change,
    corner_vertex,
    corner_weight,
    empty_way,
    lit,
    march_start,
    plain_color,
)

_LEAST_WEIGHT = wp.constant(voxel_march_torch.LEAST_WEIGHT)


@wp.kernel(module="fieldwork_voxel_fit")
def add_errors_kernel(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    wanted: wp.array(dtype=wp.vec3),
    behind: wp.array(dtype=wp.vec3),
    field: VoxelArrays,
    m: MarchParams,
    sums: wp.array(dtype=float, ndim=2),
    errors: wp.array(dtype=float),
    offset: int,
):
    r = wp.tid() + offset
    o = origins[r]
    d = directions[r]
    inverse = reciprocal(d)
    lo, hi = ray_interval(o, inverse, m)
    total = wp.vec3(0.0, 0.0, 0.0)
    error = wp.vec3(0.0, 0.0, 0.0)
    zero = wp.vec3(0.0, 0.0, 0.0)
    change = wp.vec3(0.0, 0.0, 0.0)
    for turn in range(2):
        t = march_start(o, inverse, lo, m)
        transmittance = float(1.0)
        color = wp.vec3(0.0, 0.0, 0.0)
        most = float(0.0)
        for _ in range(MAX_BINS):
            if t >= hi or transmittance < EARLY_STOP:
                break
            p = o + d * t
            length = bin_length(p, m)
            u = inside(grid_position(p, m.contracted))
            x = u * float(field.blocks)
            entry = field.index[block_of(x, field.blocks)]
            away = empty_way(entry, u, x, inverse, p, field.blocks, m.contracted)
            if away >= 0.0:
                t += away + 0.5 * length
            else:
                cell = cell_of(x, entry, field.blocks)
                root = float(0.0)
                for corner in range(8):
                    vertex = corner_vertex(cell, corner)
                    root += corner_weight(cell, corner) * channel(field.vertices[2 * vertex], 3) / 255.0
                if root > 0.0:
                    alpha = wp.min(root * root, 1.0)
                    weight = transmittance * alpha
                    plain = plain_color(field, cell)
                    color += weight * plain
                    if turn == 0 and weight > most:
                        most = weight
                        change = color_change(field, x, cell.slot, d)
                    if turn == 1 and transmittance * root > _LEAST_WEIGHT:
                        # What lies behind the sample, were it alone to be seen.
                        seen = lit(plain, 1.0, change)
                        before = color + (1.0 - transmittance * (1.0 - alpha)) * change
                        rest = lit((total - before) / wp.max(transmittance * (1.0 - alpha), 1.0e-4), 1.0, zero)
                        effect = (seen - rest) * (transmittance * 2.0 * root)
                        slope = wp.dot(effect, error)
                        square = wp.dot(effect, effect)
                        for corner in range(8):
                            vertex = corner_vertex(cell, corner)
                            share = corner_weight(cell, corner)
                            w = share * weight
                            wp.atomic_add(sums, vertex, 0, w * error[0])
                            wp.atomic_add(sums, vertex, 1, w * error[1])
                            wp.atomic_add(sums, vertex, 2, w * error[2])
                            wp.atomic_add(sums, vertex, 3, w)
                            wp.atomic_add(sums, vertex, 4, share * slope)
                            wp.atomic_add(sums, vertex, 5, share * square)
                    transmittance *= 1.0 - alpha
                t += length
        if turn == 0:
            total = lit(color, 1.0 - transmittance, change) + behind[r] * transmittance
            error = wanted[r] - total
            errors[r] = wp.dot(error, error) / 3.0


def add_errors(
    sums: torch.Tensor,
    origins: torch.Tensor,
    directions: torch.Tensor,
    wanted: torch.Tensor,
    behind: torch.Tensor,
    field: VoxelField,
    settings: MarchSettings,
) -> torch.Tensor:
    """Add what rays (R, 3) say about the vertices of a baked field, all of whose classes are opaque; returns the mean
    squared error (R,) of each ray's colour.

    Args:
        sums: (S · 9³, 6) float32, changed in place: for each vertex the errors of colour (3) by its weights, the weights,
            the errors by how much its root changes them, and the squares of that.
        wanted, behind: (R, 3) the colour that a ray shall have, and what is behind the field, both sRGB.
        settings: the step is as long as a cell.
    """
    device, rays = origins.device, [origins, directions, wanted, behind]
    if not backend_of(device).warp:
        return voxel_march_torch.add_errors(sums, *rays, field, settings)
    init()
    errors = torch.empty(len(origins), device=device)

    def add(part: slice, own: torch.Tensor) -> torch.Tensor:
        inputs = [array(value[part], wp.vec3) for value in rays]
        inputs += [voxel_arrays(field, settings), march_params(settings), array(own), array(errors[part])]
        if on_host(device):
            launch(voxel_host.add_errors, groups(len(errors[part])), inputs, device, serial=True)
        else:
            launch(add_errors_kernel, len(errors[part]), inputs, device, serial=True)
        return own

    if device.type == "cuda":
        add(slice(None), sums)
        return errors
    # Threads of the CPU have no atomic additions: each has sums of its own.
    size = max(1, -(-len(errors) // worker_count()))
    parts = [slice(begin, begin + size) for begin in range(0, len(errors), size)]
    for own in run_parallel([partial(add, part, torch.zeros_like(sums)) for part in parts], device):
        sums += own
    return errors
