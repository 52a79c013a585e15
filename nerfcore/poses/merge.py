"""Joining the separate models of one mapping. Runs in the pose process.

A mapper places photos one by one, and photos that share too little with a model, each by itself, become a model of their
own. Together they may share enough: features seen by both models give pairs of 3D points, and these the similarity
between the models.
"""

from __future__ import annotations

import copy
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from . import features, mapping, second_look
from .adjust import bundle_adjust
from .transfer import set_lens_models
from .validate import GOOD_AGREEMENT, MIN_MATCHES, check_images, pair_agreements, pair_images

# What COLMAP asks of one photo that is placed by known points (abs_pose_min_num_inliers, abs_pose_min_inlier_ratio,
# abs_pose_max_error) is asked of a whole model; the adjustment that follows has to bring it within the limits of `validate`.
LEAST_POINTS = 30
LEAST_SHARE = 0.25
TOLERANCE_PX = 12.0


@dataclass(frozen=True)
class Ties:
    """N pairs of a feature of a small model and one of a large model that show the same spot.

    Columns are (small, large): `points` (N, 2) ids of 3D points, `images` (N, 2) ids, `xyz` (N, 2, 3) each in its
    model's frame, `pixels` (N, 2, 2).
    """

    points: np.ndarray
    images: np.ndarray
    xyz: np.ndarray
    pixels: np.ndarray


def merge_models(
    models: list[Any], path: Path, image_folder: Path, work: Path, tell: Any
) -> tuple[list[Any], list[str]]:
    """Join to the first of the models, the largest, those that share enough with it by the matches in `path`.

    Returns:
        the models that are left, the joined one first, and a sentence for each that was joined. Those given stay as
        they are.
    """
    if len(models) < 2:
        return models, []
    tell.stage("Joining groups")
    largest, apart = models[0], list(models[1:])
    said, k = [], 0
    while k < len(apart):
        found = _joined(apart[k], largest, path, image_folder, work)
        if found is None:
            k += 1
            continue
        joined, count = found
        sizes = f"{largest.num_reg_images()} and {apart[k].num_reg_images()}"
        said.append(f"The separate groups of {sizes} photos were joined by {count} points that both have.")
        largest = joined
        del apart[k]
        k = 0  # with the larger model those tried before may share enough
    return [largest, *apart], said


def _joined(small: Any, large: Any, path: Path, image_folder: Path, work: Path) -> tuple[Any, int] | None:
    """The model of both, and by how many points they agree; None where they do not, or where checks speak against it."""
    of_small, of_large = set(small.reg_image_ids()), set(large.reg_image_ids())
    fresh = of_small - of_large
    if not fresh:
        return None
    ties = find_ties(small, large, path)
    found = similarity(ties, small, large)
    if found is None:
        return None
    large_from_small, agreeing = found
    joined = _settled(join(small, large, large_from_small, ties.points[agreeing]), path, image_folder, work / "joined")
    if not _holds(joined, large, fresh, of_large - of_small, path):
        return None
    return joined, len(np.unique(ties.points[agreeing, 0]))


def find_ties(small: Any, large: Any, path: Path) -> Ties:
    """Features with a 3D point in either model that are matched in the database, or that are the same one of a photo
    which both models hold."""
    seen = _points_seen(small), _points_seen(large)
    found = [(i, i, *np.tile(np.arange(len(seen[0][i])), (2, 1))) for i in seen[0] if i in seen[1]]
    with features.database(path) as db:
        pair_ids, geometries = db.read_two_view_geometries()
    for pair_id, geometry in zip(pair_ids, geometries):
        matches = np.asarray(geometry.inlier_matches).astype(np.int64).reshape(-1, 2)
        if len(matches) < MIN_MATCHES:
            continue
        a, b = pair_images(pair_id)
        found += [(a, b, *matches.T)] if a in seen[0] and b in seen[1] else []
        found += [(b, a, *matches.T[::-1])] if b in seen[0] and a in seen[1] else []
    points, images, pixels = [np.zeros((0, 2), np.int64)], [np.zeros((0, 2), np.int64)], [np.zeros((0, 2, 2))]
    keypoints = _keypoints(small), _keypoints(large)
    for i, j, of_i, of_j in found:
        ids = np.stack([seen[0][i][of_i], seen[1][j][of_j]], 1)
        known = (ids >= 0).all(1)
        points.append(ids[known])
        images.append(np.tile([i, j], (int(known.sum()), 1)))
        pixels.append(np.stack([keypoints[0][i][of_i[known]], keypoints[1][j][of_j[known]]], 1))
    ids = np.concatenate(points)
    xyz = np.stack([_xyz(model, ids[:, column]) for column, model in enumerate((small, large))], 1)
    return Ties(ids, np.concatenate(images), xyz, np.concatenate(pixels))


def similarity(ties: Ties, small: Any, large: Any) -> tuple[Any, np.ndarray] | None:
    """The similarity that takes the small model into the frame of the large one, and which ties (N,) agree with it.

    A tie agrees if the point of either model, taken to the other one, is where the other's photo shows it. None where
    too few points do.
    """
    distinct = np.unique(ties.points, axis=0, return_index=True)[1]
    if len(distinct) < LEAST_POINTS:
        return None
    # Points are as uncertain as TOLERANCE_PX is wide at their distance.
    options = pycolmap.RANSACOptions()
    options.max_error = TOLERANCE_PX * float(np.median(_pixel_sizes(large, ties.images[:, 1], ties.xyz[:, 1])))
    options.min_inlier_ratio = LEAST_SHARE
    options.random_seed = mapping.SEED
    found: Any = pycolmap.estimate_sim3d_robust(ties.xyz[distinct, 0], ties.xyz[distinct, 1], options)
    if found is None:
        return None
    large_from_small = found["tgt_from_src"]  # the stub of pycolmap says that this is all that comes back
    there, back = large_from_small.matrix(), large_from_small.inverse().matrix()
    moved = ties.xyz[:, 0] @ there[:, :3].T + there[:, 3]
    returned = ties.xyz[:, 1] @ back[:, :3].T + back[:, 3]
    agreeing = (_misses(large, ties.images[:, 1], moved, ties.pixels[:, 1]) <= TOLERANCE_PX) & (
        _misses(small, ties.images[:, 0], returned, ties.pixels[:, 0]) <= TOLERANCE_PX
    )
    count = len(np.unique(ties.points[agreeing, 0]))
    if count < max(LEAST_POINTS, LEAST_SHARE * len(np.unique(ties.points[:, 0]))):
        return None
    return large_from_small, agreeing


def join(small: Any, large: Any, large_from_small: Any, same: np.ndarray) -> Any:
    """One model, in the frame of the large one, of which points (N, 2) that are the same are one.

    What a photo of both sees is what it sees in the large model. Lenses of both are those of the large one.
    """
    joined, moved = copy.deepcopy(large), copy.deepcopy(small)
    moved.transform(large_from_small)
    fresh = sorted(set(moved.reg_image_ids()) - set(large.reg_image_ids()))
    for i in fresh:
        _add_image(joined, moved, moved.image(i))
    partner = dict(same.tolist())
    known = set(fresh)
    for point_id, point in moved.points3D.items():
        elements = [element for element in point.track.elements if element.image_id in known]
        if point_id in partner:
            for element in elements:
                joined.add_observation(partner[point_id], element)
        elif len(elements) >= 2:
            joined.add_point3D(point.xyz, pycolmap.Track(elements), point.color)
    return joined


def _add_image(model: Any, source: Any, image: Any) -> None:
    """Add an image of another model, with its pose and features, but without points."""
    camera, frame = copy.deepcopy(image.camera), copy.deepcopy(source.frame(image.frame_id))
    if not model.exists_camera(camera.camera_id):
        model.add_camera(camera)
    if not model.exists_rig(frame.rig_id):
        model.add_rig(copy.deepcopy(source.rig(frame.rig_id)))
    pose = image.cam_from_world()
    frame.reset_rig_ptr()  # belongs to the other model
    frame.reset_pose()
    model.add_frame(frame)
    xy = np.stack([point.xy for point in image.points2D]) if image.num_points2D() else np.zeros((0, 2))
    bare = pycolmap.Image(name=image.name, keypoints=xy, camera_id=image.camera_id, image_id=image.image_id)
    bare.frame_id = image.frame_id
    model.add_image(bare)
    model.frame(image.frame_id).rig_from_world = pose
    model.register_frame(image.frame_id)


def _settled(model: Any, path: Path, image_folder: Path, folder: Path) -> Any:
    """A joined model after adjustment, with the tracks that go from one of its parts into the other."""
    bundle_adjust(model, full=False)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    set_lens_models(path, model)
    model = pycolmap.triangulate_points(model, path, image_folder, folder, clear_points=False)
    shutil.rmtree(folder)
    bundle_adjust(model, full=False)
    return model


def _holds(joined: Any, large: Any, fresh: set[int], only_large: set[int], path: Path) -> bool:
    """Whether matches across the groups agree with the joined model, and its photos stand their check.

    Some photos of the small group may fail it, as in every model: they are repaired later on.
    """
    agreed = total = 0.0
    for a, b, share, count in pair_agreements(joined, path):
        if (a in fresh and b in only_large) or (b in fresh and a in only_large):
            agreed += share * count
            total += count
    if agreed < GOOD_AGREEMENT * total:
        return False
    stood, stand = (
        {i for i, check in check_images(model, path)[0].items() if not check.bad} for model in (large, joined)
    )
    return stood <= stand and 2 * len(fresh & stand) >= len(fresh)


def bridges(models: list[Any], path: Path, names: list[str]) -> list[set[str]]:
    """Names of photos that may join the other models to the first, in clusters within which all should be matched.

    Each cluster is around one photo that the first model lacks: its neighbours by name, and its likely mates by
    retrieval, half of them from its own model and half from the first. Likeliest ones first; not too many in all.
    """
    first = {models[0].image(i).name for i in models[0].reg_image_ids()}
    largest = second_look.retrieval_features(path)
    ordered = sorted(set(names) & set(largest))
    ranked: list[tuple[int, set[str]]] = []
    for model in models[1:]:
        own = {model.image(i).name for i in model.reg_image_ids()} - first
        for name in sorted(own & set(ordered)):
            scores = {
                other: features.mutual_matches(largest[name], largest[other])
                for other in sorted(((own | first) & set(ordered)) - {name})
            }
            best = sorted(scores, key=lambda other: -scores[other])
            across = [other for other in best if other in first][: second_look.MATES // 2]
            beside = [other for other in best if other in own][: second_look.MATES // 2]
            near = second_look.neighbours(name, ordered)
            if across:
                ranked.append((scores[across[0]], {name, *near, *across, *beside}))
    ranked.sort(key=lambda entry: -entry[0])
    return second_look.not_too_many([cluster for _, cluster in ranked])


def _points_seen(model: Any) -> dict[int, np.ndarray]:
    """By id of the image, the id of the 3D point of each of its features (K,), or −1."""
    return {
        i: np.array([p.point3D_id if p.has_point3D() else -1 for p in model.image(i).points2D], np.int64)
        for i in model.reg_image_ids()
    }


def _keypoints(model: Any) -> dict[int, np.ndarray]:
    """By id of the image, its features (K, 2) in pixels."""
    return {
        i: np.array([point.xy for point in model.image(i).points2D], np.float64).reshape(-1, 2)
        for i in model.reg_image_ids()
    }


def _xyz(model: Any, point_ids: np.ndarray) -> np.ndarray:
    """Positions (N, 3) of points."""
    distinct, which = np.unique(point_ids, return_inverse=True)
    return np.array([model.point3D(i).xyz for i in distinct.tolist()], np.float64).reshape(-1, 3)[which]


def _in_camera(image: Any, xyz: np.ndarray) -> np.ndarray:
    pose = image.cam_from_world().matrix()
    return xyz @ pose[:, :3].T + pose[:, 3]


def _pixel_sizes(model: Any, image_ids: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    """How wide a pixel of each image (N,) is at the distance of points (N, 3), in units of the model."""
    sizes = np.zeros(len(xyz))
    for i in np.unique(image_ids).tolist():
        image, chosen = model.image(i), image_ids == i
        sizes[chosen] = np.abs(_in_camera(image, xyz[chosen])[:, 2]) / image.camera.mean_focal_length()
    return sizes


def _misses(model: Any, image_ids: np.ndarray, xyz: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Distances (N,) in pixels of points (N, 3), seen in images (N,), from pixels (N, 2); infinite behind a camera."""
    misses = np.full(len(xyz), np.inf)
    for i in np.unique(image_ids).tolist():
        image, chosen = model.image(i), np.flatnonzero(image_ids == i)
        local = _in_camera(image, xyz[chosen])
        chosen, local = chosen[local[:, 2] > 0], local[local[:, 2] > 0]
        found = np.asarray(image.camera.img_from_cam(local), np.float64).reshape(-1, 2)
        misses[chosen] = np.linalg.norm(found - pixels[chosen], axis=1)
    return np.where(np.isfinite(misses), misses, np.inf)
