"""LabelMe: a JSON file beside each photo, with polygons, boxes, circles and masks."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Iterator
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from ...errors import InputError
from ...files import write_json
from ...project.label_revision import label_facts
from .regions import (
    STUFF,
    LabelClass,
    Picture,
    Region,
    Source,
    box_mask,
    checked_size,
    ellipse_mask,
    files_in,
    from_base64,
    mask_of_png,
    placed,
    png_bytes,
    polygon_mask,
    read_json,
    region_of,
)


def read(path: Path) -> Source:
    """The labels of a folder of JSON files, or of one. Raises InputError."""
    files = files_in(path, {".json"}) if path.is_dir() else [path]
    values = [(file, read_json(file)) for file in files]
    values = [
        (file, value) for file, value in values if isinstance(value, dict) and isinstance(value.get("shapes"), list)
    ]
    if not values:
        raise InputError(f"{path} holds no JSON file of LabelMe.", "Give the folder in which LabelMe saved.")
    names = [str(s.get("label", "")) for _, value in values for s in value["shapes"] if isinstance(s, dict)]
    source = Source(iter(()), dict.fromkeys(names))
    source.pictures = _pictures(path, values, source)
    return source


def _pictures(path: Path, values: list[tuple[Path, dict[str, Any]]], source: Source) -> Iterator[Picture]:
    for file, value in values:
        name = PureWindowsPath(str(value.get("imagePath") or file.name)).as_posix()
        if path.is_dir() and file.parent != path:
            name = f"{file.parent.relative_to(path).as_posix()}/{name}"
        width, height = checked_size(value.get("imageWidth"), value.get("imageHeight"), name)
        groups: dict[Any, int] = {}
        regions: list[Region] = []
        for shape in value["shapes"]:
            try:
                mask = _mask(shape, width, height, name)
                if mask is None:
                    source.skip(str(shape.get("shape_type")))
                    continue
                group = shape.get("group_id")
                key = ("shape", len(regions)) if group is None else (shape["label"], group)
                stuff = (shape.get("flags") or {}).get(STUFF) is True
                instance = 0 if stuff else groups.setdefault(key, len(groups) + 1)
                regions.append(region_of(str(shape["label"]), mask, instance))
            except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
                raise InputError(f"A shape in {file} is damaged: {error!r}.", "Save it again with LabelMe.") from error
        yield Picture(name, width, height, regions)


def _mask(shape: dict[str, Any], width: int, height: int, name: str) -> np.ndarray | None:
    """The mask (H, W) of a shape; None for one without area."""
    kind, points = shape.get("shape_type") or "polygon", np.asarray(shape["points"], np.float64)
    if kind == "polygon":
        return polygon_mask(points.tolist(), width, height)
    if kind in ("rectangle", "mask"):
        (left, top), (right, bottom) = points.min(0), points.max(0)
        if kind == "rectangle":
            return box_mask(left, top, right, bottom, width, height)
        patch = mask_of_png(from_base64(shape["mask"], name), name)
        return placed(patch, round(left), round(top), width, height)
    if kind == "circle":
        radius = float(np.hypot(*(points[1] - points[0])))
        return ellipse_mask(points[0][0], points[0][1], radius, radius, width, height)
    return None


def write(
    pictures: Iterable[Picture], classes: list[LabelClass], out: Path, label_revision: int | None = None
) -> list[Path]:
    """Write a folder with a JSON file for each picture: every region a mask, instances as groups; a flag says which are none."""
    files = []
    for picture in pictures:
        shapes = []
        for region in picture.regions:
            left, top, right, bottom = region.bounds
            data = png_bytes(region.patch.astype(np.uint8) * 255)
            shapes.append(
                {
                    "label": region.class_name,
                    "points": [[left, top], [right - 1, bottom - 1]],
                    "group_id": region.instance or None,
                    "description": "",
                    "shape_type": "mask",
                    "flags": {} if region.instance else {STUFF: True},
                    "mask": base64.b64encode(data).decode("ascii"),
                }
            )
        value = {
            "version": "5.4.1",
            "flags": {},
            "shapes": shapes,
            "imagePath": picture.name,
            "imageData": None,
            "imageHeight": picture.height,
            "imageWidth": picture.width,
            **label_facts(label_revision),
        }
        files.append(out / f"{Path(picture.name).stem}.json")
        write_json(files[-1], value)
    return files
