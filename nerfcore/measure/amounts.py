"""Areas and volumes of classes and instances, each with the interval that holds the truth in 95 of 100 cases.

    u² = (n · A · u_s / s)² + u_boot² + u_geom² + u_place² (+ u_caps² for volumes)

n is 2 for areas and 3 for volumes, u_s / s the relative uncertainty of the scale, u_boot the spread over photos drawn
anew (see resampling.py), u_geom the difference between the surface at cells of h and of 2h: of noise, which adds area,
and of the cells' size, which takes some, half of the cells shows at least as much as what is left to the truth. u_place
is what the surface and its borders being off by a part of a pixel costs (see placing.py). The interval is the value
± 1.96 u.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ..mesh.facelets import facelets
from ..mesh.triangles import areas
from .closing import Closed, closed

K = 1.96  # normal deviates on either side of 95 %
FAR = 2.0  # coarse cells: what of the coarse surface is farther from the fine one was cleaned away there

FINE = 1.5  # fine cells: longest edge of the pieces of the coarse surface that are labelled


@dataclass(frozen=True)
class Amount:
    """An area or volume with its standard uncertainty, and what this is made of."""

    value: float
    u_scale: float
    u_photos: float
    u_geometry: float
    u_place: float

    @property
    def u(self) -> float:
        return float(np.sqrt(self.u_scale**2 + self.u_photos**2 + self.u_geometry**2 + self.u_place**2))

    @property
    def interval(self) -> tuple[float, float]:
        return max(0.0, self.value - K * self.u), self.value + K * self.u


@dataclass(frozen=True)
class Labelled:
    """Triangles with labels: vertices (V, 3), faces (F, 3), label (F,): number of the class or instance."""

    vertices: np.ndarray
    faces: np.ndarray
    label: np.ndarray

    def areas(self, count: int) -> np.ndarray:
        """Area (count,) of each label."""
        return np.bincount(self.label, areas(self.vertices, self.faces), count)

    def closed(self, number: int, most_capped: float) -> Closed | None:
        return closed(self.vertices, self.faces[self.label == number], most_capped)


def transferred(
    coarse: tuple[np.ndarray, np.ndarray], centers: np.ndarray, labels: list[np.ndarray], voxel: float
) -> list[Labelled]:
    """The coarse surface (vertices, faces) with each of the labels (P,) of the fine one, whose pieces have the centers
    (P, 3): those of the nearest piece. What is farther than `FAR` coarse cells from any is left out.

    Args:
        voxel: side of a fine cell.
    """
    pieces = facelets(*coarse, limit=FINE * voxel)  # as a face may lie on both sides of a border
    found = scipy.spatial.KDTree(centers).query(pieces.centers)
    far, nearest = np.asarray(found[0]), np.asarray(found[1])
    near = far < FAR * 2 * voxel
    return [Labelled(pieces.vertices, pieces.faces[near], label[nearest[near]]) for label in labels]


def area_amounts(
    fine: np.ndarray, coarse: np.ndarray, u_boot: np.ndarray, u_place: np.ndarray, scale: float
) -> list[Amount]:
    """Amounts of areas (N,) at cells of h and of 2h; scale: relative uncertainty of lengths."""
    return [
        Amount(float(a), 2 * float(a) * scale, float(b), abs(float(a) - float(c)), float(p))
        for a, b, c, p in zip(fine, u_boot, coarse, u_place)
    ]


def volume_amount(
    fine: Closed | None, coarse: Closed | None, area: float, voxel: float, u_place: float, scale: float
) -> Amount | None:
    """The volume of a closed part of an area; None where it is open. u_place: of its surface, along the normals.

    Where the coarse surface is not closed, the surface may be off by half a cell everywhere. Its rims are off in their own
    way, and with them the caps.
    """
    if fine is None:
        return None
    geometry = abs(fine.volume - coarse.volume) if coarse is not None else area * voxel / 2
    caps = area * fine.capped / (1 - fine.capped)
    moved = float(np.hypot(area, caps)) * u_place
    return Amount(fine.volume, 3 * fine.volume * scale, 0.0, float(np.hypot(geometry, fine.uneven)), moved)


def summed(volumes: list[Amount | None]) -> Amount | None:
    """The volume of several parts together; None where one of them is open, or there is none. They share the scale and
    the photos, which also say where surfaces lie; noise and cells are each one's own."""
    parts = [volume for volume in volumes if volume is not None]
    if not parts or len(parts) < len(volumes):
        return None
    return Amount(
        sum(p.value for p in parts),
        sum(p.u_scale for p in parts),
        sum(p.u_photos for p in parts),
        float(np.sqrt(sum(p.u_geometry**2 for p in parts))),
        sum(p.u_place for p in parts),
    )
