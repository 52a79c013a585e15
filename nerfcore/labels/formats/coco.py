"""COCO: instances as polygons or run lengths (column by column), and panoptic labels as PNG of segment ids."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image

from ...errors import InputError
from ...files import atomic_path, leads_outside, write_json
from ...project.label_revision import label_facts
from .regions import (
    LabelClass,
    Picture,
    Region,
    Source,
    checked_size,
    from_runs,
    id_picture,
    numbered,
    numbers_of,
    picture_of,
    polygon_mask,
    read_json,
    region_of,
    runs_of,
)


def read(path: Path) -> Source:
    """The labels of a COCO file, instances or panoptic. Of what it calls stuff nothing is a single thing. Raises InputError."""
    value = read_json(path)
    try:
        names = {entry["id"]: str(entry["name"]) for entry in value["categories"]}
        colors = {str(e["name"]): tuple(e["color"]) for e in value["categories"] if len(e.get("color") or ()) == 3}
        stuff = {str(entry["name"]) for entry in value["categories"] if entry.get("isthing", 1) == 0}
        images = {entry["id"]: entry for entry in value["images"]}
        of_image: dict[Any, list[dict[str, Any]]] = defaultdict(list)
        for annotation in value["annotations"]:
            of_image[annotation["image_id"]].append(annotation)
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path} is no COCO file: {error!r} is missing.", "It has images, annotations, categories."
        ) from error
    source = Source(iter(()), {name: colors.get(name) for name in names.values()})
    source.pictures = _pictures(path, images, of_image, names, stuff, source)
    return source


def _pictures(
    path: Path, images: dict, of_image: dict, names: dict[Any, str], stuff: set[str], source: Source
) -> Iterator[Picture]:
    for number, entries in of_image.items():
        image = images.get(number)
        if image is None:
            raise InputError(
                f"{path} has annotations of a picture {number} that it does not list.", "Export it once more."
            )
        name = str(image.get("file_name", number))
        width, height = checked_size(image.get("width"), image.get("height"), name)
        regions: list[Region] = []
        for annotation in entries:
            try:
                if "segments_info" in annotation:
                    regions += _segments(path, annotation, names, (height, width))
                    continue
                mask = _mask(annotation.get("segmentation"), width, height)
                if mask is None:
                    source.skip("box")
                else:
                    regions.append(region_of(names[annotation["category_id"]], mask, len(regions) + 1))
            except (KeyError, TypeError, ValueError, IndexError) as error:
                wrong = f"An annotation of {name} in {path} is damaged: {error}."
                raise InputError(wrong, "Export the labels once more.") from error
        regions = _without_crowd_instances(regions, entries)
        yield Picture(name, width, height, [replace(r, instance=0) if r.class_name in stuff else r for r in regions])


def _without_crowd_instances(regions: list[Region], annotations: list[dict[str, Any]]) -> list[Region]:
    """A crowd is no single thing."""
    kinds = [bool(a.get("iscrowd")) for a in annotations if "segments_info" not in a and a.get("segmentation")]
    if len(kinds) != len(regions):
        return regions
    return [replace(r, instance=0 if crowd else r.instance) for r, crowd in zip(regions, kinds)]


def _mask(segmentation: Any, width: int, height: int) -> np.ndarray | None:
    """The mask of polygons or run lengths; None where there is only a box."""
    if not segmentation:
        return None
    if isinstance(segmentation, list):
        mask = np.zeros((height, width), bool)
        for polygon in segmentation:
            mask |= polygon_mask(polygon, width, height)
        return mask
    counts, (rows, columns) = segmentation["counts"], segmentation["size"]
    if (rows, columns) != (height, width):
        raise ValueError(f"its size is {columns}×{rows}, that of the picture {width}×{height}")
    runs = unpacked(counts) if isinstance(counts, str) else counts
    return from_runs(runs, width * height).reshape(width, height).T


def _segments(path: Path, annotation: dict[str, Any], names: dict[Any, str], shape: tuple[int, int]) -> list[Region]:
    """The regions of one panoptic picture."""
    file = PurePosixPath(str(annotation["file_name"]).replace("\\", "/"))
    folders = [path.with_suffix(""), path.parent, path.parent / "panoptic"]
    said = [] if leads_outside(str(file)) else [path.parent / file]
    places = [folders[0] / file.name, *said, *(folder / file.name for folder in folders[1:])]
    place = next((place for place in places if place.is_file()), None)
    if place is None:
        raise InputError(
            f"The panoptic picture {file} of {path} is in none of the folders {', '.join(map(str, folders))}.",
            f"Put the pictures of segments that belong to {path.name} into {folders[0]}.",
        )
    numbers = numbers_of(picture_of(place, str(file)))
    ids = [segment["id"] for segment in annotation["segments_info"]]
    if ids and not np.isin(numbers, ids).any():
        raise InputError(
            f"{place} shows none of the segments that {path} has in it.",
            f"It may be a photo: put the pictures of segments into {folders[0]}.",
        )
    if numbers.shape != shape:
        raise ValueError(f"{file} is {numbers.shape[1]}×{numbers.shape[0]}, the picture {shape[1]}×{shape[0]}")
    things = {segment["id"]: not segment.get("iscrowd") for segment in annotation["segments_info"]}
    return [
        region_of(names[s["category_id"]], numbers == s["id"], i if things[s["id"]] else 0)
        for i, s in enumerate(annotation["segments_info"], 1)
    ]


def unpacked(text: str) -> list[int]:
    """Run lengths of COCO's compressed form: five bits a letter, from the third on as differences to the one before last."""
    runs: list[int] = []
    value, shift = 0, 0
    for letter in text.encode("ascii"):
        bits = letter - 48
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:
            value -= 1 << shift
        runs.append(value + runs[-2] if len(runs) > 2 else value)
        value, shift = 0, 0
    return runs


def packed(runs: list[int]) -> str:
    """Run lengths in COCO's compressed form."""
    letters = []
    for number, run in enumerate(runs):
        value, more = run - runs[number - 2] if number > 2 else run, True
        while more:
            bits = value & 31
            value >>= 5
            more = value != (-1 if bits & 16 else 0)
            letters.append((bits | 32 if more else bits) + 48)
    return bytes(letters).decode("ascii")


def write(
    pictures: Iterable[Picture], classes: list[LabelClass], out: Path, label_revision: int | None = None
) -> list[Path]:
    """Write an instances file: every region one annotation with run lengths, regions that are no instance as crowds."""
    images, annotations = [], []
    ids = {c.name: c.id for c in classes}
    for number, picture in numbered(pictures):
        images.append({"id": number, "file_name": picture.name, "width": picture.width, "height": picture.height})
        for region in picture.regions:
            left, top, right, bottom = region.bounds
            counts = packed(runs_of(region.mask(picture.width, picture.height).T))
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": number,
                    "category_id": ids[region.class_name],
                    "segmentation": {"size": [picture.height, picture.width], "counts": counts},
                    "area": int(region.patch.sum()),
                    "bbox": [left, top, right - left, bottom - top],
                    "iscrowd": int(region.instance == 0),
                }
            )
    info = label_facts(label_revision)
    write_json(out, {"info": info, "images": images, "annotations": annotations, "categories": _categories(classes)})
    return [out]


def _categories(classes: list[LabelClass]) -> list[dict[str, Any]]:
    return [{"id": c.id, "name": c.name, "supercategory": "", "isthing": 1, "color": list(c.color)} for c in classes]


def write_panoptic(
    pictures: Iterable[Picture], classes: list[LabelClass], out: Path, label_revision: int | None = None
) -> list[Path]:
    """Write panoptic labels into a folder: panoptic.json, and PNGs of segment ids in `panoptic`."""
    images, annotations, files = [], [], []
    ids = {c.name: c.id for c in classes}
    for number, picture in numbered(pictures):
        numbers, segments = np.zeros((picture.height, picture.width), np.int64), []
        for segment, region in enumerate(picture.regions, 1):
            region.paint(numbers, segment)
            left, top, right, bottom = region.bounds
            segments.append(
                {
                    "id": segment,
                    "category_id": ids[region.class_name],
                    "area": int(region.patch.sum()),
                    "bbox": [left, top, right - left, bottom - top],
                    "iscrowd": int(region.instance == 0),
                }
            )
        name = f"{Path(picture.name).stem}.png"
        files.append(out / "panoptic" / name)
        files[-1].parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(files[-1]) as temporary:
            Image.fromarray(id_picture(numbers)).save(temporary, "PNG")
        images.append({"id": number, "file_name": picture.name, "width": picture.width, "height": picture.height})
        annotations.append({"image_id": number, "file_name": name, "segments_info": segments})
    table = out / "panoptic.json"
    info = label_facts(label_revision)
    write_json(table, {"info": info, "images": images, "annotations": annotations, "categories": _categories(classes)})
    return [table, *files]
