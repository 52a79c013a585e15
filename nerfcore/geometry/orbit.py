"""Directions to look from, around a subject."""

from __future__ import annotations

import numpy as np

OPEN_ANGLE = np.pi / 2  # around the subject without anything to look from: from there on an orbit is an arc


def orbit_angles(wanted: np.ndarray, count: int) -> np.ndarray:
    """Angles (count,) about the z axis, evenly around it, or evenly over the arc beside the widest gap between those
    `wanted` (N,), in radians, if that leaves much of the circle open."""
    taken = np.sort((wanted + np.pi) % (2 * np.pi) - np.pi)
    gaps = np.diff(taken, append=taken[0] + 2 * np.pi)
    widest = int(gaps.argmax())
    if gaps[widest] < OPEN_ANGLE:
        return 2 * np.pi * np.arange(count) / count
    return taken[widest] + gaps[widest] + (2 * np.pi - gaps[widest]) * (np.arange(count) + 0.5) / count
