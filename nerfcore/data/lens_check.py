"""Lenses that cannot be: no camera has them, and rays through them would lead training astray."""

from __future__ import annotations

import numpy as np

from ..geometry.cameras import Camera, rays

# Far beyond what lenses do, so that only mistakes are met. Focal lengths relative to the longer side of the picture:
# 0.02 is a view of 175°, 1000 one of 3″.
SHORTEST, LONGEST = 0.02, 1000.0
FARTHEST = 10.0  # sides of the picture from its middle to the principal point: cuttings have it outside
BEND = 8.0  # most that distortion may move a direction, as a factor of the angle to the axis
VALID = 0.5  # share of the picture whose directions can be told


def lens_problem(camera: Camera) -> str | None:
    """What is impossible about a lens, as a clause; None for one that may exist."""
    numbers = np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])
    if not np.isfinite(numbers).all():
        return "its lens has values that are no finite numbers"
    size = np.array([camera.width, camera.height], np.float64)
    for focal in (camera.fx, camera.fy):
        if not SHORTEST <= focal / size.max() <= LONGEST:
            return f"its focal length of {focal:g} pixels is impossible for {camera.width}×{camera.height} pixels"
    middle = np.array([camera.cx, camera.cy])
    if (np.abs(middle / size - 0.5) > FARTHEST).any():
        return f"its principal point ({camera.cx:g}, {camera.cy:g}) is far outside the picture"
    return _distortion_problem(camera) if any(camera.distortion) else None


def _distortion_problem(camera: Camera) -> str | None:
    x, y = np.meshgrid(np.linspace(0.5, camera.width - 0.5, 24), np.linspace(0.5, camera.height - 0.5, 24))
    places = np.stack([x.ravel(), y.ravel()], 1)
    directions, valid = rays(camera, places)
    if valid.mean() < VALID:
        return f"its distortion leaves {1 - valid.mean():.0%} of the picture without a direction"
    radius = np.linalg.norm((places - [camera.cx, camera.cy]) / [camera.fx, camera.fy], axis=1)
    angle = np.arccos(np.clip(directions[:, 2], -1, 1))
    away = valid & (radius > 1e-3)
    bend = angle[away] / np.arctan(radius[away])
    if len(bend) and (bend.max() > BEND or bend.min() < 1 / BEND):
        factor = bend.max() if bend.max() > BEND else 1 / bend.min()
        return f"its distortion bends directions by a factor of {factor:.0f}"
    return None
