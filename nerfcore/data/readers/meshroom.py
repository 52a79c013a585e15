"""Meshroom (AliceVision): `cameras.sfm`, `sfm.json` or any `*.sfm` in JSON.

Rotations are stored column by column as world-to-camera matrices, OpenCV axes; centres in the world. The focal length
is in millimetres of a sensor as wide as the image; "pixelRatio" is the focal length in pixels along y by
that along x, before version 1.2.5 the other way round. The principal point is an offset from the middle in pixels (in old files:
absolute). Photos that a rig took at once share a pose, that of the rig; how each camera stands in it the rig says. Source:
AliceVision, sfmDataIO/jsonIO.cpp and sfmData/SfMData.hpp.
"""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...geometry.cameras import Camera
from ...geometry.frames import upright
from ...images.decode import image_size
from ...images.names import find_image, labels_and_masks, unique_names
from ...progress import shortened
from ..dataset import Dataset, DatasetView, lens_at_size, not_imported, require

RATIO_OF_PIXELS = [1, 2, 5]  # the version from which "pixelRatio" is that of pixels
UNPLACED = "uninitialized"  # status of a camera of a rig of which nothing is known
RADIAL = {"radial1": 1, "radial3": 3, "radialk1": 1, "radialk3": 3}


def matches(folder: Path) -> bool:
    return _file(folder) is not None


def _file(folder: Path) -> Path | None:
    candidates = [folder] if folder.is_file() else [*sorted(folder.glob("*.sfm")), folder / "sfm.json"]
    for path in candidates:
        if path.suffix in (".sfm", ".json") and path.is_file():
            head = path.read_bytes()[:20000]
            if b'"views"' in head and b'"viewId"' in head:
                return path
    return None


def read(folder: Path) -> Dataset:
    """Read `folder` or the file. Raises InputError naming the file that is missing or damaged."""
    path = _file(folder)
    if path is None:
        raise InputError(f"{folder} has no Meshroom cameras.", "Use the node ConvertSfMFormat to write a .sfm file.")
    folder = path.parent
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
        version = [int(part) for part in value.get("version", RATIO_OF_PIXELS)]
        intrinsics = {entry["intrinsicId"]: entry for entry in value["intrinsics"]}
        poses = {entry["poseId"]: entry["pose"]["transform"] for entry in value.get("poses", [])}
        rigs = {entry["rigId"]: entry["subPoses"] for entry in value.get("rigs") or []}
        shared = Counter(view.get("poseId") for view in value["views"])
        views = [(view, _in_rig(view, rigs, shared[view.get("poseId")] > 1)) for view in value["views"]]
        placed = [(v, rig) for v, rig in views if v.get("poseId") in poses and (rig or {}).get("status") != UNPLACED]
        known = {view["viewId"] for view, _ in placed}
        without = [_source(view).name for view, _ in views if view["viewId"] not in known]
        entries = [
            (_source(view), intrinsics[view["intrinsicId"]], poses[view["poseId"]], rig and rig["pose"])
            for view, rig in placed
        ]
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InputError(f"{path} is damaged: {error!r}.", "Export the cameras from Meshroom again.") from error
    found, missing = [], []
    for source, *more in entries:
        places = (source, folder / source.name, folder / "images" / source.name)
        image = next((p for place in places if (p := find_image(place))), None)
        if image is None:
            missing.append(str(source))
        else:
            found.append((image, *more))
    found.sort(key=lambda entry: entry[0])
    names = unique_names([image for image, *_ in found], folder)
    views = []
    companions = labels_and_masks(folder, [image for image, *_ in found], names)
    for name, (image, intrinsic, transform, in_rig), (label, mask) in zip(names, found, companions):
        try:
            pose = _pose(transform) if in_rig is None else _pose(transform) @ _pose(in_rig)
            camera = _camera(intrinsic, version, image, path)
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"{path} is damaged at {image.name}: {error!r}.", "Export the cameras again.") from error
        views.append(
            DatasetView(
                name=name,
                image=image,
                camera=camera,
                camera_to_world=pose,
                label=label,
                mask=mask,
            )
        )
    require(views, path, missing)
    frame, confidence = upright([view.camera_to_world for view in views])
    warnings = [shortened(not_imported(len(without), path), without)] if without else []
    warnings += [f"{len(missing)} photos of the export are missing (first: {missing[0]})."] if missing else []
    return Dataset("meshroom", views, frame, confidence, warnings=warnings)


def _source(view: dict[str, Any]) -> Path:
    """Where a photo was, on a machine that may have had backslashes in its paths."""
    return Path(view["path"].replace("\\", "/"))


def _in_rig(view: dict[str, Any], rigs: dict[Any, Any], shared: bool) -> dict[str, Any] | None:
    """The entry for the camera of a photo in the rig whose pose the photo has; None where that pose is its own: rigs of which
    little was placed have photos of both kinds. `shared`: whether other photos have the same pose; older files say no more."""
    own = view.get("isPoseIndependant", "false" if shared else "true")
    if view.get("rigId") not in rigs or str(own).lower() == "true":
        return None
    return rigs[view["rigId"]][int(view["subPoseId"])]


def _pose(transform: dict[str, Any]) -> np.ndarray:
    """Camera-to-world (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([float(v) for v in transform["rotation"]]).reshape(3, 3)
    pose[:3, 3] = [float(v) for v in transform["center"]]
    return pose


def _camera(value: dict[str, Any], version: list[int], image: Path, path: Path) -> Camera:
    width, height = int(value["width"]), int(value["height"])
    if "pxFocalLength" in value:
        focal = value["pxFocalLength"]
        fx, fy = (float(f) for f in focal) if isinstance(focal, list) else (float(focal), float(focal))
    else:
        fx = float(value["focalLength"]) / float(value["sensorWidth"]) * width
        ratio = float(value.get("pixelRatio", 1.0))
        fy = fx * ratio if version >= RATIO_OF_PIXELS else fx / ratio
    cx, cy = (float(v) for v in value.get("principalPoint", (0, 0)))
    if abs(cx) < 0.25 * width and abs(cy) < 0.25 * height:
        cx, cy = cx + width / 2, cy + height / 2
    kind = str(value.get("distortionType") or value.get("type", "pinhole")).lower()
    raw = value.get("distortionParams") or []
    params = [float(v) for v in raw] if isinstance(raw, list) else []
    placed = {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    if not any(params) and kind not in ("fisheye4", "equidistant"):
        camera = Camera(**placed)
    elif kind in RADIAL:
        k1, k2, k3 = (params + [0.0] * 3)[:3]
        camera = Camera(model="OPENCV", distortion=(k1, k2, 0.0, 0.0) + ((k3,) if k3 else ()), **placed)
    elif kind == "brown":
        k1, k2, k3, t1, t2 = (params + [0.0] * 5)[:5]
        camera = Camera(model="OPENCV", distortion=(k1, k2, t1, t2) + ((k3,) if k3 else ()), **placed)
    elif kind == "fisheye4":
        k1, k2, k3, k4 = (params + [0.0] * 4)[:4]
        camera = Camera(model="OPENCV_FISHEYE", distortion=(k1, k2, k3, k4), **placed)
    else:
        raise InputError(f"{path} uses the lens model {kind}.", "Undistort the photos in Meshroom and export again.")
    return lens_at_size(camera, image_size(image), image)
