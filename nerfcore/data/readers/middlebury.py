"""Middlebury multi-view sets: `*_par.txt` with, per photo, its file name, K, R and t (world-to-camera), in metres."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import InputError
from ...geometry.frames import axis_upright
from ...images.decode import image_size, read_photo
from ...images.names import beside, find_image, plain_name
from ...images.sharpness import thumbnail
from ..dataset import Dataset, DatasetView, require
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
                name=plain_name(image),
                image=image,
                camera=camera_from_matrix(values[:9].reshape(3, 3), image_size(image)),
                camera_to_world=pose_from_world_to_camera(values[9:18].reshape(3, 3), values[18:]),
                label=beside(folder / "labels", image.stem),
                mask=beside(folder / "masks", image.stem, exact=False),
            )
        )
    require(views, folder, missing)
    views, turned = _turn_back(views)
    warnings = [f"{len(missing)} photos named in {file.name} are missing (first: {missing[0]})."] if missing else []
    if turned:
        warnings.append(f"{turned} photos are stored upside down for their camera matrices; the cameras were turned.")
    frame = axis_upright([view.camera_to_world for view in views])
    return Dataset(format="middlebury", views=views, world_from_sfm=frame, scale_known=True, warnings=warnings)


def _turn_back(views: list[DatasetView]) -> tuple[list[DatasetView], int]:
    """Turn cameras by 180° whose photos were stored upright although the gantry held the camera upside down.

    Copies of these sets differ in this. Where the matrices of two neighbouring cameras say that one was upside down,
    their pictures tell whether the files are: they are compared as they are, and with one turned.
    """
    side = np.array([view.camera_to_world[:3, 0] @ views[0].camera_to_world[:3, 0] for view in views])
    ahead = np.stack([view.camera_to_world[:3, 2] for view in views])
    pairs = [
        (float(ahead[i] @ ahead[j]), i, j)
        for i in np.flatnonzero(side >= 0)
        for j in np.flatnonzero(side < 0)
        if ahead[i] @ ahead[j] > 0.9 and views[i].camera_to_world[:3, 0] @ views[j].camera_to_world[:3, 0] < -0.8
    ]
    votes = []
    for _, i, j in sorted(pairs, reverse=True)[:7]:
        a, b = _small(views[i]), _small(views[j])
        votes.append(np.corrcoef(a.ravel(), b.ravel())[0, 1] > np.corrcoef(a.ravel(), b[::-1, ::-1].ravel())[0, 1])
    if not votes or np.mean(votes) <= 0.5:
        return views, 0
    result = [_turned(view) if side[i] < 0 else view for i, view in enumerate(views)]
    return result, int((side < 0).sum())


def _small(view: DatasetView) -> np.ndarray:
    return thumbnail(read_photo(view.image, 256).image)


def _turned(view: DatasetView) -> DatasetView:
    camera = view.camera
    return replace(
        view,
        camera=camera.model_copy(update={"cx": camera.width - camera.cx, "cy": camera.height - camera.cy}),
        camera_to_world=view.camera_to_world @ np.diag([-1.0, -1.0, 1.0, 1.0]),
    )
