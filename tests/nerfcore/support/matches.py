"""Feature matches between photos, and how far they lie from the epipolar lines of given poses."""

from __future__ import annotations

import shutil
import zlib  # noqa: F401  (before pycolmap)
from pathlib import Path

import numpy as np
from fieldwork.nerfcore.data.dataset import DatasetView
from fieldwork.nerfcore.geometry.cameras import rays
from fieldwork.nerfcore.poses import features
from fieldwork.nerfcore.poses.presets import FAST
from fieldwork.nerfcore.poses.validate import pair_images, sampson_distance

Matches = dict[tuple[str, str], tuple[np.ndarray, np.ndarray]]


class Quiet:
    """Takes progress and forgets it."""

    def stage(self, name: str) -> None: ...

    def progress(self, fraction: float, message: str = "") -> None: ...

    def watch(self, database: str, table: str, total: int, noun: str) -> None: ...

    def watch_end(self) -> None: ...


def find_matches(views: list[DatasetView], work: Path) -> Matches:
    """Verified feature matches between views, found without their poses: pixels (N, 2) in both images."""
    (work / "images").mkdir(parents=True)
    (work / "masks").mkdir()
    entries = []
    for view in views:
        file = f"{view.name}{view.image.suffix.lower()}"
        shutil.copy(view.image, work / "images" / file)
        if view.mask:
            shutil.copy(view.mask, work / "masks" / f"{file}.png")
        size = {"width": view.camera.width, "height": view.camera.height}
        entries.append({"file": file, "group": "all", "focal_px": None, **size})
    database, names = work / "features.db", [entry["file"] for entry in entries]
    features.add_images(database, work / "images", entries)
    masks = work / "masks" if any(view.mask for view in views) else None
    features.extract(database, work / "images", masks, names, FAST, Quiet())
    features.match(database, features.all_pairs(names), work / "pairs.txt", Quiet())
    found: Matches = {}
    with features.database(database) as db:
        name_of = {image.image_id: Path(image.name).stem for image in db.read_all_images()}
        pixels = {i: np.asarray(db.read_keypoints(i))[:, :2].astype(float) for i in name_of}
        for pair_id, geometry in zip(*db.read_two_view_geometries()):
            a, b = pair_images(pair_id)
            inliers = np.asarray(geometry.inlier_matches)
            if len(inliers) >= 20:
                found[name_of[a], name_of[b]] = pixels[a][inliers[:, 0]], pixels[b][inliers[:, 1]]
    return found


def epipolar_error(views: list[DatasetView], matches: Matches) -> float:
    """Median over the pairs of the median distance of matches from their epipolar lines, in pixels."""
    by_name = {view.name: view for view in views}

    def look(name: str, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        view = by_name[name]
        directions, _ = rays(view.camera, pixels)
        return np.linalg.inv(view.camera_to_world)[:3], directions[:, :2] / directions[:, 2:]

    errors = []
    for (a, b), (first, second) in matches.items():
        pose_a, seen_a = look(a, first)
        pose_b, seen_b = look(b, second)
        distance = sampson_distance(pose_a, pose_b, seen_a, seen_b)
        errors.append(float(np.median(distance)) * by_name[a].camera.fx)
    assert len(errors) >= 3
    return float(np.median(errors))
