"""The verb `poses`: camera poses, lenses and sparse points of a capture by structure from motion."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..data.hull import trim_masks
from ..errors import PosesError
from ..files import atomic_path, disk_errors, write_json
from ..geometry.cameras import Camera
from ..geometry.frames import upright
from ..geometry.points import Points
from ..params import PosesParams
from ..progress import Reporter, shortened
from ..project.fingerprints import Fingerprint
from ..project.kept import earlier_cut_outs, earlier_poses, keep_world
from ..project.schema import Frame, ImageRecord, PosedImage, Poses, Project
from ..project.store import FRAMES_FILE, FRAMES_FOLDER, POSES_FILE, edit_project, load_poses, load_project, save_poses
from ..verdict import poses_verdict
from .align import gps_frame
from .exposure import exposure_gains
from .inputs import STATE_FILE, WORK_FOLDER, changed, photo_state, photos_found, posing_inputs, recorded, usable
from .process import run_worker
from .zoom import lens_groups

SPARSE_FOLDER = "poses/sparse"
REPORT_FILE = "poses/report.json"
PICTURE_FILE = "poses/report.png"
MIN_PHOTOS = 3
# By name, matched besides those that retrieval finds. Of video as in COLMAP's sequential matching; of photos not tuned.
PHOTO_NEIGHBOURS, VIDEO_NEIGHBOURS = 3, 10


def estimate_poses(params: PosesParams, report: Reporter) -> dict[str, Any]:
    """Estimate the poses of all usable photos of a project.

    A run that was stopped goes on with the features and matches it has. When photos were added to a project with
    poses, only they are placed and everything else stays where it is, unless `restart`. A world that was aligned by hand
    is kept in either case, if the cameras stand to each other as before.

    Returns:
        {"registered", "total", "reprojection_px", "up_confidence", "world_kept", "gps": {"latitude", "longitude" of the
        world's origin, "residual_m"} where scale and north are from the positions of the photos, "images": [{"name",
        "status", "reason"}]}
    Raises:
        ProjectError, PosesError, DiskError, Cancelled.
    """
    folder = Path(params.project)
    project = load_project(folder)
    records = usable(project)
    if len(records) < MIN_PHOTOS:
        rejected = len(project.images) - len(records)
        raise PosesError(
            f"{folder} has {len(records)} usable photo{'s' * (len(records) != 1)} ({rejected} rejected); "
            f"poses need at least {MIN_PHOTOS}.",
            "Add photos with `fieldwork new --add`; twenty to a hundred around the subject work well.",
        )
    inputs, before = posing_inputs(folder, project, params), earlier_poses(folder)
    _require_group(project, params, inputs)
    job = pose_job(folder, project, params, report)
    result = run_worker(job, folder / WORK_FOLDER, report)
    # Classes and region may have been edited meanwhile.
    with edit_project(folder) as project:
        records = usable(project)
        poses, points, visibility = _poses(result, records)
        if not params.keep_exposure:
            poses = with_gains(folder, records, poses, points, visibility, report)
        _set_statuses(records, result)
        kept, gps = job["start"] is not None, None  # the cameras that were there stayed
        if not kept:
            fresh, gps = _upright_frame(project, poses, points)
            project.frame, kept = keep_world(project, before, poses, fresh, report)
        save_poses(folder, poses, points, visibility)
        if earlier_cut_outs(project) and trim_masks(folder, report):
            # Found with the masks as they were; that they are others now is no reason to find them again.
            inputs = posing_inputs(folder, project, params)
            write_json(folder / WORK_FOLDER / STATE_FILE, photo_state(folder, records))
        matching = [
            (record.name, image["mates"], image["contradicting"])
            for record, image in zip(records, result["images"])
            if image["status"] == "ok"
        ]
        answer = {
            "registered": len(poses.images),
            "total": len(records),
            "reprojection_px": result["reprojection_px"],
            "up_confidence": project.frame.up_confidence,
            "world_kept": kept,
            **({} if kept or gps is None else {"gps": gps}),
            "level": result["level"],
            "groups": result["groups"],
            "verdict": poses_verdict(len(poses.images), len(records), matching),
            "images": [
                {"name": record.name, "status": image["status"], "reason": image["reason"]}
                for record, image in zip(records, result["images"])
            ],
        }
        known = {k: v for k, v in answer.items() if k != "images"}
        project.record("poses", params.model_dump(mode="json"), known, inputs)
    _write_report(folder, project, poses, points, records, result, report)
    missing = [f"{record.name} ({record.reason})" for record in records if record.status != "ok"]
    if missing and len(result["groups"]) > 1:
        report.warn(in_groups(result["groups"], params.group))
    if missing:
        where = f"{len(missing)} of {answer['total']} photos {'has' if len(missing) == 1 else 'have'} no pose"
        report.warn(f"{shortened(where, missing)} {folder / REPORT_FILE} says why.")
    return answer


def _require_group(project: Project, params: PosesParams, inputs: Fingerprint) -> None:
    """Raise PosesError where it is known beforehand that there is no such group of photos."""
    count, made = len(usable(project)), recorded(project)
    if MIN_PHOTOS * (params.group + 1) > count:
        raise PosesError(
            f"--group {params.group}: {count} photos do not fall into {params.group + 1} groups.",
            "Choose a smaller --group.",
        )
    if made is None or params.restart or params.preset != made.settings.get("preset"):
        return
    found = made.result.get("groups", [])
    same = all(made.inputs.get(name) == value for name, value in inputs.items() if name != "settings")
    if same and found and params.group >= len(found):
        raise PosesError(
            f"--group {params.group}: the photos fall into {len(found)} group{'s' * (len(found) != 1)}.",
            "Choose a smaller --group, or look for groups anew with --restart.",
        )


def with_gains(
    folder: Path,
    records: list[ImageRecord],
    poses: Poses,
    points: Points,
    visibility: tuple[np.ndarray, np.ndarray],
    report: Reporter,
) -> Poses:
    """Poses that say what brings each photo to the common exposure, where photos differ; a note tells."""
    report.stage("Comparing exposures")
    files = {record.name: folder / record.file for record in records}
    gains = exposure_gains(poses, points, visibility, [files[image.name] for image in poses.images], report)
    if gains is None:
        return poses
    brightest, darkest = 1 / gains.mean(1).min(), 1 / gains.mean(1).max()
    report.note(
        f"The photos differ in exposure or white balance ({darkest:.2f} to {brightest:.2f} of their mean) and are brought to a "
        "common one for training. --keep-exposure leaves them as they are."
    )
    images = [
        image.model_copy(update={"gain": tuple(round(float(value), 4) for value in gain)})
        for image, gain in zip(poses.images, gains)
    ]
    return poses.model_copy(update={"images": images})


def pose_job(folder: Path, project: Project, params: PosesParams, report: Reporter) -> dict[str, Any]:
    """What the pose process is asked for, with masks where it looks for them; features of other photos are thrown away.

    Raises:
        DiskError, Cancelled.
    """
    records, work = usable(project), folder / WORK_FOLDER
    with disk_errors(work):
        work.mkdir(parents=True, exist_ok=True)
        same = _forget_changed(folder, records)
        # Where a photo that has a pose is another one now, the poses around it are worth nothing.
        anew = params.restart or params.group or not same
        previous = None if anew else _extendable(folder, records)
        masks = _prepare_masks(folder, work, records, report)
    return _job(folder, project, records, masks, params, extend=previous is not None)


def in_groups(groups: list[int], used: int) -> str:
    """That photos fall into groups of these sizes, of which the first is used; by --group it was number `used`."""
    sizes = f"{', '.join(map(str, groups[:-1]))} and {groups[-1]}"
    other = "--group 1 uses the next one" if used == 0 else "--group 0 uses the largest"
    return (
        f"The photos fall into {len(groups)} groups of {sizes} that share too little to be joined; the poses are those of the "
        f"first. Photos between them would join them; {other}."
    )


def _extendable(folder: Path, records: list[ImageRecord]) -> Poses | None:
    """The earlier poses, if they came from here and there are photos that were not part of that run."""
    if not (folder / POSES_FILE).is_file() or not (folder / SPARSE_FOLDER).is_dir():
        return None
    poses = load_poses(folder)
    placed = {image.name for image in poses.images}
    fresh = [record for record in records if record.name not in placed and record.status == "ok"]
    kept = [record for record in records if record.name in placed]
    return poses if poses.source == "sfm" and fresh and len(kept) >= MIN_PHOTOS else None


def _forget_changed(folder: Path, records: list[ImageRecord]) -> bool:
    """Throw away features of photos whose working copy or mask is another one than when they were found.

    Returns:
        whether none was.
    """
    work, same = folder / WORK_FOLDER, True
    before, now = photos_found(work), photo_state(folder, records)
    if before is not None and changed(before, now):
        shutil.rmtree(work)
        work.mkdir(parents=True)
        before, same = None, False
    write_json(work / STATE_FILE, {**(before or {}), **now})
    return same


def _prepare_masks(folder: Path, work: Path, records: list[ImageRecord], report: Reporter) -> Path | None:
    """Masks under the names COLMAP looks for: those of the project, and the alpha of photos with transparency.

    Once one photo has a mask all get one, others a white one: COLMAP finds no features in photos whose mask is missing.
    """
    target = work / "masks"
    masked = [record for record in records if record.mask or _has_alpha(folder / record.file)]
    if not masked:
        return None
    for record in records:
        report.check()
        path = target / f"{_database_name(record)}.png"
        if path.is_file():
            continue
        with atomic_path(path) as temporary:
            if record.mask:
                shutil.copyfile(folder / record.mask, temporary)
            elif record in masked:
                with Image.open(folder / record.file) as image:
                    alpha = np.asarray(image.getchannel("A"))
                Image.fromarray(np.where(alpha > 127, 255, 0).astype(np.uint8)).save(temporary)
            else:
                Image.new("L", (record.width, record.height), 255).save(temporary)
    return target


def _has_alpha(photo: Path) -> bool:
    if photo.suffix != ".png":
        return False
    with Image.open(photo) as image:
        return "A" in image.getbands()


def _database_name(record: ImageRecord) -> str:
    """The photo's name in COLMAP's files: relative to images/."""
    return record.file.removeprefix("images/")


def _job(
    folder: Path, project: Project, records: list[ImageRecord], masks: Path | None, params: PosesParams, extend: bool
) -> dict[str, Any]:
    video = (folder / FRAMES_FOLDER / FRAMES_FILE).is_file()  # else it is a folder of photos that is called so
    frames = [video and Path(record.source).parent.name == FRAMES_FOLDER for record in records]
    return {
        "image_folder": str((folder / "images").resolve()),
        "masks": str(masks.resolve()) if masks else None,
        "work": str((folder / WORK_FOLDER).resolve()),
        "sparse": str((folder / SPARSE_FOLDER).resolve()),
        "start": str((folder / SPARSE_FOLDER).resolve()) if extend else None,
        "preset": params.preset,
        "restart": params.restart,
        "group": params.group,
        "neighbours": VIDEO_NEIGHBOURS if any(frames) else PHOTO_NEIGHBOURS,
        "video": all(frames),
        "images": [
            {
                "file": _database_name(record),
                "group": group,
                "width": record.width,
                "height": record.height,
                "focal_px": record.focal_px,
            }
            for record, group in zip(records, lens_groups(records))
        ],
    }


def _poses(result: dict[str, Any], records: list[ImageRecord]) -> tuple[Poses, Points, tuple[np.ndarray, np.ndarray]]:
    names = {_database_name(record): record.name for record in records}
    images = [
        PosedImage(name=names[image["file"]], camera=image["camera"], camera_to_world=image["camera_to_world"])
        for image in result["images"]
        if image["status"] == "ok"
    ]
    poses = Poses(
        source="sfm",
        cameras=[Camera.model_validate(camera) for camera in result["cameras"]],
        images=images,
        reprojection_px=result["reprojection_px"],
    )
    with np.load(result["points_file"], allow_pickle=False) as data:
        points = Points(data["xyz"], data["rgb"], data["error"])
        return poses, points, (data["view"], data["point"])


def _set_statuses(records: list[ImageRecord], result: dict[str, Any]) -> None:
    for record, image in zip(records, result["images"]):
        record.status = image["status"]
        record.reason = image["reason"]


def _upright_frame(project: Project, poses: Poses, points: Points) -> tuple[Frame, dict[str, float] | None]:
    """The world as cameras, points and GPS positions suggest it, and what is told of the latter where they were used."""
    matrices = [np.array(image.camera_to_world) for image in poses.images]
    world_from_sfm, confidence = upright(matrices, points.xyz)
    measured, gps = gps_frame(world_from_sfm, project, poses) or (world_from_sfm, None)
    frame = Frame(world_from_sfm=measured.tolist(), up_confidence=confidence, scale_known=gps is not None)
    return frame, gps


def _write_report(
    folder: Path,
    project: Project,
    poses: Poses,
    points: Points,
    records: list[ImageRecord],
    result: dict[str, Any],
    report: Reporter,
) -> None:
    """What is known about every photo, as JSON and as a picture."""
    names = {_database_name(record): record.name for record in records}
    write_json(
        folder / REPORT_FILE,
        {
            "level": result["level"],
            "groups": result["groups"],
            "contradicting_pairs": result["contradicting_pairs"],
            "reprojection_px": result["reprojection_px"],
            "points": len(points),
            "up_confidence": project.frame.up_confidence,
            "images": [
                {
                    "name": names[image["file"]],
                    **{k: v for k, v in image.items() if k not in ("file", "camera_to_world")},
                }
                for image in result["images"]
            ],
            "links": [[names[a], names[b], count] for a, b, count in result["links"]],
        },
    )
    from .report import draw_report

    report.stage("Drawing the report")
    draw_report(folder / PICTURE_FILE, project, poses, points, records, result["links"], names)
    report.event("preview", path=str(folder / PICTURE_FILE))
