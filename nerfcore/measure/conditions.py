"""Condition maps: classes, such as damages, hatched and outlined over a drawing; their places numbered and listed."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import scipy

from ..errors import SettingError
from ..files import atomic_path
from ..mesh.instances import Instance
from ..mesh.surface import Surface
from ..mesh.triangles import areas
from ..project.label_revision import LABEL_REVISION
from .sheet import Color, Entry, Mark, Sheet, Zone
from .views import Picture

HATCHES = ("///", "\\\\\\", "xxx", "...", "---", "+++", "|||", "ooo", "***")
ALL = "all"
SPECK = 1.0  # mm² on paper: what is smaller is not drawn; the areas have it
COLUMNS = ("number", "class", "instance", "area", "area_low", "area_high", "x", "y", "z", LABEL_REVISION)


@dataclass(frozen=True)
class Place:
    """A thing of a class that is mapped, numbered over all drawings; area, and low and high where it was measured, in
    units² of the world; center (3,)."""

    number: int
    class_id: int
    instance: int
    name: str
    area: float
    interval: tuple[float, float] | None
    center: np.ndarray


def chosen_classes(names: Sequence[str], known: dict[int, str], void: int) -> list[int]:
    """The ids of the classes called `names`, or of all of them for “all”.

    Raises:
        SettingError: there is no such class.
    """
    by_name = {name: class_id for class_id, name in known.items() if class_id != void}
    if list(names) == [ALL]:
        return sorted(by_name.values())
    missing = [name for name in names if name not in by_name]
    if missing:
        there = f"There are: {', '.join(by_name)}; or give {ALL}." if by_name else "The project has no classes yet."
        raise SettingError(f"There is no class “{missing[0]}”.", there)
    return [by_name[name] for name in names]


def find_places(
    surface: Surface, class_ids: Sequence[int], instances: Sequence[Instance], measured: dict[int, dict[str, float]]
) -> list[Place]:
    """The instances of some classes, class by class, the largest first.

    Args:
        measured: what `measure` found, by the id of the instance.
    """
    number = np.zeros(len(surface.faces), np.uint32) if surface.face_instance is None else surface.face_instance
    area = areas(surface.vertices.astype(np.float64), surface.faces)
    centers = surface.vertices[surface.faces].mean(1)
    names, places = {i.id: i.name for i in instances}, []
    for class_id in class_ids:
        own = surface.face_class == class_id
        found = [int(i) for i in np.unique(number[own]) if i]
        for instance in sorted(found, key=lambda i: -float(area[number == i].sum())):
            mine = number == instance
            row = measured.get(instance)
            interval = None if row is None else (row["area_low"], row["area_high"])
            center = np.average(centers[mine], axis=0, weights=np.maximum(area[mine], 1e-12))
            name = names.get(instance, str(instance))
            places.append(Place(len(places) + 1, class_id, instance, name, float(area[mine].sum()), interval, center))
    return places


def condition_sheet(
    sheet: Sheet, surface: Surface, seen: Picture, places: Sequence[Place], legend: dict[int, tuple[str, Color]]
) -> Sheet:
    """A drawing with the classes of `legend` {id: (text, colour)} hatched, and a number where a place is seen best."""
    pixel = float(sheet.high[0] - sheet.low[0]) / seen.face.shape[1]
    fewest = SPECK * (sheet.scale / 1000 / pixel) ** 2
    shown = np.where(seen.face >= 0, surface.face_class[seen.face], -1)
    number = None if surface.face_instance is None else np.where(seen.face >= 0, surface.face_instance[seen.face], 0)
    zones, entries, marks = [], [], []
    for turn, (class_id, (text, color)) in enumerate(legend.items()):
        hatch = HATCHES[turn % len(HATCHES)]
        entries.append(Entry(text, color, hatch))
        mask = without_specks(shown == class_id, fewest)
        if mask.any():
            zones.append(Zone(mask, color, hatch))
        for place in places:
            if place.class_id != class_id or number is None:
                continue
            mine = mask & (number == place.instance)
            if mine.sum() < fewest:
                continue
            row, column = widest(mine)
            across = float(sheet.low[0]) + (column + 0.5) * pixel
            marks.append(Mark(across, float(sheet.high[1]) - (row + 0.5) * pixel, str(place.number)))
    return replace(
        sheet,
        title=f"{sheet.title}, conditions",
        image=(255 - (255 - sheet.image.astype(np.float32)) * 0.7).astype(np.uint8),
        legend=entries,
        heading="Conditions, area on the whole surface",
        zones=zones,
        marks=marks,
    )


def without_specks(mask: np.ndarray, fewest: float) -> np.ndarray:
    """A mask (H, W) without its connected parts of fewer pixels."""
    parts, count = cast(tuple[np.ndarray, int], scipy.ndimage.label(mask, np.ones((3, 3))))
    large = np.bincount(parts.reshape(-1), minlength=count + 1) >= fewest
    large[0] = False
    return large[parts]


def widest(mask: np.ndarray) -> tuple[int, int]:
    """Row and column of the pixel of a mask (H, W) that is farthest from its outline."""
    inside = np.asarray(scipy.ndimage.distance_transform_edt(np.pad(mask, 1)))[1:-1, 1:-1]
    row, column = np.unravel_index(int(inside.argmax()), mask.shape)
    return int(row), int(column)


def write_places(path: Path, places: Sequence[Place], names: dict[int, str], label_revision: int | None) -> Path:
    """Write the numbered places as a table (.csv), each with the revision of the marks that it is from, if any. Raises
    DiskError."""
    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(COLUMNS)
        for place in places:
            low, high = ("", "") if place.interval is None else (f"{value:.6g}" for value in place.interval)
            center = [f"{value:.6g}" for value in place.center]
            name = names.get(place.class_id, "")
            rows.writerow([place.number, name, place.name, f"{place.area:.6g}", low, high, *center, label_revision])
    return path
