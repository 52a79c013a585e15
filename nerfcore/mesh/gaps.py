"""Holes and frayed borders of a surface, closed by a guess.

A surface that photos show ends where they do not agree: in holes, cracks and ragged borders. Between its ends, distances
that are harmonic continue it smoothly. Of that continuation stays what a closing leaves: places from which a disc of the
asked width cannot be laid onto the continuation without touching what photos show, so that straight borders remain
where they are. What views look through is an opening and stays one: it may close by less of a width.
Source: the volumetric filling of Davis, Marschner, Garr and Levoy, “Filling holes in complex surfaces using volumetric
diffusion”, 2002, with the steady state of the diffusion, and closing as in mathematical morphology.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
import torch

from ..kernels.depth_arrays import MapArrays
from ..kernels.surface import fuse
from ..progress import Reporter
from .extract import extract
from .fusion import BRICK, FREE_AT, TRUNCATION, Bricks, depth_gap
from .holes import fill_holes
from .triangles import areas, border_edges, compact, components, mean_around

MOST_REACH = 10  # voxels, about, that a guess reaches at first, and on the grid on which it is first sought
ROUNDS, GOOD = 400, 1e-3  # of conjugate gradients: at most, and the residual that is enough
THROUGH = 1.5  # voxels that a view must look past a place, to deny it
MOSTLY = 3  # rings of faces of which most must be looked through
OPENING = 0.1  # share of its area, looked through, from which a part is an opening
TILE = 4  # corners along a side of what is taken into the domain at once
MOST_VALUE = 1.5  # voxels: distances at corners of a cell that the surface crosses are hardly larger
CHUNK = 1 << 16


@dataclass(frozen=True)
class Corners:
    """Corners of a grid with `shape` (3,) along its sides: sorted numbers (N,), values (N,) in voxels, and which are guessed (N,)."""

    shape: np.ndarray
    number: np.ndarray
    value: np.ndarray
    guessed: np.ndarray


def close_gaps(
    bricks: Bricks, vertices: np.ndarray, faces: np.ndarray, width: float, maps: MapArrays, report: Reporter
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Close holes and bays of a surface up to a width: narrow ones first, then those between what is there by then.

    Args:
        bricks: distances the surface was extracted from. vertices (V, 3) of the normalised frame, faces (F, 3): what of it
            stays. width: in units of the frame.
    Returns:
        vertices, faces, and which of these (F,) bool are guessed.
    """
    shape = np.array(bricks.index.shape) * BRICK
    seen = cells = np.unique(_number(_cells(bricks, vertices, faces), shape))
    reach = width / 2 / bricks.voxel
    for wider in range(-_halvings(reach), 1):
        ends = np.unique(border_edges(faces))
        if not len(ends):
            break
        places = (vertices[ends] - bricks.origin) / bricks.voxel
        found = continued(bricks, _place(cells, shape), places, reach * 2.0**wider, report)
        vertices, faces = extract(_alone(bricks, found), report)
        guessed = ~np.isin(_number(_cells(bricks, vertices, faces), shape), cells)
        kept = ~guessed | closed(vertices, faces, guessed, reach * 2.0**wider * bricks.voxel, bricks, maps, report)
        vertices, faces = compact(vertices, faces[kept])
        cells = np.unique(_number(_cells(bricks, vertices, faces), shape))
        bricks = _with(bricks, _guessed_at(found, _cells(bricks, vertices, faces[guessed[kept]])))
    vertices, faces, filled = fill_holes(vertices, faces, check=report.check)
    kept = ~open_places(vertices, faces, filled, bricks, maps, report)
    vertices, faces = compact(vertices, faces[kept])
    return vertices, faces, filled[kept] | ~np.isin(_number(_cells(bricks, vertices, faces), shape), seen)


def closed(
    vertices: np.ndarray,
    faces: np.ndarray,
    guessed: np.ndarray,
    reach: float,
    bricks: Bricks,
    maps: MapArrays,
    report: Reporter,
) -> np.ndarray:
    """Which guessed triangles (F,) bool close a gap that is none of the openings; those of a part that is one may close by
    less."""
    kept, through = np.zeros(len(faces), bool), None
    while through is None or reach > bricks.voxel:
        found = guessed & closing(vertices, faces, guessed, reach, report)
        if through is None:  # what closes by less is part of it
            through = looked_through(vertices, faces, found, bricks, maps, report)
        kept |= found & ~openings(vertices, faces, found, through)
        reach /= 2
    return kept


def continued(bricks: Bricks, cells: np.ndarray, ends: np.ndarray, reach: float, report: Reporter) -> Corners:
    """Distances around cells (C, 3) that a surface crosses, their own, and harmonic ones within `reach` voxels of its `ends`
    (E, 3), in voxels from the grid's origin. Where they reach far they are sought on a coarser grid first, and on each
    finer one around the level that the coarser one has."""
    guess: Corners | None = None
    for step in [2**k for k in range(_halvings(reach), -1, -1)]:
        report.check()
        known = _around(bricks, cells, step)
        if guess is None:
            unknown = np.setdiff1d(_near(ends / step, reach / step, known.shape), known.number, assume_unique=True)
            fixed, start = known, None
        else:
            unknown = np.setdiff1d(_band(guess, known.shape), known.number, assume_unique=True)
            start = _finer(guess, _place(unknown, known.shape), report)
            rim = _on_rim(unknown, known)
            fixed = _joined(known, Corners(known.shape, unknown[rim], start[rim], np.ones(int(rim.sum()), bool)))
            unknown, start = unknown[~rim], start[~rim]
        value = harmonic(unknown, fixed, start, report)
        guess = _joined(fixed, Corners(known.shape, unknown, value, np.ones(len(unknown), bool)))
    assert guess is not None
    return guess


def _halvings(reach: float) -> int:
    """How often a reach in voxels is halved until it is about the most that is sought on one grid."""
    return max(0, round(np.log2(max(reach, 1) / MOST_REACH)))


def harmonic(unknown: np.ndarray, known: Corners, start: np.ndarray | None, report: Reporter) -> np.ndarray:
    """Values (U,) at corners with these sorted numbers (U,), each the mean of its neighbours' among themselves and the known
    ones. By conjugate gradients from `start`."""
    rows, columns, right, degree = [], [], np.zeros(len(unknown)), np.zeros(len(unknown))
    for wanted, inside in _neighbours(unknown, known.shape):
        report.check()
        at, found = _find(unknown, wanted)
        free = np.flatnonzero(inside & found)
        rows.append(free)
        columns.append(at[free])
        at, found = _find(known.number, wanted)
        fixed = np.flatnonzero(inside & found)
        right[fixed] += known.value[at[fixed]]
        degree[fixed] += 1
        degree[free] += 1
    row, column, count = np.concatenate(rows), np.concatenate(columns), len(unknown)
    around = scipy.sparse.csr_matrix((np.ones(len(row), np.float32), (row, column)), (count, count))
    degree = np.maximum(degree, 1).astype(np.float32)

    def laplacian(x: np.ndarray) -> np.ndarray:
        report.check()
        return degree * x - around @ x

    operator = scipy.sparse.linalg.LinearOperator((count, count), laplacian, dtype=np.float32)
    scaled = scipy.sparse.linalg.LinearOperator((count, count), lambda x: x / degree, dtype=np.float32)
    right = right.astype(np.float32)
    found, _ = scipy.sparse.linalg.cg(operator, right, start, rtol=GOOD, maxiter=ROUNDS, M=scaled)
    return found


def closing(vertices: np.ndarray, faces: np.ndarray, guessed: np.ndarray, reach: float, report: Reporter) -> np.ndarray:
    """Which triangles (F,) bool stay: those not guessed, and of the guessed ones those of the closing by `reach`: as the guess
    goes, within `reach` of the others, and farther than that from what is beyond."""
    kept, rows = ~guessed, np.flatnonzero(guessed)
    if not len(rows):
        return kept
    own, seen = faces[rows], np.zeros(len(vertices), bool)
    seen[faces[~guessed]] = True
    rows = rows[(_ways(vertices, own, np.unique(own[seen[own]]), reach, report)[own] <= reach).all(1)]
    border = border_edges(faces[kept | np.isin(np.arange(len(faces)), rows)])
    own, ends = faces[rows], np.zeros(len(vertices), bool)
    ends[border] = True
    ends[faces[~guessed]] = False  # there, the surface itself ends
    kept[rows[(_ways(vertices, own, np.unique(own[ends[own]]), reach, report)[own] > reach).all(1)]] = True
    return kept


def looked_through(
    vertices: np.ndarray, faces: np.ndarray, asked: np.ndarray, bricks: Bricks, maps: MapArrays, report: Reporter
) -> np.ndarray:
    """Which triangles (F,) bool, of those asked about, lie in space that views show to be free."""
    rows, device, h = np.flatnonzero(asked), maps.depth.device, bricks.voxel
    through = np.zeros(len(faces))
    for begin in range(0, len(rows), CHUNK):
        report.check()
        some = rows[begin : begin + CHUNK]
        middle = torch.from_numpy(vertices[faces[some]].mean(1)).float().to(device)
        distance, weight = fuse(middle, maps, h, TRUNCATION * h, FREE_AT * h, depth_gap(maps))
        through[some] = ((weight > 0) & (distance > THROUGH * h)).cpu().numpy()
    return asked & (mean_around(faces, through, len(vertices), MOSTLY) > 0.5)


def open_places(
    vertices: np.ndarray, faces: np.ndarray, guessed: np.ndarray, bricks: Bricks, maps: MapArrays, report: Reporter
) -> np.ndarray:
    """Which guessed triangles (F,) bool close what views look through."""
    return openings(vertices, faces, guessed, looked_through(vertices, faces, guessed, bricks, maps, report))


def openings(vertices: np.ndarray, faces: np.ndarray, guessed: np.ndarray, through: np.ndarray) -> np.ndarray:
    """Which guessed triangles (F,) bool are an opening: views look through them (`through`), or through enough of the connected
    part they are of."""
    rows = np.flatnonzero(guessed)
    if not len(rows):
        return guessed
    part, area = components(faces[rows], len(vertices)), areas(vertices, faces[rows])
    share = np.bincount(part, area * through[rows]) / np.maximum(np.bincount(part, area), 1e-30)
    opening = np.zeros(len(faces), bool)
    opening[rows] = through[rows] | (share >= OPENING)[part]
    return opening


def _cells(bricks: Bricks, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The cell (F, 3) of the grid in which each triangle lies."""
    return np.floor((vertices[faces].mean(1) - bricks.origin) / bricks.voxel).astype(np.int64)


def _number(place: np.ndarray, shape: np.ndarray) -> np.ndarray:
    return (place[:, 0] * shape[1] + place[:, 1]) * shape[2] + place[:, 2]


def _place(number: np.ndarray, shape: np.ndarray) -> np.ndarray:
    return np.stack(np.unravel_index(number, tuple(shape)), 1)


def _find(numbers: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where in sorted numbers each of the wanted ones is, and which are there."""
    if not len(numbers):
        return np.zeros(len(wanted), np.int64), np.zeros(len(wanted), bool)
    at = np.searchsorted(numbers, wanted).clip(max=len(numbers) - 1)
    return at, numbers[at] == wanted


def _neighbours(number: np.ndarray, shape: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Numbers (N,) of the next corners in each of six directions, and whether these are on the grid."""
    place, strides = _place(number, shape), (shape[1] * shape[2], shape[2], 1)
    steps = [(axis, step) for axis in range(3) for step in (-1, 1)]
    return [
        (number + step * strides[axis], (place[:, axis] + step >= 0) & (place[:, axis] + step < shape[axis]))
        for axis, step in steps
    ]


def _box(first: int, last: int) -> np.ndarray:
    """Steps (N, 3) from `first` to `last` along each axis."""
    return np.stack(np.meshgrid(*[np.arange(first, last + 1)] * 3, indexing="ij"), -1).reshape(-1, 3)


def _corners_at(places: np.ndarray, steps: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Sorted numbers of the corners that are these steps (S, 3) from places (P, 3), where they are on the grid."""
    found = (places[:, None] + steps).reshape(-1, 3)
    return np.unique(_number(found[((found >= 0) & (found < shape)).all(1)], shape))


def _around(bricks: Bricks, cells: np.ndarray, step: int) -> Corners:
    """What was fused at the corners around cells (C, 3), on a grid of every `step`th corner."""
    fine = np.array(bricks.index.shape) * BRICK
    shape = -(-fine // step)
    coarse = _number(cells // step, shape)
    numbers = _corners_at(_place(np.unique(coarse), shape), _box(0, 1), shape)
    place = _place(numbers, shape) * step
    slot = (bricks.index[tuple((place // BRICK).T)], *(place % BRICK).T)
    known = (slot[0] >= 0) & (bricks.weight[slot] > 0)
    value = np.clip(bricks.distance[slot] / (step * bricks.voxel), -MOST_VALUE, MOST_VALUE)
    return Corners(shape, numbers[known], value[known], np.zeros(int(known.sum()), bool))


def _near(ends: np.ndarray, reach: float, shape: np.ndarray) -> np.ndarray:
    """Sorted numbers of the corners within about `reach` of places (E, 3), by tiles."""
    tiles = np.zeros(-(-shape // TILE), bool)
    tiles[tuple(np.floor(ends / TILE).astype(int).clip(0, np.array(tiles.shape) - 1).T)] = True
    away = np.asarray(scipy.ndimage.distance_transform_edt(~tiles))
    return _corners_at(np.argwhere(away * TILE <= reach + TILE) * TILE, _box(0, TILE - 1), shape)


def _band(coarse: Corners, shape: np.ndarray) -> np.ndarray:
    """Sorted numbers of the corners of a grid twice as fine around the level zero of the coarser one, where a guess is involved."""
    around = [(inside, *_find(coarse.number, wanted)) for wanted, inside in _neighbours(coarse.number, coarse.shape)]
    involved = coarse.guessed.copy()
    for _ in range(2):  # a cell may be known in part
        involved |= np.any([inside & found & involved[at] for inside, at, found in around], axis=0)
    sign, crossing = coarse.value < 0, np.zeros(len(coarse.number), bool)
    for inside, at, found in around:
        crossing |= inside & found & (sign != sign[at]) & (involved | involved[at])
    around_it = _corners_at(_place(coarse.number[crossing], coarse.shape), _box(-1, 1), coarse.shape)
    return _corners_at(2 * _place(around_it, coarse.shape), _box(0, 1), shape)


def _finer(coarse: Corners, place: np.ndarray, report: Reporter) -> np.ndarray:
    """Values (N,) at corners (N, 3) of a grid twice as fine: those of the corners around, weighted by nearness."""
    total, amount = np.zeros(len(place)), np.zeros(len(place))
    for step in _box(0, 1):
        report.check()
        corner = place // 2 + step
        weight = np.where(place % 2 == 1, 0.5, 1.0 - step).prod(1)
        at, found = _find(coarse.number, _number(corner, coarse.shape))
        weight *= found & (corner < coarse.shape).all(1)
        total += weight * coarse.value[at]
        amount += weight
    return 2 * total / np.maximum(amount, 1e-9)


def _on_rim(unknown: np.ndarray, known: Corners) -> np.ndarray:
    """Which of the unknown corners (U,) have a neighbour that is neither unknown nor known."""
    rim = np.zeros(len(unknown), bool)
    for wanted, inside in _neighbours(unknown, known.shape):
        rim |= inside & ~(_find(unknown, wanted)[1] | _find(known.number, wanted)[1])
    return rim


def _joined(first: Corners, second: Corners) -> Corners:
    number = np.concatenate([first.number, second.number])
    order = np.argsort(number)
    value, guessed = (np.concatenate(pair) for pair in ((first.value, second.value), (first.guessed, second.guessed)))
    return Corners(first.shape, number[order], value[order], guessed[order])


def _alone(bricks: Bricks, corners: Corners) -> Bricks:
    """The same grid with these corners alone."""
    none = np.zeros((0, BRICK, BRICK, BRICK), np.float32)
    return _with(replace(bricks, index=np.full_like(bricks.index, -1), distance=none, weight=none), corners)


def _guessed_at(corners: Corners, cells: np.ndarray) -> Corners:
    """The guessed ones of corners, around cells (C, 3)."""
    at, found = _find(corners.number, _corners_at(cells, _box(0, 1), corners.shape))
    at = at[found & corners.guessed[at]]
    return Corners(corners.shape, corners.number[at], corners.value[at], corners.guessed[at])


def _with(bricks: Bricks, corners: Corners) -> Bricks:
    """The grid with these corners known."""
    place = _place(corners.number, corners.shape)
    brick, index = tuple((place // BRICK).T), bricks.index.copy()
    added = np.zeros(index.shape, bool)
    added[brick] = True
    added &= index < 0
    more = int(added.sum())
    index[added] = np.arange(len(bricks), len(bricks) + more, dtype=np.int32)
    empty = np.zeros((more, BRICK, BRICK, BRICK), np.float32)
    distance, weight = (np.concatenate([values, empty]) for values in (bricks.distance, bricks.weight))
    slot = (index[brick], *(place % BRICK).T)
    distance[slot], weight[slot] = corners.value * bricks.voxel, 1.0
    return replace(bricks, index=index, distance=distance, weight=weight, wide=np.zeros(len(distance), bool))


def _ways(vertices: np.ndarray, faces: np.ndarray, sources: np.ndarray, most: float, report: Reporter) -> np.ndarray:
    """Lengths (V,) of the shortest ways along edges of triangles from the nearest of some vertices; infinite beyond `most`, and
    where no triangle is."""
    report.check()
    found = np.full(len(vertices), np.inf)
    if not len(sources):
        return found
    used, own = np.unique(faces, return_inverse=True)
    own = own.reshape(-1, 3)
    edges = np.concatenate([own[:, [0, 1]], own[:, [1, 2]], own[:, [2, 0]]])
    length = np.linalg.norm(vertices[used[edges[:, 0]]] - vertices[used[edges[:, 1]]], axis=1)
    graph = scipy.sparse.coo_matrix((length, tuple(edges.T)), (len(used),) * 2).tocsr()
    at = np.searchsorted(used, sources)
    found[used] = scipy.sparse.csgraph.dijkstra(graph, directed=False, indices=at, limit=most, min_only=True)
    return found
