"""Depth maps fused into signed distances on a sparse grid: bricks of 8³ corners near what the maps show.

Source: Curless and Levoy, "A volumetric method for building complex models from range images", 1996; the rule for thin
sheets and the weights are in kernels/surface.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import psutil
import scipy
import torch

from ..errors import SettingError
from ..kernels.depth_arrays import FREE, MapArrays
from ..kernels.surface import fuse
from ..progress import Reporter
from .depth_maps import hit_points, hit_values
from .region import Region

BRICK = 8  # corners along each side of a brick
TRUNCATION = 4.0  # voxels
NEAR = 2.5  # voxels around a hit in which the surface may lie
FREE_AT = 1.5  # voxels in front of a view's surface: it looks through
GAP, GAP_PIXELS = (
    0.03,
    5.5,
)  # share, or footprints of a pixel, by which depths of one surface differ from pixel to pixel
CHUNK = 256  # bricks
STEP = 1.3  # voxels by which distances of neighbouring corners differ at most on either side of one surface
UNSTEADY = 0.15  # share of the crossings in a brick that step farther, from which on its views disagree
WIDER = 4.0  # times the truncation with which such bricks are fused anew
BYTES_PER_PLACE, BYTES_PER_BRICK = 8, 2 * 4 * BRICK**3  # of memory: a brick that may be there, and one that is


@dataclass(frozen=True)
class Bricks:
    """Distances on a sparse grid. index (X, Y, Z) int32: place of each brick, −1 where there is none; distance
    (B, 8, 8, 8) float32 in normalised units, negative inside, and weight, 0 where no view says anything, of the corners
    origin + voxel · (8 · brick + (i, j, k)); wide (B,) bool: bricks fused with a wider truncation; corners (3,): how many
    of the grid lie in the region, which the last bricks reach beyond; sides: see `Region`."""

    origin: np.ndarray
    voxel: float
    index: np.ndarray
    distance: np.ndarray
    weight: np.ndarray
    wide: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    corners: np.ndarray = field(default_factory=lambda: np.full(3, np.iinfo(np.int64).max))
    sides: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.distance)


def fuse_maps(
    maps: MapArrays,
    region: Region,
    report: Reporter,
    part: tuple[np.ndarray, np.ndarray] | None = None,
    focal: float | None = None,
    spreads: Sequence[np.ndarray] | None = None,
) -> Bricks:
    """Fuse depth maps within a region. Where depths of different views lie farther apart than the truncation, each makes a
    surface of its own, and these break each other up: bricks where distances step are fused anew with a wider one, which
    takes the mean of all. Only of a soft field, though: where another one is unsure, as between leaves, there are several
    surfaces, and a mean would make a lump of them.

    Args:
        focal, spreads: the smallest focal length in pixels of all maps, and what `spread_of` says of them, where these are
            not all there are.
        part: first bricks (3,) and those after the last (3,), where only a part of the region's grid is wanted: what is
            there is the same, to the bit, as on the whole grid.
    Raises:
        SettingError: the grid does not fit into memory.
    """
    h = region.voxel
    origin, counts = grid_of(region)
    check_memory(counts, BYTES_PER_PLACE * np.prod(counts, dtype=float))
    index = _mark(maps, origin, h, counts, report)
    if part is not None:
        index = _only(index, *part)
    bricks = np.stack(np.nonzero(index >= 0), 1)
    check_memory(counts, BYTES_PER_BRICK * len(bricks))
    device = maps.depth.device
    axis = torch.arange(BRICK, device=device)
    inner = torch.cartesian_prod(axis, axis, axis)
    start, gap = torch.from_numpy(origin).float().to(device), depth_gap(maps, focal)
    distance, weight = (np.zeros((len(bricks), BRICK, BRICK, BRICK), np.float32) for _ in range(2))

    def fuse_bricks(numbers: np.ndarray, wider: float, begin: float, end: float) -> None:
        for number in range(0, len(numbers), CHUNK):
            report.progress(begin + (end - begin) * number / len(numbers))
            chunk = numbers[number : number + CHUNK]
            some = torch.from_numpy(bricks[chunk]).to(device)
            points = (some[:, None] * BRICK + inner).reshape(-1, 3) * h + start
            values = fuse(points.float(), maps, h, wider * TRUNCATION * h, wider * FREE_AT * h, gap)
            for all_of, some_of in zip((distance, weight), values):
                all_of[chunk] = some_of.view(-1, BRICK, BRICK, BRICK).cpu().numpy()

    fuse_bricks(np.arange(len(bricks)), 1.0, 0.0, 0.8)
    wide = np.zeros(len(bricks), bool)
    if is_soft([spread_of(maps)] if spreads is None else spreads, h):
        unsure = mean_spread(maps, origin, h, counts)[tuple(bricks.T)] > TRUNCATION * h
        wide = unsure & unsteady(distance, weight, h)
        fuse_bricks(np.flatnonzero(wide), WIDER, 0.8, 1.0)
    return Bricks(origin, h, index, distance, weight, wide, cells_of(region) + 1, region.sides)


def check_memory(counts: np.ndarray, needed: float) -> None:
    """Raise SettingError when a grid of so many bricks (3,), which needs so many bytes, does not fit into free memory."""
    free = psutil.virtual_memory().available
    if needed > free:
        cells = "×".join(str(n * BRICK) for n in counts.tolist())
        raise SettingError(
            f"A grid of {cells} cells needs {needed / 1e9:.3g} GB of memory, and {free / 1e9:.3g} GB are free.",
            "Ask for larger cells by `--detail` or `--resolution`, or look in a smaller `--region`.",
        )


def spread_of(maps: MapArrays) -> np.ndarray:
    """Sum of the spreads of all depths that maps show, and how many these are: (2,)."""
    shown = maps.spread[(maps.depth > 0) & (maps.depth < FREE)]
    return np.array([float(shown.double().sum()), len(shown)])


def is_soft(spreads: Sequence[np.ndarray], voxel: float) -> bool:
    """Whether the depths of maps, of each group what `spread_of` says, have a mean spread above the truncation."""
    total, number = np.sum(spreads, axis=0)
    return bool(total > TRUNCATION * voxel * number)


def mean_spread(maps: MapArrays, origin: np.ndarray, voxel: float, counts: np.ndarray) -> np.ndarray:
    """Mean spread (X, Y, Z) of the depths that maps show in each brick of a grid and in those around it."""
    total, amount = (np.zeros(np.prod(counts)) for _ in range(2))
    start = torch.from_numpy(origin).float().to(maps.depth.device)
    for view in range(len(maps)):
        points, spread = hit_points(maps, view), hit_values(maps, maps.spread, view)
        brick = torch.div(points - start, BRICK * voxel, rounding_mode="floor").long().cpu().numpy()
        inside = ((brick >= 0) & (brick < counts)).all(1)
        number = np.ravel_multi_index(tuple(brick[inside].T), tuple(counts))
        total += np.bincount(number, spread.cpu().numpy()[inside], len(total))
        amount += np.bincount(number, minlength=len(amount))
    total, amount = (scipy.ndimage.uniform_filter(a.reshape(counts), 3, mode="constant") for a in (total, amount))
    return total / np.maximum(amount, 0.01)  # one depth in 27 bricks is the least


def unsteady(distance: np.ndarray, weight: np.ndarray, voxel: float) -> np.ndarray:
    """Which bricks (B,) bool with distances and weights (B, 8, 8, 8) have no single surface: where the sign changes between
    neighbouring corners, a distance differs by a voxel at most."""
    crossings, steps = (np.zeros(len(distance), int) for _ in range(2))
    for axis in (1, 2, 3):
        sides = range(BRICK - 1), range(1, BRICK)
        near, far = (np.take(distance, side, axis) for side in sides)
        known, also = (np.take(weight, side, axis) > 0 for side in sides)
        crossing = known & also & ((near < 0) != (far < 0))
        crossings += crossing.sum((1, 2, 3))
        steps += (crossing & (np.abs(near - far) > STEP * voxel)).sum((1, 2, 3))
    return steps > UNSTEADY * crossings


def tolerances(bricks: Bricks, vertices: np.ndarray, faces: np.ndarray, tolerance: float) -> np.ndarray:
    """How far (F,) triangles of a fused surface may lie from what a view shows: `tolerance`, wider in proportion to the
    truncation of their bricks."""
    brick = np.floor((vertices[faces].mean(1) - bricks.origin) / (BRICK * bricks.voxel)).astype(int)
    number = bricks.index[tuple(np.clip(brick, 0, np.array(bricks.index.shape) - 1).T)]
    return np.where((number >= 0) & bricks.wide[number], WIDER * tolerance, tolerance)


def cells_of(region: Region) -> np.ndarray:
    """How many cells (3,) a region has along its sides."""
    return np.maximum(np.ceil((region.high - region.low) / region.voxel).astype(int), 1)


def grid_of(region: Region) -> tuple[np.ndarray, np.ndarray]:
    """The first corner (3,) of a region's grid, and how many bricks (3,) it has."""
    cells = cells_of(region)
    return (region.low + region.high) / 2 - cells * region.voxel / 2, -(-(cells + 1) // BRICK)


def _only(index: np.ndarray, first: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The index with the bricks from `first` to before `end` alone, numbered anew."""
    inside = np.zeros(index.shape, bool)
    inside[tuple(slice(max(a, 0), max(b, 0)) for a, b in zip(first, end))] = True
    kept = np.full(index.shape, -1, np.int32)
    found = inside & (index >= 0)
    kept[found] = np.arange(int(found.sum()), dtype=np.int32)
    return kept


def depth_gap(maps: MapArrays, focal: float | None = None) -> float:
    """Share by which depths of neighbouring pixels of one surface may differ."""
    return max(GAP, GAP_PIXELS / (float(maps.lens[:, 0].min()) if focal is None else focal))


def coarser(bricks: Bricks) -> Bricks:
    """Every second corner: the grid that fusing with voxels of twice the size would give, but for its truncation, as
    distances are those of single points."""
    shape = np.array(bricks.index.shape)
    padded = np.full(shape + shape % 2, -1, np.int32)
    padded[: shape[0], : shape[1], : shape[2]] = bricks.index
    x, y, z = (n // 2 for n in padded.shape)
    children = padded.reshape(x, 2, y, 2, z, 2).transpose(0, 2, 4, 1, 3, 5).reshape(x, y, z, 8)
    found = (children >= 0).any(-1)
    index = np.full(found.shape, -1, np.int32)
    index[found] = np.arange(int(found.sum()), dtype=np.int32)
    made = [np.zeros((int(found.sum()), BRICK, BRICK, BRICK), a.dtype) for a in (bricks.distance, bricks.weight)]
    half = BRICK // 2
    for number, child in enumerate(children[found].T):
        corner = np.array(np.unravel_index(number, (2, 2, 2))) * half
        block = tuple(slice(c, c + half) for c in corner)
        there = child >= 0
        for new, old in zip(made, (bricks.distance, bricks.weight)):
            new[(there, *block)] = old[child[there]][:, ::2, ::2, ::2]
    return Bricks(
        bricks.origin, 2 * bricks.voxel, index, *made, corners=(bricks.corners - 1) // 2 + 1, sides=bricks.sides
    )


def _mark(maps: MapArrays, origin: np.ndarray, voxel: float, counts: np.ndarray, report: Reporter) -> np.ndarray:
    """Number the bricks (X, Y, Z) that lie near a hit; −1 elsewhere."""
    device = maps.depth.device
    marked = torch.zeros(tuple(counts.tolist()), dtype=torch.bool, device=device)
    start = torch.from_numpy(origin).float().to(device)
    most = torch.from_numpy(counts).to(device)
    for view in range(len(maps)):
        report.progress(0.0)
        place = (hit_points(maps, view) - start) / voxel
        place = place[((place > -NEAR) & (place < most * BRICK + NEAR)).all(1)]
        for corner in torch.cartesian_prod(*[torch.tensor([-NEAR, NEAR], device=device)] * 3):
            brick = torch.div(place + corner, BRICK, rounding_mode="floor").long()
            brick = torch.minimum(brick.clamp(min=0), most - 1)
            marked[brick[:, 0], brick[:, 1], brick[:, 2]] = True
    index = np.full(tuple(counts.tolist()), -1, np.int32)
    found = marked.cpu().numpy()
    index[found] = np.arange(int(found.sum()), dtype=np.int32)
    return index
