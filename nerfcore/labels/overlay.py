"""The verb `label overlay`: the labels of a revision as a photo shows them, looked up and not rendered."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..files import atomic_path
from ..images.encode import write_picture
from ..images.picture import over, resized
from ..images.working import read_picture
from ..params import LabelOverlayParams
from ..progress import Reporter
from ..project.runs import run_folder
from ..project.store import load_project
from .lookup import Labelling
from .preparation import Preparation
from .revisions import computed
from .stroke import require_photo

FOLDER = "overlays"
COLOR_SHARE = 0.55  # of the class colour over the photo


def overlay(params: LabelOverlayParams, report: Reporter) -> dict[str, Any]:
    """Write a picture of a photo's labels at the size of the photo's map (see `label prepare`).

    Returns:
        {"file", "width", "height", "revision", "kind", "milliseconds": of the look-up alone}
    Raises:
        InputError: there is no such photo, revision, or the photo has no pose.
        ProjectError: the run was not prepared or the revision not propagated. DiskError.
    """
    folder = Path(params.project)
    project = load_project(folder)
    require_photo(project, folder, params.photo)
    ready, labelling = computed(folder, params.run, params.revision)
    out = params.out or run_folder(folder, params.run) / FOLDER / f"{params.photo}_{params.kind}.png"
    if out.suffix.lower() != ".png":
        raise InputError(f"{out} is no PNG.", "Overlays are written as PNG: give a name that ends in .png.")
    begin = time.perf_counter()
    ids, sure = photo_labels(ready, labelling, params.photo, project.ignore_id)
    seconds = time.perf_counter() - begin
    height, width = ids.shape
    if params.kind == "ids":
        picture = ids.astype(np.uint8 if ids.max() < 256 else np.uint16)
    elif params.kind == "confidence":
        picture = (sure * 255 + 0.5).astype(np.uint8)
    else:
        record = next(image for image in project.images if image.name == params.photo)
        photo = over(resized(read_picture(folder / record.file), width, height), 1.0).pixels[..., :3]
        picture = colored(photo, ids, {c.id: c.color for c in project.classes})
    with atomic_path(out) as temporary:
        write_picture(temporary, picture)
    return {
        "file": str(out),
        "width": width,
        "height": height,
        "revision": labelling.revision,
        "kind": params.kind,
        "milliseconds": round(seconds * 1e3, 2),
    }


def photo_labels(ready: Preparation, labelling: Labelling, photo: str, void: int) -> tuple[np.ndarray, np.ndarray]:
    """Class ids (H, W) int32 that a photo shows, `void` where no class is known, and their confidence (H, W) float32, 0
    where no surface is.

    Raises:
        InputError: the photo has no pose.
    """
    surfel, _ = ready.map_of(photo)
    ids = np.append(labelling.label(void), void).astype(np.int32)
    sure = np.append(labelling.confidence(), 0).astype(np.float32)
    return ids[surfel], sure[surfel]  # the last entry is that of −1


def colored(photo: np.ndarray, ids: np.ndarray, colors: dict[int, tuple[float, float, float]]) -> np.ndarray:
    """A photo (H, W, 3) in [0, 1] with the colours of its class ids (H, W) over it, uint8; other ids leave it as it is."""
    table = np.zeros((max([int(ids.max()), *colors]) + 1, 4), np.float32)
    for class_id, color in colors.items():
        table[class_id] = (*color, COLOR_SHARE)
    over_it = table[ids]
    share = over_it[..., 3:]
    return ((photo * (1 - share) + over_it[..., :3] * share) * 255 + 0.5).clip(0, 255).astype(np.uint8)
