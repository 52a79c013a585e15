"""DTU scans as prepared for IDR and NeuS: `cameras.npz` (or `cameras_sphere.npz`), `image/`, `mask/`.

`world_mat_i` is the projection matrix of photo i (4×4), `scale_mat_i` maps the unit sphere onto the object. Frame:
that of `world_mat`; the sphere becomes the region of interest.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import InputError
from ...files import UNREADABLE_ARRAYS
from ...geometry.frames import upright
from ...geometry.similarity import transform_points
from ...images.decode import image_size
from ...images.names import beside, list_images, plain_name
from ..dataset import Dataset, DatasetView, require
from .matrices import camera_from_matrix, decompose_projection

FILES = ("cameras.npz", "cameras_sphere.npz")


def matches(folder: Path) -> bool:
    return any((folder / name).is_file() for name in FILES)


def read(folder: Path) -> Dataset:
    """Read `folder`. Raises InputError naming the file that is missing or damaged."""
    path = next((folder / name for name in FILES if (folder / name).is_file()), None)
    if path is None:
        raise InputError(f"{folder} has no cameras.npz.", "Choose the folder that holds it.")
    try:
        with np.load(path, allow_pickle=False) as data:
            matrices = {name: np.asarray(data[name], np.float64) for name in data.files}
    except UNREADABLE_ARRAYS as error:
        raise InputError(f"{path} cannot be read: {error}.", "Download the data set again.") from error
    images = next((found for name in ("image", "images", "rgb") if (found := list_images(folder / name))), [])
    masks = next((found for name in ("mask", "masks") if (found := list_images(folder / name))), [])
    count = sum(name.startswith("world_mat_") and "inv" not in name for name in matrices)
    if len(images) != count:
        raise InputError(f"{folder} has {len(images)} images, but {path.name} has {count} cameras.", "Complete it.")
    views, warnings = [], []
    if masks and len(masks) != len(images):
        warnings.append(
            f"{folder} has {len(masks)} masks for {len(images)} photos: none is used, as they go by their order."
        )
    for i, image in enumerate(images):
        if f"world_mat_{i}" not in matrices:
            raise InputError(f"{path} has no world_mat_{i}.", "Download the data set again.")
        k, pose = decompose_projection(matrices[f"world_mat_{i}"][:3, :4])
        camera = camera_from_matrix(k, image_size(image))
        mask = masks[i] if len(masks) == len(images) else None
        label = beside(folder / "labels", image.stem)
        views.append(DatasetView(plain_name(image), image, camera, camera_to_world=pose, label=label, mask=mask))
    require(views, folder)
    frame, confidence = upright([view.camera_to_world for view in views])
    bounds = None
    if "scale_mat_0" in matrices:
        sphere = frame @ matrices["scale_mat_0"]
        corners = transform_points(sphere, np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), -1).reshape(-1, 3))
        bounds = np.stack([corners.min(0), corners.max(0)])
    return Dataset("dtu", views, frame, confidence, bounds=bounds, warnings=warnings)
