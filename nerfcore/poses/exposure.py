"""Whether photos were exposed or balanced differently, from what they show of the sparse points.

A phone that measures the light anew for each photo, or a flash that comes nearer: the same place is brighter in one photo
than in the next, which a field that has one colour for a place and direction explains with haze before cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy

from ..geometry.cameras import project
from ..geometry.points import Points
from ..images.exposure import common_gains
from ..images.working import read_picture
from ..progress import Reporter
from ..project.schema import Poses

PATCH = 7  # pixels whose mean is a point's colour
MOST_VIEWS, MOST_POINTS = 12, 60_000  # that are asked: photos of each point, and points
DARKEST, BRIGHTEST = 8, 243  # of 255: beyond, a photo no longer tells how bright a place is
SPREAD = 0.03  # of the logarithms of factors, from which they are more than noise
BETTER = 0.9  # of the differences between photos that may be left


def exposure_gains(
    poses: Poses, points: Points, visibility: tuple[np.ndarray, np.ndarray], photos: Sequence[Path], report: Reporter
) -> np.ndarray | None:
    """What the colours of each posed photo must be multiplied with, (photos, 3) float32, to have a common exposure and white
    balance; None where photos agree well enough.

    Args:
        visibility: which photo saw which point, two int arrays (M,). photos: the files of `poses.images`.
    Raises:
        InputError: a photo cannot be read. What `report` raises to stop.
    """
    view, color = _colors(poses, points, visibility, photos, report)
    use = (color.min(2) >= DARKEST) & (color.max(2) <= BRIGHTEST)
    shared = use.sum(1) >= 2
    if not shared.any():
        return None
    view, color, use = view[shared], color[shared], use[shared]
    gains = common_gains(view, np.maximum(color, 1.0), use, len(photos))
    before, after = _differences(color, use), _differences(color * gains[view], use)
    if np.log(gains).std(0).mean() < SPREAD or after > BETTER * before:
        return None
    return gains


def _colors(
    poses: Poses, points: Points, visibility: tuple[np.ndarray, np.ndarray], photos: Sequence[Path], report: Reporter
) -> tuple[np.ndarray, np.ndarray]:
    """For N points the photos (N, K) that see them and the colours (N, K, 3) float32 they show, 0 where there are fewer."""
    random = np.random.default_rng(0)
    order = random.permutation(len(visibility[0]))
    view, point = visibility[0][order], visibility[1][order]
    chosen = random.permutation(len(points.xyz))[:MOST_POINTS]
    row = np.full(len(points.xyz), -1)
    row[chosen] = np.arange(len(chosen))
    # Number the photos of each point: as many as there are columns count.
    by_point = np.argsort(point, kind="stable")
    first = np.searchsorted(point[by_point], point[by_point], side="left")
    column = np.empty(len(point), np.int64)
    column[by_point] = np.arange(len(point)) - first
    index = np.zeros((len(chosen), MOST_VIEWS), np.int64)
    color = np.zeros((len(chosen), MOST_VIEWS, 3), np.float32)
    for number, photo in enumerate(photos):
        report.progress(number / len(photos), photo.name)
        asked = np.flatnonzero((view == number) & (row[point] >= 0) & (column < MOST_VIEWS))
        if not len(asked):
            continue
        posed = poses.images[number]
        to_camera = np.linalg.inv(np.array(posed.camera_to_world))
        local = points.xyz[point[asked]] @ to_camera[:3, :3].T + to_camera[:3, 3]
        place = project(poses.cameras[posed.camera], local)
        picture = read_picture(photo).pixels[..., :3]
        height, width = picture.shape[:2]
        inside = np.isfinite(place).all(1) & (place >= 0).all(1) & (place < [width, height]).all(1)
        asked, place = asked[inside], place[inside].astype(int)
        smooth = scipy.ndimage.uniform_filter(picture.astype(np.float32), (PATCH, PATCH, 0))
        index[row[point[asked]], column[asked]] = number
        color[row[point[asked]], column[asked]] = smooth[place[:, 1], place[:, 0]]
    return index, color


def _differences(color: np.ndarray, use: np.ndarray) -> float:
    """Median difference of the logarithms of what photos show of a place from their mean."""
    log = np.where(use[..., None], np.log(np.maximum(color, 1.0)), 0)
    mean = log.sum(1, keepdims=True) / use.sum(1)[:, None, None]
    return float(np.median(np.abs(log - mean)[use]))
