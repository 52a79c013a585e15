"""Do estimated poses agree with the matches they came from? Runs in the pose process."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .features import database

# Measured: docs/experiments.md, “What the pose stage was made of”. The number of points is not tuned.
GOOD_AGREEMENT = 0.5
MIN_POINTS = 20  # that a photo sees
MIN_MATCHES = 15  # of a pair, from which it counts, and
TOLERANCE_PX = 4.0  # by which a match may miss: both as in COLMAP's two-view geometry
MATCHES_PER_PAIR = 300  # that are looked at, for the sake of time
# Of the matches that the best agreeing pairs of its two photos have, as geometric mean: what a pair must have to
# contradict their poses.
# Measured: docs/experiments.md, “Pairs that contradict poses, beside the best of both photos”
STRONG = 0.3


@dataclass
class ImageCheck:
    """What speaks for the pose of one image.

    `agreement`: share of its verified matches within 4 px of the epipolar lines (None without matches to judge by);
    `points`: 3D points it sees; `error_px`: their mean reprojection error; `mates`: registered images it matches;
    `contradicting`: those of them with which it has many matches, most of them farther than that from the lines.
    """

    agreement: float | None
    points: int
    error_px: float
    mates: int
    contradicting: int

    @property
    def bad(self) -> bool:
        return self.points < MIN_POINTS or (self.agreement is not None and self.agreement < GOOD_AGREEMENT)


def check_images(reconstruction: Any, path: Path) -> tuple[dict[int, ImageCheck], dict[tuple[int, int], int]]:
    """Check every registered image against all verified matches in the database.

    Returns:
        checks by image id, and the number of inlier matches of each verified pair of registered images.
    """
    registered = set(reconstruction.reg_image_ids())
    good = dict.fromkeys(registered, 0.0)
    total = dict.fromkeys(registered, 0.0)
    mates = dict.fromkeys(registered, 0)
    contradicting = dict.fromkeys(registered, 0)
    links: dict[tuple[int, int], int] = {}
    pairs = list(pair_agreements(reconstruction, path))
    for image in itertools.chain(*contradicting_pairs(pairs)):
        contradicting[image] += 1
    for a, b, share, count in pairs:
        links[a, b] = count
        for image in (a, b):
            good[image] += share * count
            total[image] += count
            mates[image] += 1
    checks = {}
    for i in registered:
        observed = [point.point3D_id for point in reconstruction.image(i).get_observation_points2D()]
        errors = [reconstruction.point3D(point).error for point in observed]
        checks[i] = ImageCheck(
            agreement=good[i] / total[i] if total[i] else None,
            points=len(observed),
            error_px=float(np.mean(errors)) if errors else 0.0,
            mates=mates[i],
            contradicting=contradicting[i],
        )
    return checks, links


def pair_agreements(reconstruction: Any, path: Path) -> Iterator[tuple[int, int, float, int]]:
    """Of every verified pair of registered images: their ids, the share of its matches within 4 px of the epipolar
    lines, and the number of its matches."""
    registered = set(reconstruction.reg_image_ids())
    with database(path) as db:
        pair_ids, geometries = db.read_two_view_geometries()
        keypoints = {i: np.asarray(db.read_keypoints(i))[:, :2] for i in registered}
    images = {i: reconstruction.image(i) for i in registered}
    normalised = {i: _normalised(images[i].camera, keypoints[i]) for i in registered}
    focal = {i: images[i].camera.mean_focal_length() for i in registered}
    poses = {i: images[i].cam_from_world().matrix() for i in registered}
    for pair_id, geometry in zip(pair_ids, geometries):
        a, b = pair_images(pair_id)
        matches = np.asarray(geometry.inlier_matches)
        if a not in registered or b not in registered or len(matches) < MIN_MATCHES:
            continue
        if len(matches) > MATCHES_PER_PAIR:
            picked = matches[np.linspace(0, len(matches) - 1, MATCHES_PER_PAIR).astype(int)]
        else:
            picked = matches
        distance = sampson_distance(poses[a], poses[b], normalised[a][picked[:, 0]], normalised[b][picked[:, 1]])
        yield a, b, float((distance * (focal[a] + focal[b]) / 2 <= TOLERANCE_PX).mean()), len(matches)


def contradicting_pairs(pairs: list[tuple[int, int, float, int]]) -> list[tuple[int, int]]:
    """Those of the verified pairs (`pair_agreements`) that contradict their poses: photos that match as if they stood side
    by side, and stand and look elsewhere. A few matches of things that are alike, two roofs, say nothing."""
    most = {image: 0 for a, b, *_ in pairs for image in (a, b)}
    for a, b, share, count in pairs:
        if share >= GOOD_AGREEMENT:
            most[a], most[b] = max(most[a], count), max(most[b], count)
    return [
        (a, b)
        for a, b, share, count in pairs
        if share < GOOD_AGREEMENT and count >= STRONG * math.sqrt(most[a] * most[b])
    ]


def pair_images(pair_id: int) -> tuple[int, int]:
    """The two image ids of COLMAP's pair id."""
    return pair_id // 2147483647, pair_id % 2147483647


def _normalised(camera: Any, keypoints: np.ndarray) -> np.ndarray:
    """Undistorted normalised coordinates (N, 2); NaN where the lens cannot be inverted."""
    if len(keypoints) == 0:
        return np.zeros((0, 2))
    return np.asarray(camera.cam_from_img(keypoints.astype(np.float64)), np.float64).reshape(-1, 2)


def sampson_distance(pose_a: np.ndarray, pose_b: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance (N,) of matches from their epipolar geometry, to first order, in normalised units.

    Args:
        pose_a, pose_b: camera-from-world (3, 4).
        a, b: undistorted normalised coordinates (N, 2). NaN gives infinity.
    Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed., eq. 11.9.
    """
    rotation = pose_b[:, :3] @ pose_a[:, :3].T
    translation = pose_b[:, 3] - rotation @ pose_a[:, 3]
    x, y, z = translation[0], translation[1], translation[2]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    first = np.concatenate([a, np.ones((len(a), 1))], 1)
    second = np.concatenate([b, np.ones((len(b), 1))], 1)
    lines_b, lines_a = first @ essential.T, second @ essential
    residual = (second * lines_b).sum(1)
    weight = (lines_b[:, :2] ** 2).sum(1) + (lines_a[:, :2] ** 2).sum(1)
    distance = np.abs(residual) / np.sqrt(np.maximum(weight, 1e-30))
    return np.where(np.isfinite(distance), distance, np.inf)
