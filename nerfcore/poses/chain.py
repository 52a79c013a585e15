"""Repeated things in a video, told apart by the way the camera went. Runs in the pose process.

A label that is on a can twice makes frames from opposite sides match, and a mapper that believes them folds the walk
around the can into half of it. Frames that follow each other show the same side: cameras are placed by their matches
alone, and matches between far frames that would turn a camera elsewhere are taken out before all are placed together.
"""

from __future__ import annotations

import copy
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from ..files import write_json
from . import features, mapping
from .resume import mapping_folder
from .validate import MIN_MATCHES, pair_images

COUNTS = "contradicting.json"  # of pairs, by database
# With these figures: docs/experiments.md, “Frames whose alike sides match”.
NEIGHBOURS = 5  # frames to either side whose matches are believed
MOST_TURN = 30.0  # degrees: chains drift less over a walk, and repeated things are usually two- to sixfold


@dataclass(frozen=True)
class Chain:
    """Frames placed by their neighbours: camera-from-world rotations and lenses by name, one dict for each connected
    stretch of the video."""

    rotations: list[dict[str, np.ndarray]]
    cameras: dict[str, Any]


def follow(path: Path, image_folder: Path, work: Path, names: list[str], tell: Any) -> Chain:
    """Place the frames of a video by the matches of near frames in the database `path`; it stays as it is.

    The outcome is kept in `work` and read from there when it was found before.
    """
    folder = work / "chain"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    near = features.copy_database(path, folder / f"near_{path.name}")
    with features.database(near) as db:
        place = _places(db, names)
        db.clear_descriptors()
        for a, b in (pair_images(pair_id) for pair_id in db.read_two_view_geometries()[0]):
            if a not in place or b not in place or abs(place[a] - place[b]) > NEIGHBOURS:
                db.delete_two_view_geometry(a, b)
    memory = mapping_folder(work, near, False, False, names)
    models = mapping.build(near, image_folder, folder / "models", False, names, tell, memory=memory)
    shutil.rmtree(folder)
    rotations, cameras = [], {}
    for model in models:
        images = [model.image(i) for i in model.reg_image_ids()]
        # A frame in two models stands in the larger one, which comes first.
        fresh = [image for image in images if image.name not in cameras]
        rotations.append({image.name: image.cam_from_world().rotation.matrix() for image in fresh})
        cameras |= {image.name: copy.copy(image.camera) for image in fresh}  # theirs die with the model
    return Chain(rotations, cameras)


def tell_apart(path: Path, image_folder: Path, work: Path, names: list[str], tell: Any) -> int:
    """Take the matches out of the database of a video that contradict the way the camera went.

    Returns:
        of how many pairs, those of earlier runs on the same database included.
    """
    count = reject_contradicting(path, follow(path, image_folder, work, names, tell), names)
    known = work / COUNTS
    try:
        counts = json.loads(known.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        counts = {}
    counts[path.name] = counts.get(path.name, 0) + count
    write_json(known, counts)
    return counts[path.name]


def reject_contradicting(path: Path, chain: Chain, names: list[str]) -> int:
    """Take the matches out of the database that contradict a chain; returns of how many pairs.

    The pairs stay in the database without matches, so that they are not matched again.
    """
    rejected = []
    with features.database(path) as db:
        place = _places(db, names)
        name_of = {image.image_id: image.name for image in db.read_all_images()}
        keypoints: dict[int, np.ndarray] = {}
        for pair_id, geometry in zip(*db.read_two_view_geometries()):
            pair = pair_images(pair_id)
            if len(geometry.inlier_matches) < MIN_MATCHES or not all(i in place for i in pair):
                continue
            if abs(place[pair[0]] - place[pair[1]]) <= NEIGHBOURS:
                continue
            a, b = (name_of[i] for i in pair)
            stretch = next((rotations for rotations in chain.rotations if a in rotations and b in rotations), None)
            if stretch is None:
                continue
            for i in pair:
                if i not in keypoints:
                    keypoints[i] = np.asarray(db.read_keypoints(i), np.float64)[:, :2]
            turn = relative_rotation(
                (chain.cameras[a], keypoints[pair[0]]), (chain.cameras[b], keypoints[pair[1]]), geometry.inlier_matches
            )
            if turn is not None and angle_between(turn, stretch[b] @ stretch[a].T) > MOST_TURN:
                rejected.append(pair)
        for a, b in rejected:
            empty = pycolmap.TwoViewGeometry()
            empty.config = pycolmap.TwoViewGeometryConfiguration.DEGENERATE
            db.delete_two_view_geometry(a, b)
            db.write_two_view_geometry(a, b, empty)
    return len(rejected)


def relative_rotation(first: tuple[Any, np.ndarray], second: tuple[Any, np.ndarray], matches: Any) -> np.ndarray | None:
    """Rotation (3, 3) from the first camera's axes to the second's by matches between their keypoints, if any fits."""
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    options.ransac.random_seed = mapping.SEED
    geometry = pycolmap.estimate_calibrated_two_view_geometry(*first, *second, np.asarray(matches), options)
    pose = geometry.cam2_from_cam1
    return None if pose is None or len(geometry.inlier_matches) < MIN_MATCHES else pose.rotation.matrix()


def angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """Angle in degrees of the rotation from one rotation (3, 3) to another."""
    return float(np.degrees(np.arccos(np.clip((np.trace(a @ b.T) - 1) / 2, -1, 1))))


def _places(db: Any, names: list[str]) -> dict[int, int]:
    """Place in the video of each image id."""
    order = {name: place for place, name in enumerate(sorted(names))}
    return {image.image_id: order[image.name] for image in db.read_all_images() if image.name in order}
