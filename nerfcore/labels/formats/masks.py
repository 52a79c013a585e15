"""Pictures: label maps of ids or colours, and black and white masks as Metashape exports them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from ...errors import InputError, SettingError
from ...files import atomic_path, write_json
from ...images.labels import UnknownColors, read_labels, read_mask
from ...project.classes import read_classes
from .regions import Color, LabelClass, Picture, Source, checked_size, color_hex, files_in, region_of

SUFFIXES = {".png", ".tif", ".tiff", ".bmp"}
MASK = re.compile(r"[_.-]?mask$", re.IGNORECASE)  # behind the name of the photo
TABLE = "classes.json"


def pictures_in(path: Path, more: frozenset[str] = frozenset()) -> list[Path]:
    """The pictures in a folder, or one. Raises InputError where there are none."""
    suffixes = SUFFIXES | more
    found = files_in(path, suffixes) if path.is_dir() else [path] if path.suffix.lower() in suffixes else []
    if not found:
        raise InputError(f"There is no label picture at {path}.", "Give a folder of PNG files named like the photos.")
    return found


def read_maps(path: Path, classes: list[LabelClass], void: int) -> Source:
    """Label maps of ids or of colours. What ids and colours mean says classes.json beside them, else the project's classes.

    Raises:
        InputError: a picture or the table cannot be read, or has colours of no class.
    """
    table = (path if path.is_dir() else path.parent) / TABLE
    names, colors = {c.id: c.name for c in classes}, {c.id: c.color for c in classes}
    if table.is_file():
        names, void, given = read_classes(table)
        colors = {**{i: color for i, color in colors.items() if i in names}, **given}
    source = Source(iter(()), {name: colors.get(i) for i, name in names.items()})
    source.ids = {name: i for i, name in names.items()}
    source.pictures = _maps(path, names, colors, void, source)
    return source


def _maps(path: Path, names: dict[int, str], colors: dict[int, Color], void: int, source: Source) -> Iterator[Picture]:
    for file in pictures_in(path):
        try:
            ids = read_labels(file, colors, void)
        except InputError as error:
            named = f"Name the classes with their colours in {TABLE} beside the maps."
            hint = named if isinstance(error, UnknownColors) else "Write the label map once more, as PNG, or remove it."
            raise InputError(f"{file.parent}: {error.message}.", hint) from error
        checked_size(ids.shape[1], ids.shape[0], file.name)
        regions = []
        for class_id in np.unique(ids).tolist():
            if class_id != void:
                name = names.get(class_id, f"class {class_id}")
                source.ids.setdefault(name, class_id)
                regions.append(region_of(name, ids == class_id))
        yield Picture(_place(file, path), ids.shape[1], ids.shape[0], regions)


def _place(file: Path, path: Path) -> str:
    """Where a picture lies in the folder that was given; its name where it was given itself."""
    return file.relative_to(path).as_posix() if path.is_dir() else file.name


def read_masks(path: Path, class_name: str) -> Source:
    """Black and white masks: what is white is of one class, black is unlabelled. Raises InputError."""
    source = Source(iter(()), {class_name: None})
    source.pictures = _masks(path, pictures_in(path, frozenset({".jpg", ".jpeg"})), class_name)
    return source


def _masks(path: Path, files: list[Path], class_name: str) -> Iterator[Picture]:
    for file in files:
        mask = read_mask(file)
        checked_size(mask.shape[1], mask.shape[0], file.name)
        place = PurePosixPath(_place(file, path))
        name = place.with_name(f"{MASK.sub('', place.stem)}{place.suffix}").as_posix()
        yield Picture(name, mask.shape[1], mask.shape[0], [region_of(class_name, mask)])


def map_of(picture: Picture, ids: dict[str, int], void: int) -> np.ndarray:
    """The label map (H, W) of a picture: 8 bits where all ids fit, else 16."""
    values = np.full((picture.height, picture.width), void, np.int64)
    for region in picture.regions:
        region.paint(values, ids[region.class_name])
    return values.astype(np.uint8 if max([void, *ids.values()]) < 256 else np.uint16)


def _require_apart(classes: list[LabelClass]) -> None:
    """Raise SettingError where two classes have the same colour, or one that of void."""
    owner = {(0, 0, 0): "void"}
    for c in classes:
        if c.color in owner:
            raise SettingError(
                f"“{c.name}” has the colour of {owner[c.color]}: {color_hex(c.color)}.",
                "Give every class a colour of its own, or export ids (--format png).",
            )
        owner[c.color] = f"“{c.name}”"


def write_maps(
    pictures: Iterable[Picture], classes: list[LabelClass], out: Path, void: int, colored: bool
) -> list[Path]:
    """Write a folder of label maps of ids, or in the classes' colours on black, with classes.json.

    Raises:
        SettingError: colours do not tell the classes apart.
    """
    if colored:
        _require_apart(classes)
    table = {str(c.id): {"name": c.name, "color": list(c.color)} for c in classes}
    files = [out / TABLE]
    write_json(files[0], {"ignore_id": void, "classes": table})
    colors = np.zeros((max([void, *(c.id for c in classes)]) + 1, 3), np.uint8)
    for c in classes:
        colors[c.id] = c.color
    for picture in pictures:
        values = map_of(picture, {c.name: c.id for c in classes}, void)
        files.append(out / f"{Path(picture.name).stem}.png")
        with atomic_path(files[-1]) as temporary:
            Image.fromarray(colors[values] if colored else values).save(temporary, "PNG")
    return files


def write_masks(pictures: Iterable[Picture], class_name: str, out: Path) -> list[Path]:
    """Write a folder of masks, NAME_mask.png, white where a class is."""
    files = []
    for picture in pictures:
        mask = np.zeros((picture.height, picture.width), np.uint8)
        for region in picture.regions:
            if region.class_name == class_name:
                region.paint(mask, 255)
        files.append(out / f"{Path(picture.name).stem}_mask.png")
        with atomic_path(files[-1]) as temporary:
            Image.fromarray(mask).save(temporary, "PNG")
    return files
