"""Where a surface is looked for, and how finely."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from ..errors import TrainingError
from ..geometry.similarity import similarity_scale
from ..kernels.depth_arrays import FREE, MapArrays
from .depth_maps import hit_points

MARGIN = 0.02  # of the longest side
INNER, REACH = (1.0, 99.0), 0.25  # percentiles of all hits; how far beyond them, as a share of their extent
FEWEST_HITS = 200
CELLS = (512, 1024)  # along the longest side, where nobody asks for a number: the fewest and the most
ALONG = 1e-6  # sine of the angle between two axes up to which they are one
ENOUGH = 1.5  # median footprints of a pixel that a voxel may have before there are more cells than the fewest


@dataclass(frozen=True)
class Region:
    """A box of the normalised frame between two corners (3,), cut into cubes of side `voxel`; `sides`: of a box at an angle
    in it, outside of which nothing is looked for, see `sides_of`."""

    low: np.ndarray
    high: np.ndarray
    voxel: float
    sides: np.ndarray | None = None

    @property
    def size(self) -> float:
        return float((self.high - self.low).max())


def sides_of(low: np.ndarray, high: np.ndarray, world_from_box: np.ndarray) -> np.ndarray | None:
    """The six sides (6, 4) of the box between two corners (3,) of the world, as planes of the normalised frame: a·x + b·y + c·z +
    d is the distance outwards. None where the box stands along the axes there."""
    scale = similarity_scale(world_from_box)
    rows = world_from_box[:3] / scale
    if np.sort(np.abs(rows[:, :3]), axis=1)[:, 1].max() < ALONG:
        return None
    beyond_high = np.concatenate([rows[:, :3], rows[:, 3:] - high[:, None] / scale], 1)
    beyond_low = np.concatenate([-rows[:, :3], low[:, None] / scale - rows[:, 3:]], 1)
    return np.concatenate([beyond_high, beyond_low])


def outside(sides: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """How far places, whose coordinates broadcast to each other, lie outside of a box with these sides (6, 4); negative
    within."""
    return np.stack([a * x + b * y + c * z + d for a, b, c, d in sides]).max(0)


def drawn_in(vertices: np.ndarray, region: Region) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3), of which those beyond a region, by less than a voxel as a rule, are moved to the nearest place on its sides;
    and which (V,) bool these are."""
    inside = vertices.clip(region.low, region.high)
    for *normal, shift in region.sides if region.sides is not None else ():
        inside = inside - np.maximum(inside @ normal + shift, 0)[:, None] * normal
    return inside, (inside != vertices).any(1)


def all_hits(maps: MapArrays, most: int = 1 << 20) -> torch.Tensor:
    """Up to about `most` of the points (N, 3) that the maps show, evenly chosen."""
    step = max(1, int(((maps.depth > 0) & (maps.depth < FREE)).sum()) // most)
    return torch.cat([hit_points(maps, view)[::step] for view in range(len(maps))])


def choose_region(
    maps: MapArrays, bounds: tuple[np.ndarray, np.ndarray] | None, cells: int | None, voxel: float | None = None
) -> Region:
    """The box to look in: `bounds` (corners (3,)) cut to what is seen, or what the maps show without far outliers.

    Args:
        cells: voxels along the longest side; None: 512, or up to 1024 where the pictures are finer. Fewer where they are
            coarser: a voxel is at least half the median footprint of a pixel.
        voxel: side of a voxel, instead of that.
    Raises:
        TrainingError: the maps show (almost) nothing, or nothing within the bounds.
    """
    return region_around(all_hits(maps).cpu().numpy(), lambda: footprint(maps), bounds, cells, voxel)


def region_around(
    points: np.ndarray,
    pixel: Callable[[], float],
    bounds: tuple[np.ndarray, np.ndarray] | None,
    cells: int | None,
    voxel: float | None = None,
) -> Region:
    """`choose_region` from the points (N, 3) that maps show, and the median footprint of a pixel there."""
    if len(points) < FEWEST_HITS:
        raise TrainingError(
            "The field shows no surface that several views agree on.",
            "Train longer, or check the poses: `fieldwork evaluate` says how good the field is.",
        )
    if bounds is not None:
        inside = ((points >= bounds[0]) & (points <= bounds[1])).all(1)
        if inside.sum() < FEWEST_HITS:
            raise TrainingError(
                "The photos show no surface in the region to look in.",
                "Check the region of interest or `--region`: corners are in the aligned world, in its units. "
                "`--region photos` looks at all that the photos show.",
            )
        points = points[inside]
        low, high = points.min(0), points.max(0)
    else:
        inner = np.percentile(points, INNER, axis=0)
        room = REACH * (inner[1] - inner[0]).max()
        low, high = np.maximum(points.min(0), inner[0] - room), np.minimum(points.max(0), inner[1] + room)
    margin = MARGIN * (high - low).max()
    low, high = low - margin, high + margin
    if bounds is not None:
        low, high = np.maximum(low, bounds[0]), np.minimum(high, bounds[1])
    if voxel is None:
        size, fine = float((high - low).max()), pixel()
        fewest, most = (cells, cells) if cells else CELLS
        voxel = max(min(size / fewest, ENOUGH * fine), size / most, 0.5 * fine)
    return Region(low, high, voxel)


def footprint(maps: MapArrays) -> float:
    """Median size of a pixel at the surface, z / f."""
    sizes = []
    for view in range(len(maps)):
        begin = int(maps.first[view])
        depth = maps.depth[begin : begin + int(maps.size[view].prod())][::7]
        sizes.append(depth[(depth > 0) & (depth < FREE)] / maps.lens[view, 0])
    return float(torch.cat(sizes).median())


def on_sides(vertices: np.ndarray, faces: np.ndarray, region: Region, within: float) -> np.ndarray:
    """Which triangles (F,) lie in one of the sides of a region, to `within`: there it was cut, nothing was seen."""
    corners = vertices[faces]
    low, high = ((np.abs(corners - side) < within).all(1) for side in (region.low, region.high))
    return (low | high).any(1)
