"""Strecha's multi-view sets: for each photo a `<photo>.camera` with K, three zeros, R (camera-to-world), C, size."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import InputError
from ...geometry.frames import axis_upright
from ...images.decode import image_size
from ...images.names import beside, find_image, plain_name
from ..dataset import Dataset, DatasetView, lens_at_size, require
from .matrices import camera_from_matrix, read_numbers


def matches(folder: Path) -> bool:
    return folder.is_dir() and any(_camera_files(folder))


def _camera_files(folder: Path) -> list[Path]:
    return sorted(p for place in (folder, folder / "cameras", folder / "images") for p in place.glob("*.camera"))


def read(folder: Path) -> Dataset:
    """Read `folder`. Raises InputError naming the file that is missing or damaged."""
    views, missing = [], []
    for file in _camera_files(folder):
        name = file.name.removesuffix(".camera")
        image = next((i for d in (folder / "images", folder, file.parent) if (i := find_image(d / name))), None)
        image = image or find_image(folder / "images" / Path(name).stem)
        if image is None:
            missing.append(name)
            continue
        rows = read_numbers(file)
        if [len(row) for row in rows[:8]] != [3] * 8 or len(rows) < 9 or len(rows[8]) < 2:
            raise InputError(f"{file} is not a camera file of nine lines.", "Download the data set again.")
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = np.array(rows[4:7]), rows[7]
        full_size = int(rows[8][0]), int(rows[8][1])
        stem = image.stem
        views.append(
            DatasetView(
                name=plain_name(image),
                image=image,
                camera=lens_at_size(camera_from_matrix(np.array(rows[:3]), full_size), image_size(image), image),
                camera_to_world=pose,
                label=beside(folder / "labels", stem),
                mask=beside(folder / "masks", stem, exact=False),
            )
        )
    require(views, folder, missing)
    frame = axis_upright([view.camera_to_world for view in views])
    warnings = [f"{len(missing)} photos of camera files are missing (first: {missing[0]})."] if missing else []
    return Dataset("strecha", views, frame, scale_known=True, warnings=warnings)
