"""Replica renderings: `rgb/`, `depth/`, `semantic_class/` with `traj_w_c.txt`, or `results/` with `traj.txt`.

Each row of the trajectory is a camera-to-world matrix with OpenCV axes. The first layout has a field of view of 90°;
the second takes its camera from `cam_params.json` beside it or in the parent folder. Metric.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np

from ...errors import InputError
from ...geometry.cameras import Camera
from ...geometry.frames import axis_upright
from ...images.decode import image_size
from ...images.names import list_images, plain_name
from ..dataset import Dataset, DatasetView, lens_at_size, require
from .matrices import read_numbers

TRAJECTORIES = ("traj_w_c.txt", "traj.txt")
LABEL_FOLDERS = ("semantic_class", "labels", "semantic")


def matches(folder: Path) -> bool:
    return any((folder / name).is_file() for name in TRAJECTORIES)


def read(folder: Path) -> Dataset:
    """Read `folder`. Raises InputError naming the file that is missing or damaged."""
    trajectory = next((folder / name for name in TRAJECTORIES if (folder / name).is_file()), None)
    if trajectory is None:
        raise InputError(f"{folder} has no traj_w_c.txt.", "Choose the folder of one rendered sequence.")
    rows = read_numbers(trajectory)
    if any(len(row) != 16 for row in rows):
        raise InputError(f"{trajectory} has rows that are no 4×4 matrices.", "Download the data set again.")
    poses = np.array(rows).reshape(-1, 4, 4)
    results = list_images(folder / "results")
    images = _by_number(list_images(folder / "rgb") or [p for p in results if not p.stem.startswith("depth")])
    depths = _by_number(list_images(folder / "depth") or [p for p in results if p.stem.startswith("depth")])
    labels = _by_number(next((found for name in LABEL_FOLDERS if (found := list_images(folder / name))), []))
    params = next((p for p in (folder / "cam_params.json", folder.parent / "cam_params.json") if p.is_file()), None)
    camera, depth_scale = _camera(params)
    views = []
    for number, image in sorted(images.items()):
        if number >= len(poses):
            raise InputError(
                f"{trajectory} has {len(poses)} poses, but there is an image {image.name}.", "Complete it."
            )
        size = image_size(image)
        own = camera or Camera(
            width=size[0], height=size[1], fx=size[0] / 2, fy=size[0] / 2, cx=size[0] / 2, cy=size[1] / 2
        )
        views.append(
            DatasetView(
                name=plain_name(image),
                image=image,
                camera=lens_at_size(own, size, image),
                camera_to_world=poses[number],
                label=labels.get(number),
                depth=depths.get(number),
                depth_scale=depth_scale,
            )
        )
    require(views, folder)
    frame = axis_upright([view.camera_to_world for view in views])
    return Dataset(
        format="replica",
        views=views,
        world_from_sfm=frame,
        scale_known=True,
        class_names=_classes(folder),
    )


def _by_number(paths: list[Path]) -> dict[int, Path]:
    found = {}
    for path in paths:
        if digits := re.findall(r"\d+", path.stem):
            found[int(digits[-1])] = path
    return found


def _camera(params: Path | None) -> tuple[Camera | None, float]:
    """Camera and metres per depth unit; None for a field of view of 90° and millimetres."""
    if params is None:
        return None, 1e-3
    try:
        value = json.loads(params.read_text(encoding="utf-8"))["camera"]
        # These cameras are given with pixel centres at integers.
        center = {"cx": value["cx"] + 0.5, "cy": value["cy"] + 0.5}
        camera = Camera(width=value["w"], height=value["h"], fx=value["fx"], fy=value["fy"], **center)
        return camera, 1.0 / float(value.get("scale", 1000.0))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{params} cannot be read: {error}.", "Download the data set again.") from error


def _classes(folder: Path) -> dict[int, str]:
    """Names by id as Replica has them."""
    info = next((p for d in (folder, folder.parent) if (p := d / "info_semantic.json").is_file()), None)
    if info is None:
        return {}
    try:
        entries = json.loads(info.read_text(encoding="utf-8"))["classes"]
        return {int(entry["id"]): str(entry["name"]) for entry in entries}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{info} cannot be read: {error}.", "Download the data set again.") from error
