"""LLFF's poses_bounds.npy: (N, 17) per image a 3×5 matrix (pose, then height, width, focal) and near, far.

The pose columns are LLFF's axes (down, right, backwards); one focal length, no distortion. Images are matched with the
rows in name order. Source: the LLFF repository's description of its format.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...capture.images import image_size
from ...errors import InputError
from ..cameras import Camera
from ..dataset import Dataset, DatasetView, beside, list_images, require, unique_names
from ..frames import upright

FILE = "poses_bounds.npy"
VIDEO_SUFFIXES = (".mp4", ".mov", ".webm", ".mkv", ".avi")


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
        rows = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}.", "Export the poses again.") from error
    if rows.ndim != 2 or rows.shape[1] != 17 or not np.isfinite(rows).all():
        raise InputError(f"{path} has shape {rows.shape}, not (N, 17).", "Export the poses again.")
    images = next((found for name in ("images", ".") if (found := list_images(folder / name))), [])
    if not images and (videos := [p for p in folder.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES]):
        raise InputError(
            f"{folder} has poses but no images, only the video {videos[0].name}: nothing says which frames they are of.",
            f"Use `fieldwork new PROJECT --photos {videos[0].name}` and `fieldwork poses` instead.",
        )
    if len(images) != len(rows):
        raise InputError(
            f"{folder} has {len(images)} images, but {FILE} has {len(rows)} poses.",
            "Both must be the same photos in name order.",
        )
    names = unique_names(images, folder)
    views = [_view(folder, name, image, row[:15].reshape(3, 5)) for name, image, row in zip(names, images, rows)]
    require(views, folder)
    world_from_sfm, confidence = upright([view.camera_to_world for view in views])
    return Dataset(format="llff", views=views, world_from_sfm=world_from_sfm, up_confidence=confidence)


def _view(folder: Path, name: str, image: Path, matrix: np.ndarray) -> DatasetView:
    down, right, backwards, center = matrix[:, 0], matrix[:, 1], matrix[:, 2], matrix[:, 3]
    u, _, vt = np.linalg.svd(np.stack([right, down, -backwards], -1))
    pose = np.eye(4)
    pose[:3, :3] = u @ vt
    pose[:3, 3] = center
    height, width, focal = matrix[:, 4]
    camera = Camera(width=round(width), height=round(height), fx=focal, fy=focal, cx=width / 2, cy=height / 2)
    size = image_size(image)
    return DatasetView(
        name=name,
        image=image,
        camera=camera if size == (camera.width, camera.height) else camera.resized(*size),
        camera_to_world=pose,
        label=beside(folder / "labels", image.stem),
        mask=beside(folder / "masks", image.stem, exact=False),
    )
