"""transforms.json: NeRF's Blender scenes, Instant-NGP and nerfstudio.

Poses are camera-to-world with OpenGL camera axes (x right, y up, looking along −z); which way is up in their world,
`up_axis` says. Intrinsics stand at the top or in each frame.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import ValidationError

from ...errors import InputError, wrong_value
from ...geometry.cameras import Camera, flip_camera_axes, pose_matrix
from ...geometry.points import Points
from ...images.decode import image_size
from ...images.names import find_image, labels_and_masks, unique_names
from ..dataset import Dataset, DatasetView, lens_at_size, require
from ..up_axis import choose_up

SPLIT_FILES = {"transforms_train.json": "train", "transforms_test.json": "test", "transforms_val.json": "val"}
Split = Literal["train", "test", "auto"]


def matches(folder: Path) -> bool:
    """Whether `folder` is such a data set (or the JSON file of one)."""
    if folder.is_file():
        return folder.suffix == ".json"
    return (folder / "transforms.json").is_file() or (folder / "transforms_train.json").is_file()


def read(folder: Path) -> Dataset:
    """Read `folder` (or one transforms file).

    Raises:
        InputError: a file is missing, is not JSON or lacks what is needed; the message names it.
    """
    if folder.is_file():
        files: list[tuple[Path, Split]] = [(folder, "auto")]
        folder = folder.parent
    elif (folder / "transforms.json").is_file():
        files = [(folder / "transforms.json", "auto")]
    else:
        found = {split: folder / name for name, split in SPLIT_FILES.items() if (folder / name).is_file()}
        if not found:
            raise InputError(f"{folder} has no transforms.json.", "Choose the folder that holds it.")
        # Validation images are the held-out ones only where there are no test images.
        held_out = found.get("test") or found.get("val")
        files = [(found["train"], "train")] if "train" in found else []
        if held_out:
            files.append((held_out, "test"))
    frames: list[tuple[Path, dict[str, Any], dict[str, Any], Split]] = []
    missing: list[str] = []
    heads: list[dict[str, Any]] = []
    for file, split in files:
        head = _load(file)
        heads.append(head)
        splits = _named_splits(head)
        for frame in head["frames"]:
            try:
                place = _place(frame["file_path"])
                image, frame_split = find_image(folder / place), splits.get(place.as_posix(), split)
            except (KeyError, TypeError) as error:
                raise InputError(f"{file} has a frame without file_path.", "Export the data set again.") from error
            if image is None:
                missing.append(str(frame["file_path"]))
            else:
                frames.append((image, {**head, **frame}, frame, frame_split))
    names = unique_names([image for image, *_ in frames], folder)
    companions = labels_and_masks(folder, [image for image, *_ in frames], names)
    lost: dict[str, list[str]] = {"label maps": [], "masks": [], "depth maps": []}
    views = [
        _view(folder, name, image, merged, split, both, lost)
        for name, (image, merged, _, split), both in zip(names, frames, companions)
    ]
    require(views, folder, missing)
    points, untold = _points(folder, heads[0])
    warnings = [
        f"{len(names)} {what} named in {files[0][0].name} are missing (first: {names[0]})."
        for what, names in {"images": missing, **lost}.items()
        if names
    ]
    convention = str(heads[0].get("camera_convention", "")).lower()
    up = choose_up(heads[0], [view.camera_to_world for view in views], named_splits=files[0][0].name in SPLIT_FILES)
    return Dataset(
        format="transforms",
        views=views,
        world_from_sfm=up.world_from_sfm,
        up_confidence=up.confidence,
        scale_known=re.search(r"\bmet(re|er)s\b", convention) is not None,
        mask_mode=mode if (mode := heads[0].get("mask_mode")) in ("ignore", "empty") else None,
        points=points,
        warnings=[*warnings, *untold, *up.warnings],
    )


def _load(file: Path) -> dict[str, Any]:
    try:
        value = json.loads(file.read_text(encoding="utf-8-sig"))
    except RecursionError as error:
        raise InputError(f"{file} is nested too deeply.", "Choose another data set.") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{file} cannot be read: {error}.", "Export the data set again.") from error
    if not isinstance(value, dict) or not isinstance(value.get("frames"), list):
        raise InputError(f"{file} is not a transforms.json: it has no frames.", "Choose another data set.")
    return value


def _named_splits(head: dict[str, Any]) -> dict[str, Split]:
    """Splits by file path from nerfstudio's train_filenames, val_filenames and test_filenames."""
    test = head.get("test_filenames") or head.get("val_filenames")
    if not test:
        return {}
    splits: dict[str, Split] = {_place(name).as_posix(): "train" for name in head.get("train_filenames", [])}
    return {**splits, **{_place(name).as_posix(): "test" for name in test}}


def _place(text: str) -> Path:
    """A path as files give it, which on Windows has backslashes. Raises TypeError where it is none."""
    if not isinstance(text, str):
        raise TypeError(f"{text!r} is no path")
    return Path(text.replace("\\", "/"))


def _view(
    folder: Path,
    name: str,
    image: Path,
    frame: dict[str, Any],
    split: Split,
    companions: tuple[Path | None, Path | None],
    lost: dict[str, list[str]],
) -> DatasetView:
    """One frame; the files that it names and that are missing are added to those `lost`, by what they are."""
    width, height = image_size(image)
    matrix = pose_matrix(frame.get("transform_matrix"))
    if matrix is None:
        raise InputError(f"The pose of {image.name} in {folder} is not a 4×4 matrix.", "Export the data set again.")
    label_path = frame.get("semantic_path") or frame.get("label_path")
    depth = _optional(folder, frame.get("depth_file_path") or frame.get("depth_path"), lost["depth maps"])
    label = _optional(folder, label_path, lost["label maps"]) or companions[0]
    mask = _optional(folder, frame.get("mask_path"), lost["masks"]) or companions[1]
    return DatasetView(
        name=name,
        image=image,
        camera=lens_at_size(_lens(frame, width, height, name, folder), (width, height), image),
        camera_to_world=flip_camera_axes(matrix),
        label=label,
        mask=mask,
        depth=depth,
        depth_scale=_depth_scale(frame, depth),
        split=split,
    )


def _lens(frame: dict[str, Any], width: int, height: int, name: str, folder: Path) -> Camera:
    """`frame_camera`, whose errors name the frame."""
    try:
        return frame_camera(frame, width, height)
    except InputError as error:
        raise InputError(f"The lens of {name} in {folder} cannot be read: {error.message}", error.hint) from error
    except (TypeError, ValueError, OverflowError, ZeroDivisionError) as error:
        reason = wrong_value(error.errors()[0]) if isinstance(error, ValidationError) else error
        raise InputError(
            f"The lens of {name} in {folder} cannot be read: {reason}.", "Export the data set again."
        ) from error


def _depth_scale(frame: dict[str, Any], depth: Path | None) -> float:
    # nerfstudio: depth files in millimetres unless the file says otherwise; Instant-NGP: integer_depth_scale. EXR files
    # hold what a renderer measured, in the units of the poses.
    for key in ("depth_unit_scale_factor", "integer_depth_scale"):
        if key in frame:
            return float(frame[key])
    return 1.0 if depth is not None and depth.suffix.lower() == ".exr" else 1e-3


def _optional(folder: Path, value: Any, lost: list[str]) -> Path | None:
    """The file that a frame names; None where it names none, or one that is missing, which is added to `lost`."""
    if not isinstance(value, str) or not value:
        return None
    found = find_image(folder / _place(value))
    if found is None:
        lost.append(value)
    return found


def frame_camera(frame: dict[str, Any], width: int, height: int) -> Camera:
    """Intrinsics of a frame (its own keys over those of the file), at the size it gives, else for width × height pixels.

    Raises:
        InputError: neither a focal length nor a field of view is given, or the lens model is unknown.
    """
    w, h = int(frame.get("w", width)), int(frame.get("h", height))
    k = [float(frame.get(f"k{i}", 0.0)) for i in range(1, 5)]
    p1, p2 = float(frame.get("p1", 0.0)), float(frame.get("p2", 0.0))
    model = str(frame.get("camera_model", "OPENCV")).upper()
    if model in ("EQUIRECTANGULAR", "SPHERICAL") or frame.get("is_equirectangular"):
        return Camera(model="EQUIRECTANGULAR", width=width, height=height, fx=w / 2, fy=w / 2, cx=w / 2, cy=h / 2)
    if "fl_x" in frame:
        fx = float(frame["fl_x"])
        fy = float(frame.get("fl_y", fx))
    elif "camera_angle_x" in frame:
        fx = 0.5 * w / math.tan(0.5 * float(frame["camera_angle_x"]))
        angle_y = frame.get("camera_angle_y")
        fy = 0.5 * h / math.tan(0.5 * float(angle_y)) if angle_y else fx
    else:
        raise InputError("The transforms file gives no focal length.", "It needs fl_x or camera_angle_x.")
    center = {"cx": float(frame.get("cx", w / 2)), "cy": float(frame.get("cy", h / 2))}
    if model in ("OPENCV_FISHEYE", "FISHEYE") or frame.get("is_fisheye"):
        camera = Camera(
            model="OPENCV_FISHEYE", width=w, height=h, fx=fx, fy=fy, distortion=(k[0], k[1], k[2], k[3]), **center
        )
    elif model in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"):
        if k[3]:
            raise InputError("A perspective lens with four radial terms is not supported.", "Undistort the images.")
        distortion = (k[0], k[1], p1, p2) + ((k[2],) if k[2] else ())
        distorted = any(distortion) and "PINHOLE" not in model
        camera = Camera(
            model="OPENCV" if distorted else "PINHOLE",
            width=w,
            height=h,
            fx=fx,
            fy=fy,
            distortion=distortion if distorted else (),
            **center,
        )
    else:
        raise InputError(f"The lens model {model} is not supported.", "Undistort the images and export again.")
    return camera


def _points(folder: Path, head: dict[str, Any]) -> tuple[Points, list[str]]:
    """nerfstudio's sparse point cloud, which lies in the frame of the poses, and why there is none where one is named."""
    name = head.get("ply_file_path")
    if not isinstance(name, str) or not name:
        return Points.empty(), []
    path = folder / _place(name)
    if not path.is_file():
        return Points.empty(), [f"The points {name} are missing."]
    if path.suffix.lower() != ".ply":
        return Points.empty(), [f"The points {name} are not read: only PLY files are."]
    import trimesh

    cloud = trimesh.load(path)
    xyz = np.asarray(getattr(cloud, "vertices", np.zeros((0, 3))), np.float64)
    colors = getattr(cloud, "colors", None)
    rgb = np.asarray(colors)[:, :3].astype(np.uint8) if colors is not None and len(colors) == len(xyz) else None
    return Points(xyz, rgb if rgb is not None else np.full((len(xyz), 3), 128, np.uint8), np.zeros(len(xyz))), []
