"""ScanNet's exported layout: `color/`, `pose/*.txt` (camera-to-world), `intrinsic/`, `depth/`, `label-filt/`.

Metric, z up. Depth is in millimetres and may be smaller than the colour images; frames whose pose is not finite are
left out. Pixel centres are at integers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import InputError
from ...geometry.frames import axis_upright
from ...images.decode import image_size
from ...images.names import beside, list_images, plain_name
from ..dataset import Dataset, DatasetView, require
from .matrices import camera_from_matrix, read_numbers

COLOR_FOLDERS, LABEL_FOLDERS = ("color", "rgb", "images"), ("label-filt", "label", "labels", "semantic")
INTRINSICS = ("intrinsic/intrinsic_color.txt", "intrinsic_color.txt", "intrinsics.txt", "intrinsic.txt")


def matches(folder: Path) -> bool:
    return any((folder / name).is_dir() and any((folder / name).glob("*.txt")) for name in ("pose", "poses"))


def read(folder: Path) -> Dataset:
    """Read `folder`. Raises InputError naming the file that is missing or damaged."""
    colors = next((found for name in COLOR_FOLDERS if (found := list_images(folder / name))), [])
    poses = folder / ("pose" if (folder / "pose").is_dir() else "poses")
    file = next((folder / name for name in INTRINSICS if (folder / name).is_file()), None)
    if file is None:
        raise InputError(f"{folder} has no intrinsic/intrinsic_color.txt.", "Export the scan with its intrinsics.")
    rows = read_numbers(file)
    if len(rows) < 3 or any(len(row) < 3 for row in rows[:3]):
        raise InputError(f"{file} is not a 3×3 or 4×4 matrix.", "Export the scan again.")
    k = np.array([row[:3] for row in rows[:3]])
    views, lost, missing = [], 0, []
    for image in colors:
        pose_file = poses / f"{image.stem}.txt"
        if not pose_file.is_file():
            missing.append(str(pose_file))
            continue
        pose = np.array(read_numbers(pose_file)) if pose_file.stat().st_size else np.zeros(0)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            lost += 1
            continue
        label = next((p for name in LABEL_FOLDERS if (p := beside(folder / name, image.stem))), None)
        views.append(
            DatasetView(
                name=plain_name(image),
                image=image,
                camera=camera_from_matrix(k, image_size(image)),
                camera_to_world=pose,
                label=label,
                mask=beside(folder / "masks", image.stem, exact=False),
                depth=beside(folder / "depth", image.stem),
                depth_scale=1e-3,
            )
        )
    require(views, folder, missing)
    frame = axis_upright([view.camera_to_world for view in views])
    warnings = [f"{lost} frames have no valid pose and are left out."] if lost else []
    if missing:
        warnings.append(f"{len(missing)} photos are left out, whose pose files are missing (first: {missing[0]}).")
    return Dataset("scannet", views, frame, scale_known=True, warnings=warnings)
