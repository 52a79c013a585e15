"""Supervisely: a project folder with meta.json, and data sets with a JSON file for each photo."""

from __future__ import annotations

import base64
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
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
    color_hex,
    from_base64,
    hex_color,
    mask_of_png,
    placed,
    png_bytes,
    polygon_mask,
    read_json,
    region_of,
)

META, DATASET = "meta.json", "photos"
_STUFF_TAG = {"name": STUFF, "value_type": "none", "color": "#AAAAAA"}


def read(path: Path) -> Source:
    """The labels of a project folder, or of its meta.json. Raises InputError."""
    folder = path.parent if path.is_file() else path
    meta = read_json(folder / META)
    files = sorted(folder.glob("**/ann/*.json"))
    if not isinstance(meta, dict) or not isinstance(meta.get("classes"), list) or not files:
        raise InputError(f"{folder} is no project of Supervisely.", "It has meta.json and data sets with a folder ann.")
    classes = {str(c.get("title")): hex_color(c.get("color")) for c in meta["classes"] if isinstance(c, dict)}
    source = Source(iter(()), classes)
    source.pictures = _pictures(files, source)
    return source


def _pictures(files: list[Path], source: Source) -> Iterator[Picture]:
    many = Counter(file.name for file in files)  # data sets are folders, each of which may have a photo of one name
    for file in files:
        value, name = read_json(file), file.name.removesuffix(".json")
        if many[file.name] > 1:
            name = f"{file.parents[1].name}/{name}"
        try:
            width, height = checked_size(value["size"]["width"], value["size"]["height"], name)
            regions: list[Region] = []
            keys: dict[Any, int] = {}
            for entry in value["objects"]:
                mask = _mask(entry, width, height, name)
                if mask is None:
                    source.skip(str(entry.get("geometryType")))
                    continue
                key = entry.get("instance") or ("object", len(regions))
                stuff = any(tag.get("name") == STUFF for tag in entry.get("tags") or [])
                instance = 0 if stuff else keys.setdefault(key, len(keys) + 1)
                regions.append(region_of(str(entry["classTitle"]), mask, instance))
        except (KeyError, TypeError, ValueError, AttributeError, zlib.error) as error:
            raise InputError(f"{file} is damaged: {error!r}.", "Export the project once more.") from error
        yield Picture(name, width, height, regions)


def _mask(entry: dict[str, Any], width: int, height: int, name: str) -> np.ndarray | None:
    """The mask (H, W) of an object; None for one without area."""
    kind = entry["geometryType"]
    if kind == "bitmap":
        left, top = entry["bitmap"]["origin"]
        patch = mask_of_png(zlib.decompress(from_base64(entry["bitmap"]["data"], name)), name)
        return placed(patch, int(left), int(top), width, height)
    if kind == "polygon":
        mask = polygon_mask(entry["points"]["exterior"], width, height)
        for hole in entry["points"].get("interior") or []:
            mask &= ~polygon_mask(hole, width, height)
        return mask
    if kind == "rectangle":
        corners = np.asarray(entry["points"]["exterior"], np.float64)
        (left, top), (right, bottom) = corners.min(0), corners.max(0)
        return box_mask(left, top, right, bottom, width, height)
    return None


def write(
    pictures: Iterable[Picture], classes: list[LabelClass], out: Path, label_revision: int | None = None
) -> list[Path]:
    """Write a project folder without the photos: every region a bitmap; a tag says which are no instance."""
    entries = [{"title": c.name, "shape": "bitmap", "color": color_hex(c.color).upper()} for c in classes]
    files = [out / META]
    write_json(files[0], {"classes": entries, "tags": [_STUFF_TAG], "projectType": "images"})
    for picture in pictures:
        objects = []
        for region in picture.regions:
            data = zlib.compress(png_bytes(region.patch.astype(np.uint8) * 255))
            instance = {"instance": f"{picture.name}-{region.instance}"} if region.instance else {}
            bitmap = {"data": base64.b64encode(data).decode("ascii"), "origin": [region.left, region.top]}
            tags = [] if region.instance else [{"name": STUFF, "value": None}]
            named = {"classTitle": region.class_name, "geometryType": "bitmap", "tags": tags, "description": ""}
            objects.append({**named, **instance, "bitmap": bitmap})
        size = {"height": picture.height, "width": picture.width}
        files.append(out / DATASET / "ann" / f"{picture.name}.json")
        description = " ".join(f"{fact} {value}" for fact, value in label_facts(label_revision).items())
        write_json(files[-1], {"description": description, "tags": [], "size": size, "objects": objects})
    return files
