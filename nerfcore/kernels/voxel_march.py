"""Rays through a baked field: leap over empty blocks, step through the others, composite front to back.

A step stands for as much of the ray as it is long; outside the cube cells and steps grow alike, so that a step always
is the same share of a cell. Opacity and colour are interpolated as they are coded; each corner's classes have as much of the
opacity as the corner. How the colour changes with the direction is read once a ray, where most of its light comes from. The torch version is in `voxel_march_torch.py`, what the CPU runs in `voxel_host.py`.
"""

from __future__ import annotations

import torch
import warp as wp

from . import voxel_host, voxel_march_torch
from .device import backend_of, on_host
from .runtime import array, init, launch
from .traversal import (
    BEFORE_CUBE,
    EARLY_STOP,
    MAX_BINS,
    MarchParams,
    MarchSettings,
    bin_length,
    cube_entry,
    exit_distance,
    grid_position,
    inside,
    march_params,
    ray_interval,
    reciprocal,
)
from .voxel_arrays import VoxelArrays, voxel_arrays
from .voxel_field import CELLS, COARSE, SLOT_BITS, VERTICES, VIEWS, VoxelField, VoxelRays
from .voxel_lanes import groups

_CELLS, _VERTICES, _VIEWS = wp.constant(CELLS), wp.constant(VERTICES), wp.constant(VIEWS)
_BLOCK, _COARSE, _SLOT_BITS = wp.constant(VERTICES**3), wp.constant(COARSE), wp.constant(SLOT_BITS)


@wp.func
def channel(texel: int, number: int):
    """One of the four bytes of a texel as a number in [0, 255]."""
    return float((texel >> (8 * number)) & 255)


@wp.func
def texel_color(texel: int):
    return wp.vec3(channel(texel, 0), channel(texel, 1), channel(texel, 2))


@wp.func
def leap(u: wp.vec3, inverse: wp.vec3, p: wp.vec3, distance: int, blocks: int, contracted: int):
    """How far (normalised units) a ray may move from a block whose nearest occupied block is `distance` blocks away.

    Outside the cube, r = max|p|, a way of length s moves a ray by at most s/r in the grid, or s/3 if that is less; up to
    half of r further in it is at most 2 s/r (the slopes of the contraction in the infinity norm).
    """
    # The signs are those of `inverse`: along an axis in which the ray does not move it is large, not infinite.
    if contracted == 0:
        return 2.0 * exit_distance(u, inverse, inverse, float(blocks), float(distance - 1), 0.0)
    r = wp.max(wp.abs(p[0]), wp.max(wp.abs(p[1]), wp.abs(p[2])))
    if r <= 1.0:
        return 4.0 * exit_distance(u, inverse, inverse, float(blocks), float(distance - 1), 0.25)
    free = float(1.0)
    for a in range(3):
        block = wp.floor(u[a] * float(blocks))
        free = wp.min(free, u[a] - (block - float(distance - 1)) / float(blocks))
        free = wp.min(free, (block + float(distance)) / float(blocks) - u[a])
    return wp.max(free, 0.0) * wp.max(3.0, 0.5 * r)


@wp.func
def block_of(x: wp.vec3, blocks: int):
    """Number of the block at a position in blocks."""
    bx = wp.min(int(x[0]), blocks - 1)
    by = wp.min(int(x[1]), blocks - 1)
    bz = wp.min(int(x[2]), blocks - 1)
    return (bz * blocks + by) * blocks + bx


@wp.struct
class Cell:
    """Where a sample is: its block, its cell's first vertex, and the place in the cell in [0, 1]³."""

    slot: int
    first: int
    place: wp.vec3


@wp.func
def cell_of(x: wp.vec3, entry: int, blocks: int):
    """The cell at a position in blocks, in the block that the index gives as `entry`."""
    cell = Cell()
    local = wp.vec3(0.0, 0.0, 0.0)
    corner = wp.vec3i(0, 0, 0)
    for a in range(3):
        block = wp.min(int(x[a]), blocks - 1)
        local[a] = (x[a] - float(block)) * float(_CELLS)
        corner[a] = wp.min(int(local[a]), _CELLS - 1)
    cell.slot = (entry & ((1 << _SLOT_BITS) - 1)) - 1
    cell.first = cell.slot * _BLOCK + (corner[2] * _VERTICES + corner[1]) * _VERTICES + corner[0]
    cell.place = local - wp.vec3(float(corner[0]), float(corner[1]), float(corner[2]))
    return cell


@wp.func
def corner_vertex(cell: Cell, corner: int):
    return cell.first + ((corner >> 2) * _VERTICES + ((corner >> 1) & 1)) * _VERTICES + (corner & 1)


@wp.func
def corner_weight(cell: Cell, corner: int):
    f = cell.place
    x = wp.where((corner & 1) == 1, f[0], 1.0 - f[0])
    y = wp.where(((corner >> 1) & 1) == 1, f[1], 1.0 - f[1])
    return x * y * wp.where((corner >> 2) == 1, f[2], 1.0 - f[2])


@wp.func
def march_start(o: wp.vec3, inverse: wp.vec3, lo: float, m: MarchParams):
    """Distance of the first sample."""
    begin = lo
    if m.contracted == 1 and m.empty_distance > 0.0:
        begin = wp.max(lo, wp.min(m.empty_distance, BEFORE_CUBE * cube_entry(o, inverse)))
    return begin + 0.5 * m.step


@wp.func
def plain_color(field: VoxelArrays, cell: Cell):
    """Colour in [0, 1] of a sample without its change with the direction."""
    value = wp.vec3(0.0, 0.0, 0.0)
    for corner in range(8):
        value += corner_weight(cell, corner) * texel_color(field.vertices[2 * corner_vertex(cell, corner)])
    return value / 255.0


@wp.func
def color_change(field: VoxelArrays, x: wp.vec3, slot: int, d: wp.vec3):
    """Change of the colour along d at a position in blocks, in the block with a number."""
    place = wp.vec3(0.0, 0.0, 0.0)
    low = wp.vec3i(0, 0, 0)
    for a in range(3):
        place[a] = (x[a] - float(wp.min(int(x[a]), field.blocks - 1))) * float(_COARSE - 1)
        low[a] = wp.min(int(place[a]), _COARSE - 2)
        place[a] -= float(low[a])
    slope = wp.vec3(0.0, 0.0, 0.0)
    for corner in range(8):
        w = float(1.0)
        row = slot
        for k in range(3):
            a = 2 - k
            far = (corner >> a) & 1
            row = row * _COARSE + low[a] + far
            w *= wp.where(far == 1, place[a], 1.0 - place[a])
        for a in range(3):
            slope += (w * d[a]) * texel_color(field.changes[3 * row + a])
    slope -= wp.vec3(127.5, 127.5, 127.5) * (d[0] + d[1] + d[2])
    return slope * (field.harmonic_range / 127.5)


@wp.func
def octant_is_empty(entry: int, x: wp.vec3, blocks: int):
    """Whether nothing is in the octant of a block, whose entry of the index this is, at a position in blocks."""
    octant = int(0)
    for a in range(3):
        if x[a] - float(wp.min(int(x[a]), blocks - 1)) >= 0.5:
            octant += 1 << a
    return ((entry >> (_SLOT_BITS + octant)) & 1) == 0


@wp.func
def empty_way(entry: int, u: wp.vec3, x: wp.vec3, inverse: wp.vec3, p: wp.vec3, blocks: int, contracted: int):
    """How far a ray may move from a position over what the index says is empty; negative where something may be."""
    if entry <= 0:
        return leap(u, inverse, p, -entry, blocks, contracted)
    if octant_is_empty(entry, x, blocks):
        return leap(u, inverse, p, 1, 2 * blocks, contracted)
    return -1.0


@wp.func
def lit(color: wp.vec3, opacity: float, change: wp.vec3):
    """A ray's colour with its change along the direction; no sample is brighter than white or darker than black."""
    sum = color + opacity * change
    return wp.vec3(wp.clamp(sum[0], 0.0, opacity), wp.clamp(sum[1], 0.0, opacity), wp.clamp(sum[2], 0.0, opacity))


@wp.kernel(module="fieldwork_voxel_march")
def march_voxels(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    ends: wp.array(dtype=float),
    field: VoxelArrays,
    m: MarchParams,
    out: wp.array(dtype=float, ndim=2),
    probabilities: wp.array(dtype=float, ndim=2),
    offset: int,
):
    r = wp.tid() + offset
    o = origins[r]
    d = directions[r]
    inverse = reciprocal(d)
    lo, hi = ray_interval(o, inverse, m)
    hi = wp.min(hi, ends[r])
    t = march_start(o, inverse, lo, m)
    transmittance = float(1.0)
    color = wp.vec3(0.0, 0.0, 0.0)
    depth = float(0.0)
    most = float(0.0)
    surface = wp.vec3(0.0, 0.0, 0.0)
    slot = int(0)
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
                root += (
                    corner_weight(cell, corner) * channel(field.vertices[2 * corner_vertex(cell, corner)], 3) / 255.0
                )
            if root > 0.0:
                alpha = 1.0 - wp.pow(wp.max(1.0 - root * root, 0.0), field.exponent)
                if field.classes > 0:
                    full = alpha
                    alpha = float(0.0)
                    for corner in range(8):
                        vertex = 2 * corner_vertex(cell, corner)
                        part = full * corner_weight(cell, corner) * channel(field.vertices[vertex], 3) / (255.0 * root)
                        if part > 0.0:
                            top = int(channel(field.vertices[vertex + 1], 0))
                            share = channel(field.vertices[vertex + 1], 1) / 255.0
                            second = int(channel(field.vertices[vertex + 1], 2))
                            first = part * share * field.class_opacity[top]
                            rest = part * (1.0 - share) * field.class_opacity[second]
                            alpha += first + rest
                            probabilities[r, top] = probabilities[r, top] + transmittance * first
                            probabilities[r, second] = probabilities[r, second] + transmittance * rest
                weight = transmittance * alpha
                color += weight * plain_color(field, cell)
                if weight > most:
                    most = weight
                    surface = x
                    slot = cell.slot
                depth += weight * t
                transmittance *= 1.0 - alpha
            t += length
    if most > 0.0:
        color = lit(color, 1.0 - transmittance, color_change(field, surface, slot, d))
    out[r, 0] = color[0]
    out[r, 1] = color[1]
    out[r, 2] = color[2]
    out[r, 3] = 1.0 - transmittance
    out[r, 4] = depth


@wp.kernel(module="fieldwork_voxel_march")
def note_views(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    cameras: wp.array(dtype=int),
    index: wp.array(dtype=int),
    roots: wp.array(dtype=wp.uint8),
    blocks: int,
    m: MarchParams,
    by_vertex: int,
    views: wp.array(dtype=int, ndim=2),
    offset: int,
):
    r = wp.tid() + offset
    o = origins[r]
    d = directions[r]
    inverse = reciprocal(d)
    lo, hi = ray_interval(o, inverse, m)
    t = march_start(o, inverse, lo, m)
    transmittance = float(1.0)
    camera = cameras[r]
    for _ in range(MAX_BINS):
        if t >= hi or transmittance < EARLY_STOP:
            break
        p = o + d * t
        length = bin_length(p, m)
        u = inside(grid_position(p, m.contracted))
        x = u * float(blocks)
        entry = index[block_of(x, blocks)]
        away = empty_way(entry, u, x, inverse, p, blocks, m.contracted)
        if away >= 0.0:
            t += away + 0.5 * length
        else:
            cell = cell_of(x, entry, blocks)
            root = float(0.0)
            for corner in range(8):
                root += corner_weight(cell, corner) * float(roots[corner_vertex(cell, corner)]) / 255.0
            alpha = wp.min(root * root, 1.0)
            weight = transmittance * alpha
            if by_vertex == 0:
                wp.atomic_max(views, cell.slot, camera % _VIEWS, view_code(weight, camera))
            else:
                for corner in range(8):
                    code = view_code(weight * corner_weight(cell, corner), camera)
                    wp.atomic_max(views, corner_vertex(cell, corner), camera % _VIEWS, code)
            transmittance *= 1.0 - alpha
            t += length


@wp.func
def view_code(weight: float, camera: int):
    """A camera and how much of one of its rays a place has: the larger share wins."""
    share = int(weight * 32767.0)
    return wp.where(share > 0, share * 65536 + camera, 0)


def march(
    origins: torch.Tensor,
    directions: torch.Tensor,
    field: VoxelField,
    settings: MarchSettings,
    ends: torch.Tensor | None = None,
) -> VoxelRays:
    """Render rays (R, 3) of the normalised frame, unit directions; `settings` say how long a step is, where rays begin
    and end, and whether space is contracted; `ends` (R,): distances at which single rays end before that."""
    device, rays = origins.device, len(origins)
    ends = torch.full((rays,), settings.far, device=device) if ends is None else ends
    if not backend_of(device).warp:
        return voxel_march_torch.march(origins, directions, field, settings, ends)
    init()
    out = torch.empty(rays, 5, device=device)
    probabilities = torch.zeros(rays, field.classes, device=device)
    inputs = [array(origins, wp.vec3), array(directions, wp.vec3), array(ends), voxel_arrays(field, settings)]
    inputs += [march_params(settings), array(out), array(probabilities)]
    if on_host(device):
        launch(voxel_host.march_voxels, groups(rays), inputs, device)
    else:
        launch(march_voxels, rays, inputs, device)
    return VoxelRays(out[:, :3], out[:, 3], out[:, 4], probabilities if field.classes else None)


def add_views(
    views: torch.Tensor,
    origins: torch.Tensor,
    directions: torch.Tensor,
    cameras: torch.Tensor,
    index: torch.Tensor,
    roots: torch.Tensor,
    settings: MarchSettings,
) -> None:
    """Note which cameras see the blocks, or the vertices, of a field of which only the opacity is known.

    Args:
        views: (S, VIEWS) or (S · 9³, VIEWS) int32, changed in place: in column `camera % VIEWS` the camera whose rays
            spend most of their weight there; 65536 · 32767 · weight + camera, 0 where no ray does.
        origins, directions: (R, 3) rays of the normalised frame; cameras (R,) int32 below 65536.
        index: (blocks³,) int32 and roots (S · 9³,) uint8 as in `VoxelField`.
        settings: the step is as long as a cell.
    """
    device, rays = origins.device, len(origins)
    blocks = round(len(index) ** (1 / 3))
    by_vertex = len(views) == len(roots)
    if not backend_of(device).warp:
        return voxel_march_torch.add_views(views, origins, directions, cameras, index, roots, settings)
    init()
    inputs = [array(origins, wp.vec3), array(directions, wp.vec3), array(cameras), array(index), array(roots)]
    inputs += [blocks, march_params(settings), int(by_vertex), array(views)]
    if on_host(device):
        launch(voxel_host.note_views, groups(rays), inputs, device, serial=True)
    else:
        launch(note_views, rays, inputs, device, serial=True)
