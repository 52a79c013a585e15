"""The verb `label parts`: the parts of the surface that a photo shows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..files import atomic_path
from ..images.encode import write_picture
from ..images.picture import over, resized
from ..images.working import read_picture
from ..params import LabelPartsParams
from ..progress import Reporter
from ..project.store import load_project
from .lookup import LEVELS, outlines
from .preparation import ensured
from .stroke import require_photo


def parts(params: LabelPartsParams, report: Reporter) -> dict[str, Any]:
    """Tell which part of the surface lies at each of some places of a photo, and draw the outlines of all.

    Returns:
        {"parts": number of all, "shown": number in the photo, "at": [{"x", "y", "part": None where no surface is, "surfels",
        "share": of the photo's pixels}], "file": None without `out`}
    Raises:
        InputError: there is no such photo, it has no pose, or a place lies outside of it.
        ProjectError: there is no trained run. TrainingError, DiskError, Cancelled.
    """
    folder = Path(params.project)
    project = load_project(folder)
    require_photo(project, folder, params.photo)
    if params.out is not None and params.out.suffix.lower() != ".png":
        raise InputError(f"{params.out} is no PNG.", "The picture is written as PNG: give a name that ends in .png.")
    record = next(image for image in project.images if image.name == params.photo)
    for x, y in params.points:
        if not (0 <= x < record.width and 0 <= y < record.height):
            raise InputError(
                f"{x:g},{y:g} lies outside the photo “{params.photo}”, which is {record.width}×{record.height}.",
                "Give pixels of the photo, its top-left corner being 0,0.",
            )
    ready, _ = ensured(folder, params.run, report)
    number = np.append(ready.parts[:, LEVELS.index(params.level)], -1)
    shown = number[ready.map_of(params.photo)[0]]
    rows, columns = shown.shape
    at = []
    for x, y in params.points:
        part = int(shown[int(y * rows / record.height), int(x * columns / record.width)])
        surfels, share = int(np.count_nonzero(number == part)), round(float((shown == part).mean()), 4)
        at.append(
            {"x": x, "y": y, "part": part, "surfels": surfels, "share": share}
            if part >= 0
            else {"x": x, "y": y, "part": None, "surfels": 0, "share": 0.0}
        )
    if params.out is not None:
        photo = over(resized(read_picture(folder / record.file), columns, rows), 1.0).pixels[..., :3].copy()
        photo[outlines(shown)] = 1.0
        with atomic_path(params.out) as temporary:
            write_picture(temporary, (photo * 255 + 0.5).astype(np.uint8))
    return {
        "parts": int(number.max()) + 1,
        "shown": len(np.unique(shown[shown >= 0])),
        "at": at,
        "file": None if params.out is None else str(params.out),
    }
