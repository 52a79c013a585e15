"""Label Studio: its JSON export, with brush strokes (bit-packed run lengths), polygons, boxes and ellipses in percent."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

import numpy as np

from ...errors import InputError
from ...files import write_json
from ...project.label_revision import label_facts
from .regions import (
    STUFF,
    LabelClass,
    Picture,
    Source,
    checked_size,
    ellipse_mask,
    numbered,
    polygon_mask,
    read_json,
    region_of,
)

KINDS = ("brushlabels", "polygonlabels", "rectanglelabels", "ellipselabels")
UPLOADED = re.compile(r"^[0-9a-f]{8}-")  # that Label Studio puts before the names of uploaded files
CHANNELS, WORD = 4, 8  # of brush strokes: RGBA, bits of each
SIZES = (3, 4, 8, 16)  # bits of the four lengths of runs that are written


def read(path: Path) -> Source:
    """The labels of an export as JSON (not “JSON-MIN”). Raises InputError."""
    tasks = read_json(path)
    if not isinstance(tasks, list) or not all(isinstance(t, dict) and "data" in t for t in tasks):
        raise InputError(f"{path} is no export of Label Studio.", "Export the project as “JSON”.")
    names: dict[str, Any] = {}
    for result in (r for task in tasks for r in _results(task)):
        names.update(dict.fromkeys(str(name) for name in _labels(result)))
    source = Source(iter(()), names)
    source.pictures = _pictures(path, tasks, source)
    return source


def _results(task: dict[str, Any]) -> list[dict[str, Any]]:
    """What the newest annotation of a task that was not cancelled says."""
    done = [a for a in task.get("annotations") or [] if isinstance(a, dict) and not a.get("was_cancelled")]
    return [r for r in (done[-1].get("result") or [] if done else []) if isinstance(r, dict)]


def _labels(result: dict[str, Any]) -> list[Any]:
    value = result.get("value")
    return value.get(result.get("type")) or [] if isinstance(value, dict) and result.get("type") in KINDS else []


def _pictures(path: Path, tasks: list[dict[str, Any]], source: Source) -> Iterator[Picture]:
    for number, task in enumerate(tasks, 1):
        results = _results(task)
        areas = [result for result in results if _labels(result)]
        for result in results:
            if not _labels(result):
                source.skip(str(result.get("type")))
        if not areas:
            continue
        name = picture_name(task["data"], number)
        width, height = checked_size(areas[0].get("original_width"), areas[0].get("original_height"), name)
        regions = []
        for result in areas:
            try:
                mask = _mask(result, width, height)
            except (KeyError, TypeError, ValueError, IndexError) as error:
                raise InputError(
                    f"A region of {name} in {path} is damaged: {error!r}.", "Export it once more."
                ) from error
            instance = 0 if _is_stuff(result) else len(regions) + 1
            regions.append(region_of(str(_labels(result)[0]), mask, instance))
        yield Picture(name, width, height, regions)


def _is_stuff(result: dict[str, Any]) -> bool:
    meta = result.get("meta")
    note = meta.get("text") if isinstance(meta, dict) else None
    return STUFF in note if isinstance(note, list) else note == STUFF


def picture_name(data: dict[str, Any], number: int) -> str:
    """The place of a task's picture, of uploaded files the name without what Label Studio put before it."""
    texts = [data.get("image"), *data.values()]
    address = next((str(v) for v in texts if isinstance(v, str) and v), f"task {number}")
    if "://" not in address and not address.startswith("/data/"):
        return address  # as it was imported: the name of a file
    parsed = urlparse(address)
    # Files of local storage are named in the query: /data/local-files/?d=photos/a.jpg
    place = unquote(parsed.query.partition("d=")[2] if "local-files" in parsed.path else parsed.path)
    return UPLOADED.sub("", place.rsplit("/", 1)[-1]) if "/upload/" in parsed.path else place.lstrip("/")


def _mask(result: dict[str, Any], width: int, height: int) -> np.ndarray:
    value, kind = result["value"], result["type"]
    x_scale, y_scale = width / 100, height / 100
    if kind == "brushlabels":
        flat = unpacked(value["rle"])
        if flat.size != width * height * CHANNELS:
            raise ValueError(f"it has {flat.size} values instead of {width * height * CHANNELS}")
        return flat.reshape(height, width, CHANNELS)[..., 3] > 0
    if kind == "polygonlabels":
        return polygon_mask((np.asarray(value["points"], float) * [x_scale, y_scale]).tolist(), width, height)
    x, y, degrees = value["x"] * x_scale, value["y"] * y_scale, float(value.get("rotation") or 0)
    if kind == "ellipselabels":
        rx, ry = value["radiusX"] * x_scale, value["radiusY"] * y_scale
        return ellipse_mask(x, y, rx, ry, width, height, degrees)
    w, h, turn = value["width"] * x_scale, value["height"] * y_scale, np.radians(degrees)
    corners = np.array([(0, 0), (w, 0), (w, h), (0, h)])  # boxes turn about their upper left corner
    turned = corners @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]] + (x, y)
    return polygon_mask(turned.tolist(), width, height)


def unpacked(data: Sequence[int]) -> np.ndarray:
    """The values (N,) uint8 of packed run lengths: number of values (32 bits), bits of a value less 1 (5), bits less 1 of
    the four kinds of lengths (4 each); then runs: whether one value is repeated (1), kind of its length (2), length less 1,
    and the value, or as many values."""
    bits = "".join(f"{byte:08b}" for byte in bytes(data))
    place = 0

    def take(count: int) -> int:
        nonlocal place
        place += count
        if place > len(bits):
            raise ValueError("it ends too early")
        return int(bits[place - count : place], 2)

    total, word = take(32), take(5) + 1
    sizes = [take(4) + 1 for _ in range(4)]
    values, count = [], 0
    while count < total:
        repeated, length = take(1), take(sizes[take(2)]) + 1
        if repeated:
            values.append(np.full(length, take(word), np.uint8))
        else:
            values.append(np.array([take(word) for _ in range(length)], np.uint8))
        count += length
    return np.concatenate(values)[:total] if values else np.zeros(0, np.uint8)


def packed(flat: np.ndarray) -> list[int]:
    """Values (N,) uint8 as packed run lengths (see `unpacked`), every run one value repeated."""
    parts = [f"{len(flat):032b}", f"{WORD - 1:05b}", *(f"{size - 1:04b}" for size in SIZES)]
    edges = np.concatenate([[0], np.flatnonzero(np.diff(flat)) + 1, [len(flat)]]).astype(int)
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist()):
        value, left = int(flat[begin]), end - begin
        while left:
            kind = next((k for k, size in enumerate(SIZES) if left <= 1 << size), len(SIZES) - 1)
            length = min(left, 1 << SIZES[kind])
            parts.append(f"1{kind:02b}{length - 1:0{SIZES[kind]}b}{value:0{WORD}b}")
            left -= length
    bits = "".join(parts)
    bits += "0" * (-len(bits) % 8)
    return [int(bits[i : i + 8], 2) for i in range(0, len(bits), 8)]


def write(
    pictures: Iterable[Picture], classes: list[LabelClass], out: Path, label_revision: int | None = None
) -> list[Path]:
    """Write a JSON file to import: every region a brush stroke of the control “label” on “image”; its note says which
    are no instance."""
    tasks = []
    for number, picture in numbered(pictures):
        results = []
        for index, region in enumerate(picture.regions):
            flat = np.repeat(region.mask(picture.width, picture.height).reshape(-1).astype(np.uint8) * 255, CHANNELS)
            value = {"format": "rle", "rle": packed(flat), "brushlabels": [region.class_name]}
            results.append(
                {
                    "id": f"p{number}r{index}",
                    "type": "brushlabels",
                    "from_name": "label",
                    "to_name": "image",
                    "original_width": picture.width,
                    "original_height": picture.height,
                    "image_rotation": 0,
                    "value": value,
                    **({} if region.instance else {"meta": {"text": [STUFF]}}),
                }
            )
        annotations = [{"id": number, "result": results}]
        meta = label_facts(label_revision)
        tasks.append({"id": number, "data": {"image": picture.name}, "meta": meta, "annotations": annotations})
    write_json(out, tasks)
    return [out]
