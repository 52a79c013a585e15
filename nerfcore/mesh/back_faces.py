"""Places of a surface that hide its back: without them, views would look at the inside of things.

Few views know where a surface is in a deep corner, or where it shines, and what they say there was not confirmed. But where a
view looks past such a place at the back of what is known elsewhere, the surface goes on: nothing shows its inside.
"""

from __future__ import annotations

import numpy as np
import torch

from ..kernels.depth_arrays import MapArrays
from ..kernels.raycast import FirstHits, FrontFaces
from ..progress import Reporter
from .triangles import cross, edge_ends, mean_around, unit

FEWEST_VIEWS = 3  # that must look at a back there
GROUP = 3.0  # edges across, of triangles that are asked about together
FACING = 0.2  # cosine of the angle at which a view must see a place, at least
MOSTLY = 2  # rings of faces of which most must hide a back
SAME = 0.999  # of a distance: what is nearer is something else
NOTHING = 1e9  # distance of what a ray meets that meets nothing, see `FirstHits`
SOME = 10_000  # triangles whose edges are measured


def hide_back_faces(
    vertices: np.ndarray, faces: np.ndarray, kept: np.ndarray, maps: MapArrays, report: Reporter
) -> np.ndarray:
    """Which triangles (F,) bool that are not `kept` (F,) bool hide the back of what is: the views of `maps` from which they
    can be seen would mostly meet a back face there, and not a front or nothing."""
    hiding, rows = np.zeros(len(faces), bool), np.flatnonzero(~kept)
    if not len(rows) or not kept.any():
        return hiding
    middle, normals = vertices[faces[rows]].mean(1, dtype=np.float64), unit(cross(vertices, faces[rows]))
    size = GROUP * _edge(vertices, faces[rows])
    key = np.concatenate([np.floor(middle / size).astype(int), normals > 0], 1)
    _, first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)
    backs, others = _what_is_behind(middle[first], normals[first], size, vertices, faces[kept], maps, report)
    hiding[rows] = ((backs >= FEWEST_VIEWS) & (backs > others))[group.reshape(-1)]
    return ~kept & (mean_around(faces, hiding.astype(float), len(vertices), MOSTLY) > 0.5)


def _edge(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Median length of the edges of triangles (F, 3)."""
    ends = edge_ends(faces[:: max(1, len(faces) // SOME)])
    return float(np.median(np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1)))


def _what_is_behind(
    places: np.ndarray,
    normals: np.ndarray,
    size: float,
    vertices: np.ndarray,
    faces: np.ndarray,
    maps: MapArrays,
    report: Reporter,
) -> tuple[np.ndarray, np.ndarray]:
    """How many views that see each of the places (P, 3) with normals (P, 3) look there at a back face (P,), and at a front face
    or at nothing (P,). A view does not see what triangles (F, 3) hide that are nearer by more than `size`."""
    front, any_side = FrontFaces(vertices, faces), FirstHits(vertices, faces)
    backs, others = np.zeros(len(places), int), np.zeros(len(places), int)
    cameras = (
        values.cpu().numpy().astype(np.float64) for values in (maps.rotation, maps.translation, maps.lens, maps.size)
    )
    for turn, shift, (fx, fy, cx, cy), (width, height) in zip(*cameras):
        report.check()
        x, y, z = (places @ turn.T + shift).T
        with np.errstate(all="ignore"):
            column, row = x / z * fx + cx, y / z * fy + cy
        eye = -turn.T @ shift
        away = np.linalg.norm(places - eye, axis=1)
        ray = (places - eye) / away[:, None]
        shown = (z > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
        rows = np.flatnonzero(shown & (-(normals * ray).sum(1) > FACING))
        origins = np.broadcast_to(eye, (len(rows), 3)).astype(np.float32)
        nearest = any_side.distances(torch.from_numpy(origins), torch.from_numpy(ray[rows].astype(np.float32))).numpy()
        seen = nearest > away[rows] - size
        rows, nearest = rows[seen], nearest[seen]
        if not len(rows):
            continue
        met, share = front.cast(origins[seen], ray[rows])
        weights = np.concatenate([share, 1 - share.sum(1, keepdims=True)], 1)
        reached = np.einsum("nk,nkc->nc", weights, vertices[faces[met]])
        facing = np.where(met >= 0, np.linalg.norm(reached - eye, axis=1), np.inf)
        back = nearest < np.minimum(SAME * facing, NOTHING)
        backs[rows[back]] += 1
        others[rows[~back]] += 1
    return backs, others
