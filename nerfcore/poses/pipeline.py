"""The stages of pose estimation, climbing the ladder of presets. Runs in the pose process."""

from __future__ import annotations

import json
import shutil
import zlib  # noqa: F401  (must be loaded before pycolmap, which exports a static zlib)
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from ..errors import PosesError
from ..files import write_json
from ..geometry.colmap_cameras import camera_from_colmap
from . import chain, features, mapping, matching_parts, merge, second_look
from .adjust import adjust, has_long_lens, has_odd_lens
from .presets import ENOUGH, EXHAUSTIVE_AT_MOST, EXHAUSTIVE_UP_TO, LADDERS, Level
from .resume import mapping_folder
from .transfer import start_model, taken_to
from .validate import MIN_MATCHES, MIN_POINTS, ImageCheck, pair_images

# Not tuned: the first two, which only choose the sentence that says why a photo has no pose.
MIN_FEATURES = 100
MIN_COMMON = 40
MIN_REGISTERED = 3  # photos of a model that is not given up
UNREADABLE = "its file could not be read for features"
LEVEL_FILE = "level.json"  # features of the model in poses/sparse


@dataclass
class Attempt:
    """The outcome of one level: its models (largest first), and what validation says of the first one; `contradicting`:
    pairs of frames whose matches were taken out, see `chain`; `joined`: sentences about separate models that became one."""

    level: Level
    database: Path
    models: list[Any]
    checks: dict[int, ImageCheck]
    links: dict[tuple[int, int], int]
    dropped: dict[int, ImageCheck]
    contradicting: int = 0
    joined: list[str] = field(default_factory=list)

    @property
    def registered(self) -> int:
        return self.models[0].num_reg_images() if self.models else 0


def run(job: dict[str, Any], tell: Any) -> dict[str, Any]:
    """Estimate poses for a job and write the sparse model.

    Job: image_folder, masks (or null), work and sparse (folders), preset, neighbours, video (all are
    frames in order), restart (forget earlier mappings), group (which of several separate models), start (a model to
    extend, or null), images [{file, group, width, height, focal_px}]; only (features or match: just these) and part.

    Returns:
        {cameras, images [{file, status, reason, camera, camera_to_world, agreement, points, error_px, mates,
        contradicting}], links, groups, reprojection_px, contradicting_pairs, level, points_file}; points_file has xyz,
        rgb, error, view and point.
    Raises:
        PosesError: no two photos could be placed; the message says why.
    """
    work = Path(job["work"])
    work.mkdir(parents=True, exist_ok=True)
    if job.get("only") == "features":
        return matching_parts.find_features(job, tell)
    if job.get("only") == "match":
        return matching_parts.match_part(job, tell)
    if job["restart"]:
        shutil.rmtree(work / "mapping", ignore_errors=True)
    names = [image["file"] for image in job["images"]]
    best: Attempt | None = None
    levels = _levels(job, work)
    tried: set[tuple[str, bool]] = set()
    for level in levels:
        exhaustive = len(names) <= EXHAUSTIVE_UP_TO or (level.exhaustive and len(names) <= EXHAUSTIVE_AT_MOST)
        signature = (level.database, exhaustive)
        if signature in tried:
            continue
        tried.add(signature)
        if best is not None:
            tell.warn(f"{_placed(best, names)}: trying again ({level.name}).")
        attempt = _join_groups(_attempt(job, level, names, exhaustive, tell), job, names, tell)
        if best is None or attempt.registered > best.registered:
            best = attempt
        if best.registered >= ENOUGH * len(names) or (job["group"] and best.registered):
            break
    assert best is not None
    if job["group"] and not best.registered:
        raise PosesError(f"The photos do not fall into {job['group'] + 1} groups.", "Choose a smaller --group.")
    if best.registered < MIN_REGISTERED:
        raise PosesError(
            _why_nothing(best, names), "Take more photos that overlap by two thirds, with texture in view."
        )
    if not job["group"]:
        for sentence in best.joined:
            tell.warn(sentence)
        best = _second_look(best, job, names, tell)
    tell.stage("Final adjustment")
    model = best.models[0] = adjust(best.models[0], keep_cameras=job["start"] is not None)
    if model.num_points3D() < MIN_POINTS:
        raise PosesError(
            f"The {len(names)} photos were taken from too few different positions: no depth can be seen.",
            "Walk around the subject while taking photos.",
        )
    sparse = Path(job["sparse"])
    temporary = sparse.with_name(sparse.name + ".new")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    model.write(str(temporary))
    shutil.rmtree(sparse, ignore_errors=True)
    temporary.rename(sparse)
    write_json(work / LEVEL_FILE, asdict(best.level))
    return _result(best, names, work / "points.npz")


def _placed(best: Attempt, names: list[str]) -> str:
    """How many photos have a pose; separate models of photos are said as groups."""
    text = f"{best.registered} of {len(names)} photos placed"
    sizes = [str(model.num_reg_images()) for model in best.models]
    return f"{text}, in one of the separate groups of {' and '.join(sizes)}" if len(sizes) > 1 else text


def _attempt(job: dict[str, Any], level: Level, names: list[str], exhaustive: bool, tell: Any) -> Attempt:
    work, image_folder = Path(job["work"]), Path(job["image_folder"])
    path = work / level.database
    masks = Path(job["masks"]) if job["masks"] else None
    features.add_images(path, image_folder, job["images"])
    features.extract(path, image_folder, masks, names, level, tell)
    if exhaustive:
        pairs = features.all_pairs(names)
    else:
        chosen = matching_parts.planned_pairs(work, level.database, names)
        pairs = features.likely_pairs(path, names, job["neighbours"], tell) if chosen is None else chosen
    matching_parts.gather(work, path)
    features.match(path, pairs, work / "pairs.txt", tell)
    contradicting = _tell_apart(job, path, names, tell)
    start = None
    if job["start"] is not None:
        start = start_model(pycolmap.Reconstruction(job["start"]), path, image_folder, work / "start")
    best, best_doubtful = Attempt(level, path, [], {}, {}, {}, contradicting), False
    # Placing cameras is quick beside finding features: try lower demands before harder features.
    for full, relaxed in ((True, False), (False, False), (False, True)):
        if start is None and features.set_lenses(path, job["images"], full) != full:
            continue  # no lens may have the full model: the next variant is this one
        if start is not None and full:
            continue  # lenses are those of the model that is extended
        memory = mapping_folder(work, path, full, relaxed, names) if start is None else None
        models = mapping.build(path, image_folder, work / "models", relaxed, names, tell, start, memory)
        models, joined = merge.merge_models(models, path, image_folder, work, tell)
        if len(models) <= job["group"]:
            continue
        models.insert(0, models.pop(job["group"]))
        tell.stage("Checking poses")
        model, checks, links, dropped = mapping.repair(models[0], path, image_folder, work, relaxed, names, tell)
        if model is None:
            continue
        # Self-calibration may run away, and a lens of unknown focal length turn out to be long: then the full model
        # is worth no more than the simple one that follows.
        doubtful = full and (has_long_lens(model) or has_odd_lens(model))
        if model.num_reg_images() > best.registered or (best_doubtful and model.num_reg_images() >= MIN_REGISTERED):
            best, best_doubtful = (
                Attempt(level, path, [model, *models[1:]], checks, links, dropped, contradicting, joined),
                doubtful,
            )
        if best_doubtful:
            continue
        if best.registered >= ENOUGH * len(names):
            break
    return best


def _join_groups(found: Attempt, job: dict[str, Any], names: list[str], tell: Any) -> Attempt:
    """Join separate models by affine features between them, where they would be enough together."""
    work, image_folder = Path(job["work"]), Path(job["image_folder"])
    masks = Path(job["masks"]) if job["masks"] else None
    together = set().union(*({model.image(i).name for i in model.reg_image_ids()} for model in found.models))
    if len(found.models) < 2 or job["group"] or not found.registered < ENOUGH * len(names) <= len(together):
        return found
    if found.level.affine or job["preset"] == "fast":
        return found
    level = replace(found.level, name=f"{found.level.name}, groups joined", joined=True)
    path = work / level.database
    clusters = merge.bridges(found.models, found.database, names)
    if not clusters:
        return found
    tell.warn(f"{_placed(found, names)}: looking for affine features that join them.")
    second_look.add_affine_features(clusters, found.database, path, image_folder, masks, job["images"], tell)
    _tell_apart(job, path, names, tell)
    models = [taken_to(model, path, image_folder, work / "groups") for model in found.models]
    models, joined = merge.merge_models(models, path, image_folder, work, tell)
    if not joined:
        return found
    tell.stage("Checking poses")
    model, checks, links, dropped = mapping.repair(models[0], path, image_folder, work, False, names, tell)
    if model is None or model.num_reg_images() <= found.registered:
        return found
    return Attempt(
        level, path, [model, *models[1:]], checks, links, dropped, found.contradicting, [*found.joined, *joined]
    )


def _tell_apart(job: dict[str, Any], path: Path, names: list[str], tell: Any) -> int:
    """In a video, take matches out that contradict the way the camera went; returns of how many pairs in all."""
    if not job["video"] or job["start"] is not None:
        return 0
    features.set_lenses(path, job["images"], full=False)
    return chain.tell_apart(path, Path(job["image_folder"]), Path(job["work"]), names, tell)


def _levels(job: dict[str, Any], work: Path) -> tuple[Level, ...]:
    """The ladder of the preset; a model that is extended goes on with the features it was made of."""
    ladder = LADDERS[job["preset"]]
    if job["start"] is None:
        return ladder
    try:
        level = Level(**json.loads((work / LEVEL_FILE).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return ladder
    return (level, *ladder) if (work / level.database).is_file() else ladder


def _second_look(best: Attempt, job: dict[str, Any], names: list[str], tell: Any) -> Attempt:
    """Place what a good model leaves out, at first on the matches there are, then on affine features."""
    work, image_folder = Path(job["work"]), Path(job["image_folder"])
    masks = Path(job["masks"]) if job["masks"] else None
    if best.registered < len(names):
        placed = second_look.place_rest(best.models[0], best.database, image_folder, work, names, tell)
        best = _larger(best, best.level, best.database, placed)
    # Where many are missing the ladder was climbed to affine features of all; what follows is for single ones.
    has_them = best.level.affine or best.level.joined or job["preset"] == "fast"
    if has_them or not ENOUGH * len(names) <= best.registered < len(names):
        return best
    level = replace(best.level, name=f"{best.level.name}, second look", joined=True)
    joined = work / level.database
    clusters = second_look.lacking_and_mates(best.models[0], best.database, names)
    if not second_look.add_affine_features(clusters, best.database, joined, image_folder, masks, job["images"], tell):
        return best
    _tell_apart(job, joined, names, tell)
    placed = second_look.place_rest(best.models[0], joined, image_folder, work, names, tell)
    return _larger(best, level, joined, placed)


def _larger(best: Attempt, level: Level, database: Path, placed: Any) -> Attempt:
    if placed is None:
        return best
    model, checks, links, dropped = placed
    models = [model, *best.models[1:]]
    return replace(
        best, level=level, database=database, models=models, checks=checks, links=links, dropped=best.dropped | dropped
    )


def _result(best: Attempt, names: list[str], points_file: Path) -> dict[str, Any]:
    model = best.models[0]
    camera_ids = sorted(model.cameras)
    cameras = []
    for camera_id in camera_ids:
        camera = model.camera(camera_id)
        ours = camera_from_colmap(camera.model_name, camera.width, camera.height, list(camera.params))
        cameras.append(ours.model_dump(mode="json"))
    by_name = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    reasons = _reasons(best, names, set(by_name))
    images, views = [], {}
    for name in names:
        image = by_name.get(name)
        if image is None:
            images.append({"file": name, "status": "unregistered", "reason": reasons[name]})
            continue
        check = best.checks.get(image.image_id)
        views[image.image_id] = len(views)
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        images.append(
            {
                "file": name,
                "status": "ok",
                "reason": "",
                "camera": camera_ids.index(image.camera_id),
                "camera_to_world": pose.tolist(),
                "agreement": check.agreement if check else None,
                "points": check.points if check else image.num_points3D,
                "error_px": check.error_px if check else 0.0,
                "mates": check.mates if check else 0,
                "contradicting": check.contradicting if check else 0,
            }
        )
    _write_points(model, views, points_file)
    name_of = {i: model.image(i).name for i in model.reg_image_ids()}
    return {
        "cameras": cameras,
        "images": images,
        "links": [[name_of[a], name_of[b], n] for (a, b), n in best.links.items() if a in name_of and b in name_of],
        "groups": [m.num_reg_images() for m in best.models],
        "reprojection_px": model.compute_mean_reprojection_error(),
        "contradicting_pairs": best.contradicting,
        "level": best.level.name,
        "points_file": str(points_file),
    }


def _write_points(model: Any, views: dict[int, int], path: Path) -> None:
    """Sparse points with, for each observation, the number of the view (in result order) and of the point."""
    points = model.points3D
    count = len(points)
    xyz, rgb, error = np.zeros((count, 3)), np.zeros((count, 3), np.uint8), np.zeros(count, np.float32)
    view_of, point_of = [], []
    for n, point in enumerate(points.values()):
        xyz[n], rgb[n], error[n] = point.xyz, point.color, point.error
        for element in point.track.elements:
            if element.image_id in views:
                view_of.append(views[element.image_id])
                point_of.append(n)
    with open(path, "wb") as file:
        np.savez(
            file, xyz=xyz, rgb=rgb, error=error, view=np.array(view_of, np.int32), point=np.array(point_of, np.int32)
        )


def _reasons(best: Attempt, names: list[str], registered: set[str]) -> dict[str, str]:
    """Why each of the images without a pose has none."""
    with features.database(best.database) as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        counts = {name: db.num_keypoints_for_image(i) for name, i in ids.items() if db.exists_keypoints(i)}
        pair_ids, geometries = db.read_two_view_geometries()
    name_of = {i: name for name, i in ids.items()}
    mates: dict[str, dict[str, int]] = {name: {} for name in names}
    for pair_id, geometry in zip(pair_ids, geometries):
        a, b = (name_of[i] for i in pair_images(pair_id))
        inliers = len(geometry.inlier_matches)
        if inliers >= MIN_MATCHES and a in mates and b in mates:
            mates[a][b] = mates[b][a] = inliers
    elsewhere = {}
    for model in best.models[1:]:
        for i in model.reg_image_ids():
            elsewhere.setdefault(model.image(i).name, model.num_reg_images())
    dropped = {name_of[i]: check for i, check in best.dropped.items() if i in name_of}
    reasons = {}
    for name in names:
        if name in registered:
            continue
        placed = {mate: n for mate, n in mates[name].items() if mate in registered}
        if name not in counts:
            reasons[name] = UNREADABLE
        elif counts[name] < MIN_FEATURES:
            reasons[name] = f"only {counts[name]} features: blurred, dark, masked out or without texture"
        elif name in dropped:
            reasons[name] = _why_dropped(dropped[name])
        elif name in elsewhere:
            reasons[name] = (
                f"belongs to a separate group of {elsewhere[name]} photos that shares too little with the others"
            )
        elif not mates[name]:
            reasons[name] = "matches no other photo"
        elif not placed:
            reasons[name] = f"matches only photos without a pose ({', '.join(sorted(mates[name])[:3])})"
        elif max(placed.values()) < MIN_COMMON:
            reasons[name] = f"too little overlap: at most {max(placed.values())} common features with a placed photo"
        else:
            reasons[name] = f"matches {len(placed)} placed photos, but too few of those features have a known depth"
    return reasons


def _why_dropped(check: ImageCheck) -> str:
    if check.points < MIN_POINTS or check.agreement is None:
        return f"its pose rests on too little: {check.points} points"
    return f"its pose contradicted the other photos ({check.agreement:.0%} of its matches agree)"


def _why_nothing(best: Attempt, names: list[str]) -> str:
    reasons = list(_reasons(best, names, set()).values())
    few = sum("features: blurred" in reason for reason in reasons)
    alone = sum(reason == "matches no other photo" for reason in reasons)
    unread = reasons.count(UNREADABLE)
    if unread > len(names) / 2:
        why = f"{unread} of them could not be read for features, or their masks"
    elif few > len(names) / 2:
        why = f"{few} of them have too little texture"
    elif alone > len(names) / 2:
        why = f"{alone} of them match no other photo"
    else:
        why = "they match, but from too few different positions, so no depth can be seen"
    return f"No camera pose could be found for the {len(names)} photos: {why}."
