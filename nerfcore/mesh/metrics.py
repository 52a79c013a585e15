"""How close a mesh is to the true one: precision, recall, F-score, distances, area."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..kernels.closest import ClosestPoints
from .triangles import areas, cross, unit

SAMPLES = 200_000


@dataclass(frozen=True)
class SurfaceScores:
    """precision, recall, f: shares in [0, 1] within `threshold`; median and p95 of the distance from the mesh to the
    truth; `area_ratio` to the truth's area; `normal_deg`: median angle to the true normals."""

    threshold: float
    precision: float
    recall: float
    f: float
    median: float
    p95: float
    area_ratio: float
    normal_deg: float


def sample_surface(
    vertices: np.ndarray, faces: np.ndarray, count: int = SAMPLES, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) spread evenly over triangles, and the triangle (N,) of each."""
    random = np.random.default_rng(seed)
    area = areas(vertices, faces).cumsum()
    # One point in each of `count` equal shares of the area: less noise than independent draws.
    chosen = np.searchsorted(area, (np.arange(count) + random.random(count)) / count * area[-1])
    chosen = np.minimum(chosen, len(faces) - 1)
    u, v = random.random((2, count, 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    a, b, c = (vertices[faces[chosen, k]] for k in range(3))
    return a + u * (b - a) + v * (c - a), chosen


@dataclass(frozen=True)
class Distances:
    """What lies between a mesh and the true one, sampled evenly by area.

    face (N,) of the mesh and to_truth (N,) from there to the truth, whose nearest point lies in its face truth_face (N,);
    angle (N,) between the two normals, degrees, 0 to 90; true_face (M,) of the visible truth and to_mesh (M,) from there;
    area and true_area: of the mesh, and of the visible truth.
    """

    face: np.ndarray
    to_truth: np.ndarray
    truth_face: np.ndarray
    angle: np.ndarray
    true_face: np.ndarray
    to_mesh: np.ndarray
    area: float
    true_area: float

    def scores(self, threshold: float) -> SurfaceScores:
        precision, recall = float((self.to_truth < threshold).mean()), float((self.to_mesh < threshold).mean())
        return SurfaceScores(
            threshold,
            precision,
            recall,
            2 * precision * recall / max(precision + recall, 1e-9),
            float(np.median(self.to_truth)),
            float(np.quantile(self.to_truth, 0.95)),
            self.area / self.true_area,
            float(np.median(self.angle)),
        )


def distances(
    mesh: tuple[np.ndarray, np.ndarray],
    truth: tuple[np.ndarray, np.ndarray],
    visible: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    count: int = SAMPLES,
    seed: int = 0,
    true: tuple[np.ndarray, np.ndarray, float] | None = None,
) -> Distances:
    """Distances between two meshes (vertices, faces) of one frame, from `count` points of the mesh and twice as many of
    the truth to the closest triangle of the other.

    `visible`: points and normals (N, 3) of the truth → (N,) bool; distances from the truth are those of visible
    points. `true`: points (M, 3) spread over the visible truth, their triangles (M,) and its area, where they are known: of
    a large truth of which little is visible, few of the points would be.
    """
    points, face = sample_surface(*mesh, count=count, seed=seed)
    normals = unit(cross(*truth))
    if true is None:
        place, true_face = sample_surface(*truth, count=2 * count, seed=seed + 1)
        shown = np.ones(len(place), bool) if visible is None else visible(place, normals[true_face])
        true = place[shown], true_face[shown], float(areas(*truth).sum() * shown.mean())
    truth_face, _, to_truth = ClosestPoints(*truth).find(points)
    to_mesh = ClosestPoints(*mesh).find(true[0])[2]
    cosine = np.abs((unit(cross(*mesh))[face] * normals[truth_face]).sum(1))
    return Distances(
        face,
        to_truth,
        truth_face,
        np.degrees(np.arccos(np.clip(cosine, 0, 1))),
        true[1],
        to_mesh,
        float(areas(*mesh).sum()),
        true[2],
    )


def compare(
    mesh: tuple[np.ndarray, np.ndarray],
    truth: tuple[np.ndarray, np.ndarray],
    threshold: float,
    visible: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> SurfaceScores:
    """Scores of a mesh beside the true one; see `distances`."""
    return distances(mesh, truth, visible).scores(threshold)
