"""What a fused surface keeps: faces that views see, parts that are not scraps, small holes filled."""

from __future__ import annotations

import numpy as np
import torch

from ..kernels.depth_arrays import MapArrays
from ..kernels.surface import sight, slopes
from ..progress import Reporter
from .back_faces import hide_back_faces
from .holes import fill_holes
from .triangles import areas, compact, components, cross, mean_around, unit

FEWEST_VIEWS = 2
TURNED = np.radians(35)  # by which a face may be steeper or flatter than what a view shows there
MOSTLY = 4  # rings of faces of which most must be seen: single ones are missed by noise, and each would be a hole
AROUND = 6  # rings of faces over which views are averaged: single faces have noisy normals
SCRAP = 1e-3  # of the area
CHUNK = 1 << 16


def seen_by(points: np.ndarray, normals: np.ndarray, maps: MapArrays, tolerance: float, report: Reporter) -> np.ndarray:
    """How many of the maps see each of the points (N, 3) with normals (N, 3)."""
    device, counts = maps.depth.device, []
    where, facing = (torch.from_numpy(np.asarray(a, np.float32)) for a in (points, normals))
    for p, n in zip(where.split(CHUNK), facing.split(CHUNK)):
        report.check()
        counts.append((sight(p.to(device), n.to(device), maps, tolerance) > 0).sum(1).cpu().numpy())
    return np.concatenate(counts) if counts else np.zeros(0, int)


def clean(
    vertices: np.ndarray, faces: np.ndarray, maps: MapArrays, tolerance: float | np.ndarray, report: Reporter
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, triangles, and which triangles (F,) bool fill a hole: without faces that views do not show (`shown`), but for
    those that hide back faces (back_faces.py), and parts below a thousandth of the area; small holes filled (holes.py).
    `tolerance`: of all faces, or (F,) of each."""
    kept = shown(vertices, faces, maps, tolerance, report)
    hiding = hide_back_faces(vertices, faces, kept, maps, report)
    rows = np.flatnonzero(kept | hiding)
    rows = rows[not_scraps(vertices, faces[rows])]
    report.check()
    vertices, faces, filled = fill_holes(vertices, faces[rows], check=report.check)
    filled[: len(rows)] = hiding[rows]
    vertices, faces = compact(vertices, faces)
    return vertices, faces, filled


def shown(
    vertices: np.ndarray, faces: np.ndarray, maps: MapArrays, tolerance: float | np.ndarray, report: Reporter
) -> np.ndarray:
    """Which triangles (F,) bool stay: at least two views see most of those around, less what spans outlines: where a view shows
    something of another slope, and fewer than two show something as steep as the triangle. Between the edge of a thing and the
    wall behind it there is nothing, but distances fused from both have a surface there, in thin strands beside the thing. A view
    whose slope there is not certain, as neither photos confirm its depth nor is the field sharp, contradicts nothing.
    `tolerance`: distance from what a view shows up to which it sees a triangle, of all or (F,) of each."""
    middle, normals = vertices[faces].mean(1), unit(cross(vertices, faces))
    each = np.broadcast_to(tolerance, len(faces))
    seen, counts = np.zeros(len(faces), bool), np.zeros((len(faces), 2))
    for near in np.unique(each):
        some = np.flatnonzero(each == near)
        seen[some] = seen_by(middle[some], normals[some], maps, near, report) >= FEWEST_VIEWS
        counts[some] = slopes_around(middle[some], normals[some], maps, near, report)
    own, other = (mean_around(faces, count, len(vertices), AROUND) for count in counts.T)
    seen = mean_around(faces, seen.astype(float), len(vertices), MOSTLY) > 0.5
    return seen & ~((own < FEWEST_VIEWS) & (other >= 1))


def slopes_around(
    points: np.ndarray, normals: np.ndarray, maps: MapArrays, tolerance: float, report: Reporter
) -> np.ndarray:
    """How many maps (N, 2) show something as steep as each of the points (N, 3) with normals (N, 3), and of another slope."""
    device, counts = maps.depth.device, [np.zeros((0, 2))]
    for p, n in zip(*(torch.from_numpy(np.asarray(a, np.float32)).split(CHUNK) for a in (points, normals))):
        report.check()
        counts.append(slopes(p.to(device), n.to(device), maps, tolerance, TURNED).cpu().numpy())
    return np.concatenate(counts)


def drop_scraps(vertices: np.ndarray, faces: np.ndarray, share: float = SCRAP) -> np.ndarray:
    """The triangles (F, 3) of connected parts that have at least `share` of the area."""
    return faces[not_scraps(vertices, faces, share)]


def not_scraps(vertices: np.ndarray, faces: np.ndarray, share: float = SCRAP) -> np.ndarray:
    """Which triangles (F,) bool are of connected parts that have at least `share` of the area."""
    if not len(faces):
        return np.zeros(0, bool)
    part = components(faces, len(vertices))
    area = np.bincount(part, areas(vertices, faces))
    return area[part] >= share * area.sum()
