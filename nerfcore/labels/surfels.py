"""Surfels: small pieces of the surface that photos show, all of a scene in about 200 thousand, and what is known of each.

A surfel begins as a cell of a regular grid in grid coordinates (contracted where the scene is) with all hits of rays in it.
Hits then join the cell beside it that is more like them in colour, so that surfels, and with them all overlays, end where
colours do. Cells and not meshes: what pixel shows which surfel is known without any search.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
import torch

from ..field.hybrid import HybridField

NEIGHBOURS = 16
COMPONENTS = 16  # principal components of the field's features
FINEST = 1 << 20  # cells along a side: keys of three of them fit 63 bits
POINTS = 8192  # at once
# Of surfels that end where colours do:
AROUND = 8  # cells that a point may join beside its own
UNLIKE = 8.0  # difference of colours, in units of CIE Lab, that counts as much as the distance of two cells
ROUNDS = 2
CHUNK = 65536  # points at once


@dataclass(frozen=True)
class Surfels:
    """N surfels: position (N, 3) in grid coordinates [0, 1]³, normal (N, 3) unit, towards the cameras, in the normalised
    frame; lab (N, 3) mean CIE Lab colour, texture (N,) its standard deviation in lightness; planarity (N, 2) in [0, 1] at
    two scales; field (N, 16) principal components of the field's features, of mean 0; height (N,) in the world; pixels
    (N,) number of pixels of all photos that show it."""

    position: np.ndarray
    normal: np.ndarray
    lab: np.ndarray
    texture: np.ndarray
    planarity: np.ndarray
    field: np.ndarray
    height: np.ndarray
    pixels: np.ndarray

    def __len__(self) -> int:
        return len(self.position)


def cell_of(points: np.ndarray, wanted: int, check: Callable[[], None] = lambda: None) -> tuple[np.ndarray, int]:
    """Number (M,) of the occupied cell of each point (M, 3) in [0, 1]³, and how many there are.

    The cells are nearly the finest of which at most `wanted` are occupied. `check`: called often, may raise to
    stop.
    """
    low, high = 1, 1
    some = points[:: max(1, len(points) // 1_000_000)]  # enough to choose the size by
    while high < FINEST and _occupied(some, high) <= wanted:
        check()
        low, high = high, high * 2
    while high - low > max(1, low // 64):
        check()
        middle = (low + high) // 2
        low, high = (middle, high) if _occupied(some, middle) <= wanted else (low, middle)
    while low > 1 and _occupied(points, low) > wanted:
        check()
        low -= max(1, low // 64)
    _, number = np.unique(_keys(points, low), return_inverse=True)
    return number.reshape(-1), int(number.max(initial=-1)) + 1


def by_colour(
    number: np.ndarray,
    points: np.ndarray,
    lab: np.ndarray,
    neighbours: np.ndarray,
    check: Callable[[], None] = lambda: None,
) -> tuple[np.ndarray, int]:
    """Number (M,) of the surfel of each point (M, 3), and how many there are, from the cell (M,) of each: points join the
    one, of their cell and the cells around it (N, K), that is nearest in place and in colour lab (M, 3), so that surfels end
    where colours do. Cells that lose all their points are gone.

    Achanta et al., "SLIC superpixels compared to state-of-the-art superpixel methods", 2012, on a surface.
    """
    count = len(neighbours)
    for _ in range(ROUNDS):
        place, color = means(number, count, points), means(number, count, lab)
        place[np.bincount(number, minlength=count) == 0] = np.inf
        number = most_alike(number, points, lab, place, color, neighbours, check)
    kept, renumbered = np.unique(number, return_inverse=True)
    return renumbered.reshape(-1), len(kept)


def most_alike(
    nearest: np.ndarray,
    points: np.ndarray,
    lab: np.ndarray,
    position: np.ndarray,
    surfel_lab: np.ndarray,
    neighbours: np.ndarray,
    check: Callable[[], None] = lambda: None,
) -> np.ndarray:
    """Which surfel (M,) each point (M, 3) of colour lab (M, 3) is nearest to in place and colour, of the one (M,) given and
    `AROUND` of its neighbours (N, K). Surfels are at position (N, 3), infinite for none, and have colours (N, 3)."""
    candidates = np.concatenate([np.arange(len(neighbours))[:, None], neighbours[:, :AROUND]], 1)
    there = np.isfinite(position[:, 0]) & np.isfinite(position[neighbours[:, 0], 0])
    spacing = max(float(np.median(np.linalg.norm(position[neighbours[there, 0]] - position[there], axis=1))), 1e-12)
    own, centers = (
        torch.from_numpy(np.concatenate([place / spacing, color / UNLIKE], 1, dtype=np.float32))
        for place, color in ((points, lab), (position, surfel_lab))
    )
    near, found = torch.from_numpy(candidates.astype(np.int32)), []
    for rows, first in zip(own.split(CHUNK), torch.from_numpy(nearest.astype(np.int64)).split(CHUNK)):
        check()
        some = near[first]
        distance = (centers[some] - rows[:, None]).square_().sum(2)
        found.append(some.gather(1, distance.argmin(1, keepdim=True))[:, 0])
    return torch.cat(found).numpy()


def _keys(points: np.ndarray, side: int) -> np.ndarray:
    place = (points * side).astype(np.int64).clip(0, side - 1)
    return (place[:, 0] * side + place[:, 1]) * side + place[:, 2]


def _occupied(points: np.ndarray, side: int) -> int:
    return len(np.unique(_keys(points, side)))


def means(number: np.ndarray, count: int, values: np.ndarray) -> np.ndarray:
    """Mean (count, C) of the values (M, C) with each number (M,); 0 where there are none."""
    amount = np.maximum(np.bincount(number, minlength=count), 1)
    return np.stack([np.bincount(number, column, count) / amount for column in values.T], 1)


def nearest_neighbours(
    position: np.ndarray, count: int = NEIGHBOURS, check: Callable[[], None] = lambda: None
) -> np.ndarray:
    """Indices (N, K) int32 of the nearest other points of each point (N, 3), K at most `count`."""
    count = min(count, len(position) - 1)
    tree, found = scipy.spatial.KDTree(position), []
    for first in range(0, len(position), POINTS):
        check()
        found.append(np.asarray(tree.query(position[first : first + POINTS], k=count + 1)[1])[:, 1:].astype(np.int32))
    return np.concatenate(found)


def shape_at(position: np.ndarray, neighbours: np.ndarray, towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals (N, 3), on the side of `towards` (N, 3), and planarity (N, 2) of points (N, 3) with neighbours (N, K).

    From the eigenvalues a ≥ b ≥ c of the covariance of the neighbours, and of all of theirs: planarity is (b − c) / a
    (Demantké et al., "Dimensionality based scale selection in 3D lidar point clouds", 2011, with variances for deviations).
    """
    first, second = _moments(position, neighbours)
    normal, near = _plane(first, second)
    wide = _plane(first[neighbours].mean(1), second[neighbours].mean(1))[1]
    side = np.where((normal * towards).sum(1, keepdims=True) < 0, -1.0, 1.0)
    return (normal * side).astype(np.float32), np.stack([near, wide], 1).astype(np.float32)


def _moments(position: np.ndarray, neighbours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First (N, 3) and second (N, 3, 3) moments of the neighbours of each point."""
    around = position[neighbours].astype(np.float64)
    return around.mean(1), np.einsum("nki,nkj->nij", around, around) / neighbours.shape[1]


def _plane(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    values, axes = np.linalg.eigh(second - first[:, :, None] * first[:, None, :])
    return axes[:, :, 0], ((values[:, 1] - values[:, 0]) / np.maximum(values[:, 2], 1e-30)).clip(0, 1)


@torch.no_grad()
def field_features(field: HybridField, position: np.ndarray, components: int = COMPONENTS) -> np.ndarray:
    """Principal components (N, components) of the field's features at points (N, 3) of the grid, in units of the
    deviation of the first one: those of the smooth branch, and those the density head hands on."""
    device = field._device.device
    rows = []
    for part in torch.from_numpy(position.astype(np.float32)).split(POINTS):
        geometry = field.geometry(part.to(device))
        parts = [geometry.features] + ([geometry.implicit] if geometry.implicit is not None else [])
        rows.append(torch.cat([p.float() for p in parts], 1).cpu())
    values = torch.cat(rows)
    values = (values - values.mean(0)) / values.std(0).clamp(min=1e-6)
    axes = torch.linalg.eigh(values.T @ values / len(values)).eigenvectors.flip(1)[:, :components]
    found = values @ axes
    return (found / found[:, 0].std().clamp(min=1e-6)).numpy()


def nearest_surfel(position: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The nearest of the positions (N, 3) to each point (M, 3), int32."""
    return np.asarray(scipy.spatial.KDTree(position).query(points)[1]).astype(np.int32)
