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
from ..mesh.instances import GAP, Instance, joined_parts
from ..mesh.surface import Surface
from ..mesh.triangles import areas
from ..project.label_revision import LABEL_REVISION
from .sheet import Color, Entry, Mark, Sheet, Zone
from .views import Picture

HATCHES = ("///", "\\\\\\", "xxx", "...", "---", "+++", "|||", "ooo", "***")
ALL = "all"
SPECK = 1.0  # mm² on paper: what is smaller is not drawn; the areas have it
LEAST_CELLS = 4.0  # area in cells of the mesh below which a place has no number: what noise of the borders looks like
COLUMNS = ("number", "class", "instance", "area", "area_low", "area_high", "x", "y", "z", LABEL_REVISION)


@dataclass(frozen=True)
class Place:
    """A thing of a class that is mapped, numbered over all drawings; name: of its instance, empty where it is too small to be
    one; area, and low and high where it was measured, in units² of the world; center (3,)."""

    number: int
    class_id: int
    name: str
    area: float
    interval: tuple[float, float] | None
    center: np.ndarray


@dataclass(frozen=True)
class Others:
    """What of a class is too small for numbers: how many places, and their area together."""

    class_id: int
    count: int
    area: float


@dataclass(frozen=True)
class Places:
    """The numbered places; of_face (F,): which of them each face of the surface belongs to, 0 for none; the others."""

    numbered: list[Place]
    of_face: np.ndarray
    others: list[Others]


def chosen_classes(names: Sequence[str], known: dict[int, str], void: int) -> list[int]:
    """The ids of the classes called `names`, each once, or of all of them for “all”.

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
    return [by_name[name] for name in dict.fromkeys(names)]


def find_places(
    surface: Surface,
    class_ids: Sequence[int],
    instances: Sequence[Instance],
    measured: dict[int, dict[str, float]],
    voxel: float,
) -> Places:
    """The connected places of some classes, class by class, the largest first: instances, and what is too small for one.

    Args:
        measured: what `measure` found, by the id of the instance. voxel: side of the surface's cells.
    """
    vertices = surface.vertices.astype(np.float64)
    instance = np.zeros(len(surface.faces), np.int64)
    if surface.face_instance is not None:
        instance = surface.face_instance.astype(np.int64)
    area, centers = areas(vertices, surface.faces), vertices[surface.faces].mean(1)
    names = {i.id: i.name for i in instances}
    found = Places([], np.zeros(len(surface.faces), np.int64), [])
    for class_id in class_ids:
        own = np.flatnonzero(surface.face_class == class_id)
        part = _parts(surface, own, instance, voxel)
        size = np.bincount(part, area[own])
        large = (size >= LEAST_CELLS * voxel**2) | (np.bincount(part, instance[own]) > 0)
        for p in np.argsort(-size, kind="stable").tolist():
            if not large[p]:
                continue
            mine, number = own[part == p], len(found.numbered) + 1
            thing = int(instance[mine[0]])
            row = measured.get(thing)
            interval = None if row is None else (row["area_low"], row["area_high"])
            center = np.average(centers[mine], axis=0, weights=np.maximum(area[mine], 1e-12))
            name = names.get(thing, str(thing)) if thing else ""
            found.numbered.append(Place(number, class_id, name, float(size[p]), interval, center))
            found.of_face[mine] = number
        if not large.all():
            found.others.append(Others(class_id, int((~large).sum()), float(size[~large].sum())))
    return found


def _parts(surface: Surface, own: np.ndarray, instance: np.ndarray, voxel: float) -> np.ndarray:
    """Number (N,) of the place of each of the faces `own` of a class: its instance, else what hangs together."""
    part = instance[own].copy()
    loose = part == 0
    part[loose] = part.max(initial=0) + 1 + joined_parts(surface.vertices, surface.faces[own[loose]], GAP * voxel)
    return np.unique(part, return_inverse=True)[1]


def condition_sheet(
    sheet: Sheet, surface: Surface, seen: Picture, places: Places, legend: dict[int, tuple[str, Color]]
) -> Sheet:
    """A drawing with the classes of `legend` {id: (text, colour)} hatched, and a number where a place is seen best."""
    pixel = float(sheet.high[0] - sheet.low[0]) / seen.face.shape[1]
    fewest = SPECK * (sheet.scale / 1000 / pixel) ** 2
    shown = np.where(seen.face >= 0, surface.face_class[seen.face], -1)
    number = np.where(seen.face >= 0, places.of_face[seen.face], 0)
    zones, entries, marks = [], [], []
    for turn, (class_id, (text, color)) in enumerate(legend.items()):
        hatch = HATCHES[turn % len(HATCHES)]
        entries.append(Entry(text, color, hatch))
        mask = without_specks(shown == class_id, fewest)
        if mask.any():
            zones.append(Zone(mask, color, hatch))
        shown_number = np.where(mask, number, 0)
        boxes = scipy.ndimage.find_objects(shown_number, len(places.numbered))
        for place, box in zip(places.numbered, boxes):
            if box is None or place.class_id != class_id:
                continue
            mine = shown_number[box] == place.number
            if mine.sum() < fewest:
                continue
            row, column = np.add(widest(mine), [box[0].start, box[1].start]).tolist()
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


def write_places(path: Path, places: Places, names: dict[int, str], label_revision: int | None) -> Path:
    """Write the numbered places as a table (.csv), and behind them a row of each class for its others; each with the
    revision of the marks that it is from, if any. Raises DiskError."""
    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(COLUMNS)
        for place in places.numbered:
            low, high = ("", "") if place.interval is None else (f"{value:.6g}" for value in place.interval)
            center = [f"{value:.6g}" for value in place.center]
            name = names.get(place.class_id, "")
            rows.writerow([place.number, name, place.name, f"{place.area:.6g}", low, high, *center, label_revision])
        for rest in places.others:
            told = f"others ({rest.count} place{'s' if rest.count > 1 else ''})"
            name = names.get(rest.class_id, "")
            rows.writerow(["", name, told, f"{rest.area:.6g}", *[""] * 5, label_revision])
    return path
