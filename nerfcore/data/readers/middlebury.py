"""Middlebury multi-view sets: `*_par.txt` with, per photo, its file name, K, R and t (world-to-camera), in metres."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...capture.images import image_size
from ...errors import InputError
from ..dataset import Dataset, DatasetView, beside, find_image, require
from ..frames import axis_upright
from .matrices import camera_from_matrix, pose_from_world_to_camera


def matches(folder: Path) -> bool:
    return folder.is_dir() and any(folder.glob("*_par.txt"))


def read(folder: Path) -> Dataset:
    """Read `folder`. Raises InputError naming the file that is missing or damaged."""
    file = next(iter(sorted(folder.glob("*_par.txt"))), None)
    if file is None:
        raise InputError(f"{folder} has no *_par.txt.", "Choose the folder that holds it.")
    views, missing = [], []
    for line in file.read_text(encoding="utf-8").splitlines()[1:]:
        fields = line.split()
        if not fields:
            continue
        try:
            values = np.array(fields[1:], np.float64)
        except ValueError as error:
            raise InputError(f"{file} is damaged at {fields[0]}: {error}.", "Download the data set again.") from error
        if len(values) != 21:
            raise InputError(f"{file} is damaged at {fields[0]}: not 21 numbers.", "Download the data set again.")
        image = find_image(folder / fields[0]) or find_image(folder / "images" / fields[0])
        if image is None:
            missing.append(fields[0])
            continue
        views.append(
            DatasetView(
                name=image.stem,
                image=image,
                camera=camera_from_matrix(values[:9].reshape(3, 3), image_size(image)),
                camera_to_world=pose_from_world_to_camera(values[9:18].reshape(3, 3), values[18:]),
                label=beside(folder / "labels", image.stem),
                mask=beside(folder / "masks", image.stem, exact=False),
            )
        )
    require(views, folder, missing)
    warnings = [f"{len(missing)} photos named in {file.name} are missing (first: {missing[0]})."] if missing else []
    frame = axis_upright([view.camera_to_world for view in views])
    return Dataset(format="middlebury", views=views, world_from_sfm=frame, scale_known=True, warnings=warnings)
