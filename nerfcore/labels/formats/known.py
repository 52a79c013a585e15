"""Which formats of labels there are, and which one a file has."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ...errors import InputError
from . import coco, cvat, label_studio, labelme, masks, segments, supervisely
from .regions import LabelClass, Picture, Source, files_in, read_json

READERS = {
    "coco": coco.read,
    "cvat": cvat.read,
    "label-studio": label_studio.read,
    "labelme": labelme.read,
    "segments": segments.read,
    "supervisely": supervisely.read,
}
WRITERS = {
    "coco": coco.write,
    "coco-panoptic": coco.write_panoptic,
    "cvat": cvat.write,
    "label-studio": label_studio.write,
    "labelme": labelme.write,
    "segments": segments.write,
    "supervisely": supervisely.write,
}
FILES = {"coco": ".json", "cvat": ".xml", "label-studio": ".json"}  # formats of one file


def format_of(path: Path) -> str:
    """The format of a file or folder. Raises InputError where it is none that is known."""
    if not path.exists():
        raise InputError(f"{path} does not exist.", "Give the file or folder that the labelling tool wrote.")
    if path.is_dir():
        if (path / supervisely.META).is_file():
            return "supervisely"
        files = files_in(path, {".json"})
        found = next((kind for file in files if (kind := _kind_of_json(read_json(file))) is not None), None)
        if found in ("labelme", "segments"):
            return found
        pictures = files_in(path, masks.SUFFIXES)
        # Below a file of another format they are its own.
        if pictures and (found is None or pictures[0].parent == path):
            return "png"
    elif path.suffix.lower() == ".xml" or zipfile.is_zipfile(path):
        return "cvat"
    elif path.suffix.lower() in masks.SUFFIXES:
        return "png"
    elif path.suffix.lower() == ".json":
        value = read_json(path)
        kind = "supervisely" if path.name == supervisely.META else _kind_of_json(value)
        if kind is not None:
            return kind
    raise InputError(
        f"{path} is of no format that is known.",
        f"Say which it is: {', '.join([*READERS, 'png', 'masks'])}.",
    )


def _kind_of_json(value: object) -> str | None:
    if isinstance(value, list):
        return "label-studio" if value and all(isinstance(v, dict) and "data" in v for v in value) else None
    if not isinstance(value, dict):
        return None
    if isinstance(value.get("dataset"), dict) and "samples" in value["dataset"]:
        return "segments"
    if "shapes" in value:
        return "labelme"
    return "coco" if "annotations" in value and "images" in value else None


def read(path: Path, kind: str, classes: list[LabelClass], void: int, class_name: str) -> Source:
    """The labels at a path. Raises InputError, also while the pictures are read."""
    with _damage_told(path, kind):
        if kind == "png":
            source = masks.read_maps(path, classes, void)
        elif kind == "masks":
            source = masks.read_masks(path, class_name)
        else:
            source = READERS[kind](path)
    source.pictures = _pictures(source.pictures, path, kind)
    return source


def _pictures(pictures: Iterator[Picture], path: Path, kind: str) -> Iterator[Picture]:
    with _damage_told(path, kind):
        yield from pictures


@contextmanager
def _damage_told(path: Path, kind: str) -> Iterator[None]:
    """Turn what a reader trips over, where a file holds something else than the tool writes, into an InputError."""
    try:
        yield
    except (AttributeError, TypeError, ValueError, LookupError, ArithmeticError) as error:
        raise InputError(f"{path} is damaged ({kind}): {error!r}.", "Export the labels once more.") from error


def write(
    pictures: Iterable[Picture],
    kind: str,
    classes: list[LabelClass],
    out: Path,
    void: int,
    class_name: str,
    label_revision: int | None = None,
) -> list[Path]:
    """Write labels, and where the format has a place for it the revision of the marks that they are from; returns the
    files. Raises DiskError."""
    if kind in ("png", "png-colors"):
        return masks.write_maps(pictures, classes, out, void, kind == "png-colors")
    if kind == "masks":
        return masks.write_masks(pictures, class_name, out)
    return WRITERS[kind](pictures, classes, out, label_revision)
