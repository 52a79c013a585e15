"""Camera paths around a place. Poses are camera-to-world 4×4 with OpenGL axes (x right, y up, looking along −z)."""

from __future__ import annotations

import math

import numpy as np

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


def look_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Camera-to-world (4, 4) at `position` (3,) that looks at `target` (3,), its x axis level with the ground."""
    back = np.asarray(position, float) - target
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    if np.linalg.norm(right) < 1e-12:  # straight up or down: any level axis will do
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = right, np.cross(back, right), back, position
    return matrix


def _counts(views: int, levels: list[tuple[float, float, float]]) -> np.ndarray:
    """Number of views on each level; the first one takes what rounding leaves over."""
    counts = np.floor(np.array([share for share, _, _ in levels]) * views).astype(int)
    counts[0] += views - counts.sum()
    return counts


def rings(views: int, levels: list[tuple[float, float, float]], target: np.ndarray, seed: int) -> list[np.ndarray]:
    """A walk around `target` on several rings, as a photographer does it, by hand and so not quite even.

    Args:
        views: number of poses.
        levels: (share of the views, distance from the target in metres, elevation in degrees) per ring.
        target: (3,) point to look at.
        seed: of the unevenness.
    """
    random = np.random.default_rng(seed)
    poses = []
    for ring, (count, (_, distance, elevation)) in enumerate(zip(_counts(views, levels), levels)):
        for index in range(count):
            angle = 2 * math.pi * (index + 0.37 * ring) / count + random.normal(0, 0.02)
            height = math.radians(elevation + random.normal(0, 1.5))
            direction = [math.cos(height) * math.cos(angle), math.cos(height) * math.sin(angle), math.sin(height)]
            aim = target + random.normal(0, 0.035, 3)
            poses.append(look_at(target + np.array(direction) * distance * random.normal(1, 0.015), aim))
    return poses


def arc(
    views: int,
    levels: list[tuple[float, float, float]],
    target: np.ndarray,
    spread: float,
    wander: tuple[float, float, float],
    seed: int,
) -> list[np.ndarray]:
    """A walk to and fro before a facade that faces −y, by hand and so not quite even.

    Args:
        views: number of poses.
        levels: (share of the views, distance from the target over the ground, height of the camera), metres, per walk.
        target: (3,) point to look at.
        spread: angle of the arc in degrees.
        wander: standard deviation of the place looked at from one photo to the next, metres.
        seed: of the unevenness.
    """
    random = np.random.default_rng(seed)
    poses = []
    for level, (count, (_, distance, height)) in enumerate(zip(_counts(views, levels), levels)):
        start = 0.5 * (level % 2)  # every second walk stands between the places of the one before
        for index in range(count):
            share = (index + start) / max(count - 1 + 2 * start, 1)
            angle = math.radians(spread * (share - 0.5) + random.normal(0, 1.5))
            reach = distance * random.normal(1, 0.03)
            place = [math.sin(angle) * reach, -math.cos(angle) * reach]
            position = np.array([target[0] + place[0], target[1] + place[1], height * random.normal(1, 0.03)])
            poses.append(look_at(position, target + random.normal(0, wander)))
    return poses


def sphere(views: int, center: np.ndarray, radius: float, hemisphere: bool = False) -> list[np.ndarray]:
    """Evenly spread poses on a sphere (or its upper half) around `center`, looking inwards (golden spiral)."""
    poses = []
    for index in range(views):
        share = (index + 0.5) / views
        z = 0.02 + 0.96 * share if hemisphere else 0.98 * (1 - 2 * share)
        ring = math.sqrt(1 - z * z)
        angle = index * GOLDEN_ANGLE
        direction = np.array([ring * math.cos(angle), ring * math.sin(angle), z])
        poses.append(look_at(center + radius * direction, center))
    return poses
