"""A second look at the few photos that a good model leaves out. Runs in the pose process.

First with lower demands on the matches there are; then with affine-invariant features of those photos and of their
likely mates, joined to the features in use. The poses found before stay as they are meanwhile.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from . import features, mapping
from .presets import AFFINE
from .transfer import start_model
from .validate import MIN_MATCHES, ImageCheck, check_images, pair_images

# Not tuned; what they bring: docs/experiments.md, “A second look at photos that were left out”.
NEIGHBOURS = 2  # by name, to either side
MATES = 6  # by retrieval
AT_MOST = 48  # photos that get further features: they take seconds each
AGREEMENT = 0.8  # what is asked of a photo that was placed on so little


def place_rest(
    model: Any, path: Path, image_folder: Path, work: Path, names: list[str], tell: Any
) -> tuple[Any, dict[int, ImageCheck], dict[tuple[int, int], int], dict[int, ImageCheck]] | None:
    """Place photos that `model` lacks, with lower demands; the others do not move.

    Returns:
        the larger model, checks, links and the checks of photos that did not stand them; None when none was placed.
    """
    start = start_model(model, path, image_folder, work / "second_in")
    found = mapping.build(path, image_folder, work / "second_out", True, names, tell, start=start)
    if not found:
        return None
    larger = found[0]
    before = {model.image(i).name for i in model.reg_image_ids()}
    checks, _ = check_images(larger, path)
    dropped = {}
    for i, check in checks.items():
        doubtful = check.bad or check.agreement is None or check.agreement < AGREEMENT
        if larger.image(i).name not in before and doubtful:
            dropped[i] = check
    for i in dropped:
        larger.deregister_frame(larger.image(i).frame_id)
    if larger.num_reg_images() <= model.num_reg_images():
        return None
    checks, links = check_images(larger, path)
    return larger, checks, links, dropped


def add_affine_features(
    clusters: list[set[str]],
    path: Path,
    joined: Path,
    image_folder: Path,
    masks: Path | None,
    images: list[dict[str, Any]],
    tell: Any,
) -> bool:
    """Make the database `joined`: that of `path`, and affine features of clusters of photos, by name, matched within each.

    Returns:
        whether there is anything new in it.
    """
    touched = sorted(set().union(*clusters))
    if not touched:
        return False
    affine = path.with_name(AFFINE.database)
    features.add_images(affine, image_folder, [image for image in images if image["file"] in touched])
    features.extract(affine, image_folder, masks, touched, AFFINE, tell)
    pairs = sorted({pair for cluster in clusters for pair in features.all_pairs(sorted(cluster))})
    features.match(affine, pairs, path.with_name("pairs.txt"), tell)
    join(path, affine, joined)
    return True


def lacking_and_mates(model: Any, path: Path, names: list[str]) -> list[set[str]]:
    """For each photo without a pose: itself and its likely mates, as long as not too many come together."""
    placed = {model.image(i).name for i in model.reg_image_ids()}
    largest = retrieval_features(path)
    ordered = sorted(set(names) & set(largest))
    clusters: list[set[str]] = []
    for name in ordered:
        if name in placed:
            continue
        scores = {other: features.mutual_matches(largest[name], largest[other]) for other in ordered if other != name}
        best = sorted(scores, key=lambda other: -scores[other])[:MATES]
        clusters.append({name, *neighbours(name, ordered), *(other for other in best if scores[other] > 0)})
    return not_too_many(clusters)


def retrieval_features(path: Path) -> dict[str, np.ndarray]:
    """By name of the photo, descriptors of its features of largest scale, of all photos that have features."""
    with features.database(path) as db:
        return {
            image.name: features.largest_features(db, image.image_id, features.RETRIEVAL_FEATURES)
            for image in db.read_all_images()
            if db.exists_keypoints(image.image_id)
        }


def neighbours(name: str, ordered: list[str]) -> list[str]:
    """The nearest photos by name, to either side."""
    k = ordered.index(name)
    return ordered[max(0, k - NEIGHBOURS) : k] + ordered[k + 1 : k + NEIGHBOURS + 1]


def not_too_many(clusters: list[set[str]]) -> list[set[str]]:
    """The first clusters of photos, and those after them that fit into the limit of photos in all."""
    chosen: list[set[str]] = []
    touched: set[str] = set()
    for cluster in clusters:
        if len(touched | cluster) <= AT_MOST:
            chosen.append(cluster)
            touched |= cluster
    return chosen


def join(path: Path, other: Path, joined: Path) -> None:
    """Write `joined`: the database `path` with the features and matches of `other`, a database of the same photos.

    Features of `other` come after those of the same photo in `path`, so that models of `path` stay valid in number.
    """
    temporary = features.copy_database(path, joined.with_name(joined.name + ".new"))
    with features.database(temporary) as db, features.database(other) as more:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        same = {image.image_id: ids[image.name] for image in more.read_all_images() if image.name in ids}
        offset = {i: db.num_keypoints_for_image(i) for i in same.values()}
        descriptors = {i: db.read_descriptors(i) for i in ids.values() if db.exists_descriptors(i)}
        db.clear_descriptors()
        for theirs, ours in same.items():
            if not more.exists_keypoints(theirs):
                continue
            added = more.read_descriptors(theirs)
            db.update_keypoints(
                ours, np.concatenate([_six(db.read_keypoints(ours)), _six(more.read_keypoints(theirs))])
            )
            values = np.concatenate([descriptors[ours].data, added.data]) if ours in descriptors else added.data
            descriptors[ours] = pycolmap.FeatureDescriptors(added.type, values)
        for i, values in descriptors.items():
            db.write_descriptors(i, values)
        _join_matches(db, more, same, offset)
    # Closing has emptied the write-ahead log into the file; one that a killed run left must not be read into it.
    for suffix in ("-wal", "-shm"):
        Path(f"{joined}{suffix}").unlink(missing_ok=True)
    temporary.replace(joined)


def _join_matches(db: Any, more: Any, same: dict[int, int], offset: dict[int, int]) -> None:
    pair_ids, geometries = more.read_two_view_geometries()
    for pair_id, geometry in zip(pair_ids, geometries):
        theirs = pair_images(pair_id)
        if len(geometry.inlier_matches) < MIN_MATCHES or not all(i in same for i in theirs):
            continue
        a, b = (same[i] for i in theirs)
        shift = np.array([offset[a], offset[b]], np.uint32)
        inliers, matches = geometry.inlier_matches + shift, more.read_matches(*theirs) + shift
        if db.exists_two_view_geometry(a, b):
            ours = db.read_two_view_geometry(a, b)
            if len(ours.inlier_matches) >= MIN_MATCHES:
                inliers = np.concatenate([ours.inlier_matches, inliers])
                geometry = ours
            db.delete_two_view_geometry(a, b)
        geometry.inlier_matches = inliers  # the database turns a pair around itself where b comes first
        db.write_two_view_geometry(a, b, geometry)
        if db.exists_matches(a, b):
            matches = np.concatenate([db.read_matches(a, b), matches])
            db.delete_matches(a, b)
        db.write_matches(a, b, matches)


def _six(keypoints: np.ndarray) -> np.ndarray:
    """Keypoints (N, 6): position and affine shape, also from (N, 4): position, scale and angle."""
    keypoints = np.asarray(keypoints, np.float32)
    if keypoints.shape[1] == 6:
        return keypoints
    x, y, scale, angle = keypoints.T
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    return np.stack([x, y, c, -s, s, c], 1)
