"""Similarity transforms (4×4: scale · rotation, translation) between the SfM frame, the world and the box."""

from __future__ import annotations

import numpy as np


def similarity_scale(matrix: np.ndarray) -> float:
    """Uniform scale factor of a similarity (4, 4)."""
    return float(np.cbrt(np.linalg.det(matrix[:3, :3])))


def transform_points(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Apply a 4×4 matrix to points (..., 3)."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def make_similarity(scale: float, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """The 4×4 matrix x ↦ scale · rotation · x + translation."""
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation
    matrix[:3, 3] = translation
    return matrix


def fit_similarity(source: np.ndarray, target: np.ndarray, with_scale: bool = True) -> np.ndarray:
    """Least-squares similarity (4, 4) that maps source (N, 3) onto target (N, 3).

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
    """
    mean_source, mean_target = source.mean(0), target.mean(0)
    a, b = source - mean_source, target - mean_target
    u, singular, vt = np.linalg.svd(b.T @ a / len(a))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    rotation = u @ sign @ vt
    scale = float((singular * np.diag(sign)).sum() / max((a**2).sum() / len(a), 1e-30)) if with_scale else 1.0
    return make_similarity(scale, rotation, mean_target - scale * rotation @ mean_source)


def transform_pose(similarity: np.ndarray, camera_to_world: np.ndarray) -> np.ndarray:
    """Move a pose (4, 4) by a similarity (4, 4); its rotation stays a rotation, only its centre is scaled."""
    moved = similarity @ camera_to_world
    moved[:3, :3] /= similarity_scale(similarity)
    return moved
