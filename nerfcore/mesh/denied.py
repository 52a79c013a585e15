"""Parts of a surface that photos deny: what lies on them looks otherwise in each photo.

What cameras see far away, a meadow at the horizon, comes out near them in some fields, as scraps in the air that every
view of the field shows. Photos tell: their grey values on a true part go up and down together from place to place. What
is lighter towards one side says little, as much of the world is lighter towards the horizon.
Measured: docs/experiments.md, “Scraps that photos deny”, “Plain scraps”.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from ..data.photo import photo_of
from ..data.pixels import training_size
from ..data.scene import View
from ..geometry.cameras import project
from ..images.picture import resized
from ..kernels.raycast import FrontFaces
from ..progress import Reporter
from .triangles import areas, components, cross, unit

SAMPLES = 300  # places on a part, drawn by area
AGREE = 0.18  # correlation of two photos' grey values there, less an even slope, below which they disagree
PLAIN = 1.0  # of 255: standard deviation of grey values on a part up to which photos tell nothing: noise
# Not tuned.
MOST_PHOTOS = 12  # that are asked about a part, evenly spread over those that see it
COMMON = 60  # places that two photos must both see
PAIRS = 3  # of photos that must
FACING = 0.1  # cosine of the angle at which a photo must see a place, at least
SIDE = 1024  # longest side of the photos, in pixels
NEAR = 0.02  # of the distance: what a ray meets so close to a place is the place


def denied(vertices: np.ndarray, faces: np.ndarray, views: Sequence[View], report: Reporter) -> np.ndarray:
    """Triangles (F,) bool of connected parts, but the largest, on which photos differ more than they agree.

    Args:
        vertices: (V, 3) in the world frame, faces (F, 3). views: photos the surface comes from.
    Raises:
        InputError: a photo cannot be read. What `report` raises to stop.
    """
    part = components(faces, len(vertices))
    area = areas(vertices, faces)
    others = np.setdiff1d(np.unique(part), [np.bincount(part, area).argmax()]) if len(faces) else np.zeros(0, int)
    if not len(others):
        return np.zeros(len(faces), bool)
    rng = np.random.default_rng(0)
    chosen = []
    for one in others:
        own = np.flatnonzero(part == one)
        chosen.append(rng.choice(own, SAMPLES, p=area[own] / area[own].sum()))
    picked = np.concatenate(chosen)
    middles = vertices[faces].mean(1, dtype=np.float64)
    grey = _grey_values(vertices, faces, middles, picked, views, report).reshape(len(views), len(others), SAMPLES)
    places = middles[picked].reshape(len(others), SAMPLES, 3)
    bad = [one for number, one in enumerate(others) if disagree(grey[:, number], places[number])]
    return np.isin(part, bad)


def disagree(grey: np.ndarray, places: np.ndarray) -> bool:
    """Whether photos disagree on a part whose places (S, 3) have these grey values (N, S) in [0, 255] in them, NaN where a
    photo does not show a place. Not where too few photos share places, or these are plain."""
    agreement, spread = [], []
    for i, first in enumerate(grey):
        for second in grey[:i]:
            both = np.isfinite(first) & np.isfinite(second)
            if both.sum() < COMMON:
                continue
            pair = np.stack([first[both], second[both]], 1).astype(np.float64)
            spread.append(pair.std(0).min())
            a, b = _uneven(pair, places[both]).T
            agreement.append((a * b).sum() / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-9))
    return len(agreement) >= PAIRS and bool(np.median(spread) > PLAIN and np.median(agreement) < AGREE)


def _uneven(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Values (S, K) at places (S, 3) less their mean and what grows evenly along some direction."""
    even = np.concatenate([places - places.mean(0), np.ones((len(places), 1))], 1)
    return values - even @ np.linalg.lstsq(even, values, rcond=None)[0]


def _grey_values(
    vertices: np.ndarray,
    faces: np.ndarray,
    middles: np.ndarray,
    picked: np.ndarray,
    views: Sequence[View],
    report: Reporter,
) -> np.ndarray:
    """Grey values (N, P) in [0, 255] of the `middles` (F, 3) of triangles `picked` (P,), `SAMPLES` of each part, in the photos; NaN
    where a photo does not show it, or is not asked."""
    middle, normals = middles[picked], unit(cross(vertices, faces[picked]))
    front = FrontFaces(vertices, faces)
    seen = np.zeros((len(views), len(picked)), bool)
    for number, view in enumerate(views):
        report.check()
        pose = view.camera_to_world
        toward = middle - pose[:3, 3]
        away = np.linalg.norm(toward, axis=1)
        with np.errstate(all="ignore"):
            place = project(view.camera, toward @ pose[:3, :3])
            inside = ((place >= 0) & (place < [view.camera.width, view.camera.height])).all(1)
        inside &= -(normals * toward).sum(1) > FACING * away
        if view.camera.model != "EQUIRECTANGULAR":
            inside &= toward @ pose[:3, 2] > 0
        rows = np.flatnonzero(inside)
        if len(rows):
            origins = np.broadcast_to(pose[:3, 3], (len(rows), 3))
            met, _ = front.cast(origins, toward[rows] / away[rows, None])
            apart = np.linalg.norm(middles[met] - middle[rows], axis=1)
            rows = rows[(met >= 0) & (apart < NEAR * away[rows])]
        seen[number, rows] = True
    asked = seen.reshape(len(views), -1, SAMPLES)
    for part in range(asked.shape[1]):
        enough = np.flatnonzero(asked[:, part].sum(1) >= COMMON)
        kept = enough[np.unique(np.linspace(0, len(enough) - 1, MOST_PHOTOS).astype(int))] if len(enough) else enough
        asked[np.setdiff1d(np.arange(len(views)), kept), part] = False
    grey = np.full(seen.shape, np.nan, np.float32)
    for number, view in enumerate(views):
        report.check()
        rows = np.flatnonzero(seen[number])
        if not len(rows):
            continue
        width, height = training_size(view.camera, SIDE)
        picture = resized(photo_of(view), width, height).pixels[..., :3].mean(2, dtype=np.float32)
        place = project(view.camera, (middle[rows] - view.camera_to_world[:3, 3]) @ view.camera_to_world[:3, :3])
        place = place * [width / view.camera.width, height / view.camera.height] - 0.5
        smooth = scipy.ndimage.gaussian_filter(picture, 1.0)
        grey[number, rows] = scipy.ndimage.map_coordinates(smooth, place[:, ::-1].T, order=1, mode="nearest")
    return grey
