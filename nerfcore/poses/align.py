"""The verb `align`: which way is up, how large things are, where the ground is, what belongs to the scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import PosesError, SettingError
from ..geometry.frames import on_ground, rotation_to_z
from ..geometry.points import Points
from ..geometry.similarity import similarity_scale, transform_points, transform_pose
from ..params import AlignParams
from ..progress import Reporter
from ..project.schema import Poses, Project
from ..project.store import edit_project, load_points, load_poses, world_from_sfm
from .gps import fit_gps

AXES = {f"{sign}{axis}": value * np.eye(3)[i] for i, axis in enumerate("xyz") for sign, value in (("", 1), ("-", -1))}
CROP_QUANTILES, CROP_MARGIN = (0.02, 0.98), 0.1  # of the points' coordinates; of the box; not tuned


def align(params: AlignParams, report: Reporter) -> dict[str, Any]:
    """Change the world frame of a project; poses and points stay as they are in the SfM frame.

    Steps, in this order, each if asked for: up, GPS, scale, ground, crop. Directions and points are given in the
    world as it is before the call, the crop box in the world after it. An existing crop box moves along.

    Returns:
        {"transform": world_from_sfm (4×4), "scale_known", "up_confidence", "bounds"}
    Raises:
        ProjectError, PosesError (GPS or ground say nothing), SettingError (a value cannot be understood).
    """
    folder = Path(params.project)
    poses, points = load_poses(folder), load_points(folder)
    report.stage("Aligning")
    with edit_project(folder) as project:
        result = _aligned(project, poses, points, params)
        project.record("align", params.model_dump(mode="json"), result)
    return result


def _aligned(project: Project, poses: Poses, points: Points, params: AlignParams) -> dict[str, Any]:
    """Change the frame of the project; what the verb returns."""
    before = world_from_sfm(project)
    frame = before
    result: dict[str, Any] = {}
    if params.up is not None:
        turn = np.eye(4)
        turn[:3, :3] = rotation_to_z(_direction(params.up))
        frame = turn @ frame
        project.frame.up_confidence = 1.0
    if params.gps:
        frame, result["gps"] = _by_gps(frame, project, poses)
        project.frame.scale_known = True
    if params.scale is not None:
        # Lengths do not depend on the turns above, only on the scale, which GPS may have changed.
        factor = _scale_factor(params.scale, before, poses) * similarity_scale(before) / similarity_scale(frame)
        frame = np.diag([factor, factor, factor, 1.0]) @ frame
        project.frame.scale_known = True
    if params.ground:
        grounded = on_ground(points.xyz, frame)
        if grounded is None:
            raise PosesError(
                "No level ground is evident in the sparse points.", "Set the up direction with --up, or leave it."
            )
        frame = grounded
    if project.frame.bounds is not None:
        project.frame.bounds = _moved_box(np.array(project.frame.bounds), frame @ np.linalg.inv(before)).tolist()
    if params.crop is not None:
        project.frame.bounds = _crop(params.crop, points, poses, frame)
    project.frame.world_from_sfm = frame.tolist()
    result |= {
        "transform": frame.tolist(),
        "scale_known": project.frame.scale_known,
        "up_confidence": project.frame.up_confidence,
        "bounds": project.frame.bounds,
    }
    return result


def _numbers(text: str, count: int, what: str) -> np.ndarray:
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError as error:
        raise SettingError(f"{what} {text!r} is not understood.", f"Give {count} numbers with commas.") from error
    if len(values) != count:
        raise SettingError(f"{what} {text!r} has {len(values)} numbers.", f"Give {count} numbers with commas.")
    if not np.isfinite(values).all():
        raise SettingError(f"{what} {text!r} has numbers that are not finite.", f"Give {count} finite numbers.")
    return values


def _direction(text: str) -> np.ndarray:
    key = text.strip().lower().removeprefix("+")
    value = AXES[key] if key in AXES else _numbers(text, 3, "The up direction")
    if np.linalg.norm(value) < 1e-9:
        raise SettingError("The up direction has no length.", "Give x, -x, y, -y, z, -z or three numbers.")
    return value


def _scale_factor(scale: tuple[str, str, float], frame: np.ndarray, poses: Poses) -> float:
    first, second, metres = scale
    if not np.isfinite(metres) or metres <= 0:
        raise SettingError(f"The distance {metres:g} is not positive.", "Give metres, such as 0.85.")
    length = float(np.linalg.norm(placed_point(first, frame, poses) - placed_point(second, frame, poses)))
    if length < 1e-9:
        raise SettingError(f"{first} and {second} are the same place.", "Choose two that are well apart.")
    return metres / length


def placed_point(text: str, frame: np.ndarray, poses: Poses) -> np.ndarray:
    """A point (3,) of the world: three numbers with commas, or the centre of the camera of that name; `frame` (4, 4):
    world from sfm.

    Raises:
        SettingError: it is neither.
    """
    for image in poses.images:
        if image.name == text:
            return transform_pose(frame, np.array(image.camera_to_world))[:3, 3]
    if "," not in text:
        known = ", ".join(image.name for image in poses.images[:3])
        raise SettingError(f"No placed photo is called {text!r}.", f"Names are for example {known}; points are x,y,z.")
    return _numbers(text, 3, "The point")


def _by_gps(frame: np.ndarray, project: Project, poses: Poses) -> tuple[np.ndarray, dict[str, float]]:
    positions = {record.name: record.exif["gps"] for record in project.images if record.exif.get("gps")}
    placed = [image for image in poses.images if image.name in positions]
    centers = np.array([transform_points(frame, np.array(image.camera_to_world)[:3, 3]) for image in placed])
    latitude = np.array([positions[image.name]["latitude"] for image in placed])
    longitude = np.array([positions[image.name]["longitude"] for image in placed])
    fit = fit_gps(centers.reshape(-1, 3), latitude, longitude)
    facts = {"latitude": fit.origin[0], "longitude": fit.origin[1], "residual_m": fit.residual}
    return fit.turn @ frame, facts


def gps_frame(frame: np.ndarray, project: Project, poses: Poses) -> tuple[np.ndarray, dict[str, float]] | None:
    """The frame with scale and heading from GPS and what `align` tells of them, or None where GPS says nothing."""
    try:
        return _by_gps(frame, project, poses)
    except PosesError:
        return None


def _moved_box(box: np.ndarray, motion: np.ndarray) -> np.ndarray:
    corners = np.stack(np.meshgrid(*box.T, indexing="ij"), -1).reshape(-1, 3)
    moved = transform_points(motion, corners)
    return np.stack([moved.min(0), moved.max(0)])


def _crop(text: str, points: Points, poses: Poses, frame: np.ndarray) -> list[list[float]] | None:
    if text == "none":
        return None
    if text == "auto":
        return automatic_crop(transform_points(frame, points.xyz), poses, frame).tolist()
    values = _numbers(text, 6, "The crop box").reshape(2, 3)
    if (values[1] <= values[0]).any():
        raise SettingError(f"The crop box {text} is empty.", "Give x0,y0,z0,x1,y1,z1 with x0 < x1, y0 < y1, z0 < z1.")
    return values.tolist()


def automatic_crop(points: np.ndarray, poses: Poses, frame: np.ndarray) -> np.ndarray:
    """A box (2, 3) around the subject: the bulk of the points that are nearer to the middle than the cameras."""
    if len(points) < 20:
        raise PosesError("There are too few sparse points for an automatic crop box.", "Give it as six numbers.")
    middle = np.median(points, axis=0)
    centers = np.array([transform_points(frame, np.array(image.camera_to_world)[:3, 3]) for image in poses.images])
    reach = float(np.median(np.linalg.norm(centers - middle, axis=1)))
    near = points[np.linalg.norm(points - middle, axis=1) < reach]
    low, high = np.quantile(near if len(near) >= 20 else points, CROP_QUANTILES, axis=0)
    margin = CROP_MARGIN * (high - low)
    return np.stack([low - margin, high + margin])
