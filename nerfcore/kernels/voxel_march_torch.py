"""Torch backend of `voxel_march.py`: all rays take one step after the other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch

from ..geometry.contraction import grid_position
from .traversal import BEFORE_CUBE, EARLY_STOP, MAX_BINS, MarchSettings
from .voxel_field import (
    AXES,
    COARSE,
    SLOT_BITS,
    TEXELS,
    VERTICES,
    VIEWS,
    VoxelField,
    VoxelRays,
    cell_length,
)

LEAST_WEIGHT = 1e-3  # of a sample that is asked to change
SHADER_STOP = 0.01  # transmittance at which the shader stops
_CORNERS = [(corner & 1, corner >> 1 & 1, corner >> 2) for corner in range(8)]


@dataclass(frozen=True)
class _Step:
    """Where N of the rays take a sample: rays (N,) their numbers, t (N,), corners (N, 8) the vertices around it and
    shares (N, 8) their trilinear weights; coarse and coarse_shares (N, 8) the same of every second vertex."""

    rays: torch.Tensor
    t: torch.Tensor
    corners: torch.Tensor
    shares: torch.Tensor
    coarse: torch.Tensor
    coarse_shares: torch.Tensor


def _bounds(origins: torch.Tensor, inverse: torch.Tensor, s: MarchSettings) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance of the first sample and of the end (R,)."""
    one, other = (-1 - origins) * inverse, (1 - origins) * inverse
    entry, leave = torch.minimum(one, other).amax(1), torch.maximum(one, other).amin(1)
    low, high = torch.full_like(entry, s.near), torch.full_like(entry, s.far)
    if not s.contracted:
        low, high = torch.maximum(low, entry), torch.minimum(high, leave)
    elif s.empty_distance > 0:
        low = torch.maximum(low, (float(BEFORE_CUBE) * entry).clamp(max=s.empty_distance))
    return low + 0.5 * s.step, high


def _leap(
    u: torch.Tensor, inverse: torch.Tensor, p: torch.Tensor, distance: torch.Tensor, n: int, wide: bool
) -> torch.Tensor:
    """As `voxel_march.leap` for N rays; wide: space is contracted."""
    block, reach = (u * n).floor(), distance[:, None].float()
    low, high = (block - reach + 1) / n, (block + reach) / n
    border = 0.25 if wide else 0.0
    ends = torch.where(inverse > 0, high.clamp(max=1 - border), low.clamp(min=border))
    straight = ((ends - u) * inverse).amin(1).clamp(min=0)
    if not wide:
        return 2 * straight
    r = p.abs().amax(1)
    free = torch.minimum(u - low, high - u).amin(1).clamp(0, 1)
    return torch.where(r <= 1, 4 * straight, free * (0.5 * r).clamp(min=3))


def _steps(
    origins: torch.Tensor,
    directions: torch.Tensor,
    index: torch.Tensor,
    n: int,
    s: MarchSettings,
    transmittance: torch.Tensor,
    ends: torch.Tensor | None = None,
    looks: torch.Tensor | None = None,
) -> Iterator[_Step]:
    """The samples of rays (R, 3), one a ray at a time, while the caller lowers their transmittance (R,) in place; `looks`
    (R,): how often each ray came into another block, counted in place."""
    inverse = 1 / torch.where(directions.abs() < 1e-9, 1e-9, directions)
    t, high = _bounds(origins, inverse, s)
    high = high if ends is None else torch.minimum(high, ends)
    before = torch.full_like(t, -1, dtype=torch.long)
    for _ in range(int(MAX_BINS)):
        rays = ((t < high) & (transmittance >= float(EARLY_STOP))).nonzero()[:, 0]
        if len(rays) == 0:
            return
        now, d = t[rays], directions[rays]
        p = origins[rays] + d * now[:, None]
        r = p.abs().amax(1)
        length = torch.where(r > 1, s.step * r * r.sqrt(), s.step) if s.contracted else torch.full_like(now, s.step)
        u = grid_position(p, s.contracted).clamp(0, 1)
        block = (u * n).long().clamp(max=n - 1)
        place = (block[:, 2] * n + block[:, 1]) * n + block[:, 0]
        if looks is not None:
            looks[rays] += (place != before[rays]).float()
            before[rays] = place
        entry = index[place].long()
        empty = entry <= 0
        half = ((u * n - block) >= 0.5).long()
        octant = half[:, 0] + 2 * half[:, 1] + 4 * half[:, 2]
        hollow = ~empty & ((entry >> (SLOT_BITS + octant) & 1) == 0)
        away = torch.where(
            empty,
            _leap(u, inverse[rays], p, -entry, n, s.contracted),
            _leap(u, inverse[rays], p, torch.ones_like(entry), 2 * n, s.contracted),
        )
        empty |= hollow
        t[rays] += torch.where(empty, away + 0.5 * length, length)
        used = (~empty).nonzero()[:, 0]
        if len(used) == 0:
            continue
        local, slot = u[used] * n - block[used], (entry[used] & ((1 << SLOT_BITS) - 1)) - 1
        yield _Step(rays[used], now[used], *_around(local, slot, VERTICES), *_around(local, slot, COARSE))


def _around(place: torch.Tensor, slot: torch.Tensor, side: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The eight of side³ vertices of blocks (N,) around places (N, 3) in [0, 1]³ of them, and their shares, (N, 8)."""
    local = place * (side - 1)
    corner = local.long().clamp(max=side - 2)
    f = local - corner
    first = slot * side**3 + (corner[:, 2] * side + corner[:, 1]) * side + corner[:, 0]
    corners = torch.stack([first + (z * side + y) * side + x for x, y, z in _CORNERS], 1)
    weights = [torch.where(torch.tensor(c, device=f.device) > 0, f, 1 - f).prod(1) for c in _CORNERS]
    return corners, torch.stack(weights, 1)


def unpacked(texels: torch.Tensor) -> torch.Tensor:
    """The bytes (…, 4) int64, lowest first, of texels (…) int32."""
    value = texels.long()
    return torch.stack([value >> shift & 255 for shift in (0, 8, 16, 24)], -1)


class _Brightest:
    """Where rays (R, 3) get most of their light, and how their colours change there with the direction."""

    def __init__(self, directions: torch.Tensor, field: VoxelField) -> None:
        self.directions, self.field = directions, field
        self.most, self.change = torch.zeros_like(directions[:, 0]), torch.zeros_like(directions)

    def see(self, step: _Step, weight: torch.Tensor) -> None:
        """Take in samples of some rays with their weights (N,)."""
        more = (weight > self.most[step.rays]).nonzero()[:, 0]
        rays = step.rays[more]
        texels = unpacked(self.field.changes.view(-1, AXES)[step.coarse[more]])[
            ..., :3
        ].float()  # (N, 8, axes, colours)
        mean = (step.coarse_shares[more][..., None, None] * texels).sum(1) - 127.5
        self.change[rays] = (mean * self.directions[rays][..., None]).sum(1) * (self.field.harmonic_range / 127.5)
        self.most[rays] = weight[more]


def _lit(color: torch.Tensor, opacity: torch.Tensor, change: torch.Tensor) -> torch.Tensor:
    """As `voxel_march.lit` for N rays."""
    return torch.minimum((color + opacity[:, None] * change).clamp(min=0), opacity[:, None])


def march(
    origins: torch.Tensor, directions: torch.Tensor, field: VoxelField, s: MarchSettings, ends: torch.Tensor
) -> VoxelRays:
    """As `voxel_march.march`."""
    count, device = len(origins), origins.device
    color, depth = torch.zeros(count, 3, device=device), torch.zeros(count, device=device)
    probabilities = torch.zeros(count, field.classes, device=device)
    transmittance, brightest = torch.ones(count, device=device), _Brightest(directions, field)
    exponent = s.step / cell_length(field.blocks, s.contracted)
    words = field.vertices.view(-1, TEXELS)
    for step in _steps(origins, directions, field.index, field.blocks, s, transmittance, ends):
        texels = unpacked(words[step.corners]).float()  # (N, 8, 2 texels, 4 bytes)
        parts = step.shares * texels[..., 0, 3] / 255
        root = parts.sum(1)
        alpha = 1 - (1 - root * root).clamp(min=0) ** exponent
        if field.classes:
            part = parts / root.clamp(min=1e-9)[:, None] * alpha[:, None]  # (N, 8)
            top, share, second = texels[..., 1, 0].long(), texels[..., 1, 1] / 255, texels[..., 1, 2].long()
            first = part * share * field.class_opacity[top]
            rest = part * (1 - share) * field.class_opacity[second]
            alpha = (first + rest).sum(1)
            before, rays = transmittance[step.rays][:, None], step.rays[:, None].expand_as(top)
            probabilities.index_put_((rays, top), before * first, accumulate=True)
            probabilities.index_put_((rays, second), before * rest, accumulate=True)
        weight = transmittance[step.rays] * alpha
        brightest.see(step, weight)
        color[step.rays] += weight[:, None] * _plain(texels, step.shares)
        depth[step.rays] += weight * step.t
        transmittance[step.rays] *= 1 - alpha
    color = _lit(color, 1 - transmittance, brightest.change)
    return VoxelRays(color, 1 - transmittance, depth, probabilities if field.classes else None)


def texture_reads(
    origins: torch.Tensor,
    directions: torch.Tensor,
    field: VoxelField,
    s: MarchSettings,
    marked: torch.Tensor | None = None,
) -> torch.Tensor:
    """How often (R,) the viewport's shader (addon/live/shaders.py) reads a texture for each ray: the index once in each block
    it meets, the colour and opacity at each sample, and three more times for the changes with the direction where something
    is. Where classes or things are shown other than they are, `marked` (S,) bool says which blocks have something of these. Then
    it also reads a mark in each block that is not empty; and in marked ones, where a sample holds something, the vertex that
    counts, or all eight where the nearest one is empty, its classes, and two rows of the table of looks for each of these."""
    transmittance, looks = torch.ones(len(origins), device=origins.device), torch.zeros_like(origins[:, 0])
    reads = torch.zeros_like(looks)
    words, before = field.vertices.view(-1, TEXELS), torch.full_like(reads, -1, dtype=torch.long)
    for step in _steps(origins, directions, field.index, field.blocks, s, transmittance, looks=looks):
        root = (step.shares * (words[step.corners][..., 0] >> 24 & 255) / 255).sum(1)
        reads[step.rays] += 1
        if marked is not None:
            slot = step.corners[:, 0] // VERTICES**3
            reads[step.rays] += (slot != before[step.rays]) + marked[slot] * (root > 0) * _reads_of_classes(step, words)
            before[step.rays] = slot
        left = transmittance[step.rays] * (1 - (root * root).clamp(max=1))
        transmittance[step.rays] = torch.where(left < SHADER_STOP, 0.0, left)
    return looks + reads + 3 * (transmittance < 1)


def _reads_of_classes(step: _Step, words: torch.Tensor) -> torch.Tensor:
    """Reads (N,) for the classes of samples that hold something."""
    nearest = step.corners.gather(1, step.shares.argmax(1, keepdim=True))[:, 0]
    hollow = (words[nearest][:, 0] >> 24 & 255) == 0
    sure = (words[nearest][:, 1] >> 8 & 255) == 255
    return 2 + 8 * hollow + torch.where(sure, 2, 4)


def add_views(
    views: torch.Tensor,
    origins: torch.Tensor,
    directions: torch.Tensor,
    cameras: torch.Tensor,
    index: torch.Tensor,
    roots: torch.Tensor,
    s: MarchSettings,
) -> None:
    """As `voxel_march.add_views`."""
    transmittance = torch.ones(len(origins), device=origins.device)
    by_vertex, n = len(views) == len(roots), round(len(index) ** (1 / 3))
    flat = views.view(-1)
    for step in _steps(origins, directions, index, n, s, transmittance):
        root = (step.shares * roots[step.corners].float() / 255).sum(1)
        alpha = (root * root).clamp(max=1)
        weight = transmittance[step.rays] * alpha
        camera = cameras[step.rays].long()[:, None]
        places = step.corners if by_vertex else step.corners[:, :1] // VERTICES**3
        share = (weight[:, None] * step.shares if by_vertex else weight[:, None]) * 32767
        code = torch.where(share.int() > 0, share.int() * 65536 + camera.int(), 0)
        slot = places * VIEWS + camera % VIEWS
        flat.scatter_reduce_(0, slot.reshape(-1), code.reshape(-1), "amax")
        transmittance[step.rays] *= 1 - alpha


def add_errors(
    sums: torch.Tensor,
    origins: torch.Tensor,
    directions: torch.Tensor,
    wanted: torch.Tensor,
    behind: torch.Tensor,
    field: VoxelField,
    s: MarchSettings,
) -> torch.Tensor:
    """As `voxel_fit.add_errors`."""
    words, brightest = field.vertices.view(-1, TEXELS), _Brightest(directions, field)
    total, error = behind, behind
    for last in (False, True):
        transmittance, color = torch.ones(len(origins), device=origins.device), torch.zeros_like(behind)
        for step in _steps(origins, directions, field.index, field.blocks, s, transmittance):
            texels = unpacked(words[step.corners]).float()
            root = (step.shares * texels[..., 0, 3] / 255).sum(1)
            alpha, before = (root * root).clamp(max=1), transmittance[step.rays]
            plain, weight = _plain(texels, step.shares), before * alpha
            color[step.rays] += weight[:, None] * plain
            if not last:
                brightest.see(step, weight)
            else:
                left, change = (before * (1 - alpha))[:, None], brightest.change[step.rays]
                rest = (total[step.rays] - color[step.rays] - (1 - left) * change) / left.clamp(min=1e-4)
                effect = ((plain + change).clamp(0, 1) - rest.clamp(0, 1)) * (2 * before * root)[:, None]
                here = error[step.rays]
                slope, square = (effect * here).sum(1, keepdim=True), (effect * effect).sum(1, keepdim=True)
                told = torch.cat([weight[:, None] * here, weight[:, None], slope, square], 1)
                shared = step.shares[..., None] * (told * (before * root > LEAST_WEIGHT)[:, None])[:, None]
                sums.index_add_(0, step.corners.reshape(-1), shared.reshape(-1, 6))
            transmittance[step.rays] *= 1 - alpha
        if not last:
            total = _lit(color, 1 - transmittance, brightest.change) + behind * transmittance[:, None]
            error = wanted - total
    return error.square().mean(1)


def _plain(texels: torch.Tensor, shares: torch.Tensor) -> torch.Tensor:
    """Colours (N, 3) of samples without their changes, of the texels (N, 8, 2, 4) of their corners, shares (N, 8)."""
    return (shares[..., None] * texels[..., 0, :3]).sum(1) / 255
