"""Segments.ai: a release file, and beside it the PNGs of segment ids that it names."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote, urlparse

import numpy as np
from PIL import Image

from ...errors import InputError
from ...files import atomic_path, write_json
from ...project.label_revision import label_facts
from .regions import (
    STUFF,
    LabelClass,
    Picture,
    Source,
    checked_size,
    id_picture,
    numbers_of,
    picture_of,
    polygon_mask,
    read_json,
    region_of,
)

RELEASE, LABELSET = "release.json", "ground-truth"


def read(path: Path) -> Source:
    """The labels of a release file, or of a folder with one. Raises InputError."""
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    found = next((v for v in map(read_json, files) if isinstance(v, dict) and isinstance(v.get("dataset"), dict)), None)
    try:
        if found is None:
            raise KeyError("dataset")
        samples = found["dataset"]["samples"]
        categories = found["dataset"]["task_attributes"]["categories"]
        names = {c["id"]: str(c["name"]) for c in categories}
        colors = {str(c["name"]): tuple(c["color"][:3]) if c.get("color") else None for c in categories}
        things = {c["id"]: c.get("has_instances", True) for c in categories}
    except (KeyError, TypeError) as error:
        raise InputError(
            f"{path} is no release of Segments.ai: {error!r} is missing.", "Download the release file."
        ) from error
    source = Source(iter(()), colors)
    source.pictures = _pictures(path if path.is_dir() else path.parent, samples, names, things, source)
    return source


def _pictures(
    folder: Path, samples: list[dict[str, Any]], names: dict[Any, str], things: dict[Any, bool], source: Source
) -> Iterator[Picture]:
    for sample in samples:
        try:
            name, labels = str(sample["name"]), sample.get("labels") or {}
            labelset = next((key for key, value in labels.items() if value), None)
            if labelset is None:
                continue
            attributes = labels[labelset]["attributes"]
            annotations = attributes.get("annotations") or []
            if "segmentation_bitmap" in attributes:
                yield _bitmap(folder, name, labelset, attributes, names, things)
                continue
            image = attributes.get("image") or sample["attributes"]["image"]
            width, height = checked_size(image.get("width"), image.get("height"), name)
            regions = []
            for entry in annotations:
                if entry.get("type") == "polygon":
                    mask = polygon_mask(entry["points"], width, height)
                    regions.append(region_of(names[entry["category_id"]], mask, len(regions) + 1))
                else:
                    source.skip(str(entry.get("type")))
            yield Picture(name, width, height, regions)
        except (KeyError, TypeError, AttributeError) as error:
            wrong = f"A sample of the release in {folder} is damaged: {error!r}."
            raise InputError(wrong, "Download the release file once more.") from error


def _bitmap(folder: Path, name: str, labelset: str, attributes: dict[str, Any], names: dict, things: dict) -> Picture:
    address = str((attributes.get("segmentation_bitmap") or {}).get("url", ""))
    place = bitmap_place(folder, name, address, labelset)
    numbers = numbers_of(picture_of(place, name))
    regions = []
    for i, entry in enumerate(attributes.get("annotations") or [], 1):
        single = things[entry["category_id"]] and not (entry.get("attributes") or {}).get(STUFF)
        regions.append(region_of(names[entry["category_id"]], numbers == entry["id"], i if single else 0))
    return Picture(name, numbers.shape[1], numbers.shape[0], regions)


def bitmap_place(folder: Path, name: str, address: str, labelset: str = LABELSET) -> Path:
    """Where the bitmap of a sample lies. Nothing is downloaded. Raises InputError.

    Args:
        name, address, labelset: of the sample, of its bitmap as the release has it, and of its labels.
    """
    stem = name.removesuffix(PurePosixPath(name).suffix)
    wanted = [unquote(urlparse(address).path).rsplit("/", 1)[-1]]
    for one in (stem, PurePosixPath(stem).name):
        wanted += [f"{one}_label_{labelset}.png", f"{one}.png"]
    inner = [folder, folder / "labels", *sorted(place for place in folder.iterdir() if place.is_dir())]
    for file in dict.fromkeys(w for w in wanted if w.lower().endswith(".png")):
        # A bare name in some other folder may be that of another sample.
        for place in inner[:2] if "/" in name and "/" not in file else inner:
            if (place / file).is_file():
                return place / file
    raise InputError(
        f"The label picture of {name} is not beside the release file in {folder}.",
        f"Download it there as {wanted[1]} (the tool of Segments.ai does so: export_dataset).",
    )


def write(
    pictures: Iterable[Picture], classes: list[LabelClass], out: Path, label_revision: int | None = None
) -> list[Path]:
    """Write a folder with a release file and a PNG of segment ids for each picture. Categories without any instance say so;
    of the others an attribute says which segments are none."""
    ids, samples, files = {c.name: c.id for c in classes}, [], [out / RELEASE]
    things: set[str] = set()
    stuff: set[str] = set()
    for picture in pictures:
        numbers, annotations = np.zeros((picture.height, picture.width), np.int64), []
        for number, region in enumerate(picture.regions, 1):
            region.paint(numbers, number)
            marked = {} if region.instance else {"attributes": {STUFF: True}}
            annotations.append({"id": number, "category_id": ids[region.class_name], **marked})
            (things if region.instance else stuff).add(region.class_name)
        files.append(out / f"{Path(picture.name).stem}_label_{LABELSET}.png")
        rgba = np.dstack([id_picture(numbers), np.full(numbers.shape, 255, np.uint8)])
        with atomic_path(files[-1]) as temporary:
            Image.fromarray(rgba).save(temporary, "PNG")
        attributes = {
            "format_version": "0.1",
            "annotations": annotations,
            "segmentation_bitmap": {"url": files[-1].name},
        }
        label = {"label_status": "LABELED", "attributes": attributes}
        image = {"url": picture.name, "width": picture.width, "height": picture.height}
        samples.append({"name": picture.name, "attributes": {"image": image}, "labels": {LABELSET: label}})
    categories = [
        {"id": c.id, "name": c.name, "color": list(c.color), "has_instances": c.name not in stuff - things}
        for c in classes
    ]
    attributes = {"format_version": "0.1", "categories": categories}
    dataset = {
        "name": "fieldwork",
        "task_type": "segmentation-bitmap",
        "task_attributes": attributes,
        "samples": samples,
    }
    description = " ".join(f"{fact} {value}" for fact, value in label_facts(label_revision).items())
    write_json(files[0], {"name": "fieldwork", "description": description, "dataset": dataset})
    return files
