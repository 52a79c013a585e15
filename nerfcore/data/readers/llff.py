"""LLFF's poses_bounds.npy: (N, 17) per image a 3×5 matrix (pose, then height, width, focal) and near, far.

The pose columns are LLFF's axes (down, right, backwards); one focal length, no distortion. Images are matched with the
rows in name order; where there is only a video, with every n-th of its frames if one n fits the number of rows. Source: the LLFF repository's description of its format.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from ...errors import InputError
from ...geometry.cameras import Camera
from ...geometry.frames import upright
from ...images.arrays import read_array
from ...images.decode import image_size
from ...images.names import labels_and_masks, list_images, unique_names
from ...images.suffixes import VIDEO_SUFFIXES
from ..dataset import Dataset, DatasetView, lens_at_size, require

FILE = "poses_bounds.npy"


def matches(folder: Path) -> bool:
    """Whether `folder` has a poses_bounds.npy."""
    return (folder / FILE).is_file()


def read(folder: Path) -> Dataset:
    """Read `folder`.

    Raises:
        InputError: the file is damaged, or the number of images differs from that of its rows.
    """
    path = folder / FILE
    try:
        rows = read_array(path)
    except InputError as error:
        raise InputError(f"{folder}: {error}.", "Export the poses again.") from error
    if rows.ndim != 2 or rows.shape[1] != 17 or not np.isfinite(rows).all():
        raise InputError(f"{path} has shape {rows.shape}, not (N, 17).", "Export the poses again.")
    images = next((found for name in ("images", ".") if (found := list_images(folder / name))), [])
    resources, warnings = (), []
    videos = [path for path in folder.iterdir() if path.suffix.lower() in VIDEO_SUFFIXES]
    if not images and len(videos) == 1:
        from ...capture.video import every_nth, save_every_nth  # the library takes its time to load

        step = every_nth(videos[0], len(rows))
        if step is None:
            raise InputError(
                f"{folder} has no images, only {videos[0].name}, and nothing says which frames the {len(rows)} poses "
                "are of.",
                f"Use `fieldwork new PROJECT --photos {videos[0].name}` and `fieldwork poses` instead.",
            )
        # It lives as long as the data set that names its files.
        temporary = tempfile.TemporaryDirectory(prefix="fieldwork-")
        resources = (temporary,)
        images = save_every_nth(videos[0], step, Path(temporary.name))
        warnings = [f"The {len(rows)} poses are taken to be those of every {step}th frame of {videos[0].name}."]
    if len(images) != len(rows):
        raise InputError(
            f"{folder} has {len(images)} images, but {FILE} has {len(rows)} poses.",
            "Both must be the same photos in name order.",
        )
    names = unique_names(images, folder)
    companions = labels_and_masks(folder, images, names)
    views = [
        _view(name, image, row[:15].reshape(3, 5), both)
        for name, image, row, both in zip(names, images, rows, companions)
    ]
    require(views, folder)
    world_from_sfm, confidence = upright([view.camera_to_world for view in views])
    return Dataset(
        format="llff",
        views=views,
        world_from_sfm=world_from_sfm,
        up_confidence=confidence,
        warnings=warnings,
        resources=resources,
    )


def _view(name: str, image: Path, matrix: np.ndarray, companions: tuple[Path | None, Path | None]) -> DatasetView:
    down, right, backwards, center = matrix[:, 0], matrix[:, 1], matrix[:, 2], matrix[:, 3]
    u, _, vt = np.linalg.svd(np.stack([right, down, -backwards], -1))
    pose = np.eye(4)
    pose[:3, :3] = u @ vt
    pose[:3, 3] = center
    height, width, focal = matrix[:, 4]
    camera = Camera(width=round(width), height=round(height), fx=focal, fy=focal, cx=width / 2, cy=height / 2)
    return DatasetView(
        name=name,
        image=image,
        camera=lens_at_size(camera, image_size(image), image),
        camera_to_world=pose,
        label=companions[0],
        mask=companions[1],
    )
