"""What was propagated, as the panels and the overlay show it: looked up on disk, without the engine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...nerfcore.labels.lookup import (
    FIRST,
    RECORD,
    REVISIONS,
    SURFELS,
    Labelling,
    outlines,
    part_map,
    read_first,
    read_labelling,
    surfel_map,
)
from ..project import snapshot
from . import journal

UNSURE = 0.75  # confidence below which a place is hatched; see the calibration in docs/experiments.md
DOTS = 6  # pixels of the map from one white dot to the next, where labels are carried and not confirmed
STRIPE = 6  # pixels of the map from one stripe of the hatching to the next
VOID_COLOR = (0.12, 0.12, 0.12)

_labellings: dict[Path, tuple[tuple[int, ...], Labelling | None]] = {}
_maps: dict[tuple[Path, str], tuple[tuple[int, int], np.ndarray | None]] = {}
KEPT = 8  # of each that are remembered


@dataclass(frozen=True)
class ClassShare:
    """What a class has of the surface: share in [0, 1] of the surfels, mean confidence, None where it has none."""

    share: float
    confidence: float | None


def run_of(folder: Path, run: str) -> Path:
    return folder / "runs" / run


def prepared(folder: Path, run: str) -> bool:
    """Whether a run was prepared for labelling (perhaps before it was trained anew: the engine knows)."""
    return (run_of(folder, run) / SURFELS / RECORD).is_file()


def computed(folder: Path, run: str, revision: int) -> bool:
    """Whether the labels of a revision are there, of the present preparation."""
    return _file(folder, run, revision) is not None


def is_current(folder: Path, run: str, revision: int) -> bool:
    """Whether the labels of a revision are there and the project still has all their classes."""
    found = labelling(folder, run, revision)
    return found is not None and set(found.class_ids.tolist()) <= class_ids(folder)


def nearest_computed(folder: Path, run: str, revision: int) -> int | None:
    """The revision, or the youngest it was drawn on, whose labels are there; None where there is none."""
    found = (number for number in journal.ancestry(folder, revision) if computed(folder, run, number))
    return next(found, None)


def to_show(folder: Path, run: str, revision: int) -> Labelling | None:
    """The labels of a revision; while they are computed those of whole parts, and before these the ones of the youngest
    revision it was drawn on. None where there are none."""
    if not computed(folder, run, revision):
        begun = _first(folder, run, revision)
        if begun is not None:
            return begun
    return labelling(folder, run, nearest_computed(folder, run, revision))


def _first(folder: Path, run: str, revision: int) -> Labelling | None:
    """The labels of a revision by whole parts; None where they are not there."""
    place, changed = run_of(folder, run), _changed(folder, run, FIRST)
    if changed is None:
        return None
    path, key = place / REVISIONS / FIRST, (*changed, revision)
    if path not in _labellings or _labellings[path][0] != key:
        _remember(_labellings, path, (key, read_first(place / REVISIONS, place / SURFELS, revision)))
    return _labellings[path][1]


def _file(folder: Path, run: str, revision: int) -> tuple[Path, tuple[int, int]] | None:
    """The file of a revision and what changes with it; None where it is missing or older than the preparation."""
    changed = _changed(folder, run, f"{revision}.npz")
    return None if changed is None else (run_of(folder, run) / REVISIONS / f"{revision}.npz", changed)


def _changed(folder: Path, run: str, name: str) -> tuple[int, int] | None:
    """What changes with a file of labels; None where it is missing or older than the preparation."""
    path = run_of(folder, run) / REVISIONS / name
    try:
        made, ready = path.stat(), (run_of(folder, run) / SURFELS / RECORD).stat()
    except OSError:
        return None
    return (made.st_mtime_ns, made.st_size) if made.st_mtime_ns >= ready.st_mtime_ns else None


def labelling(folder: Path, run: str, revision: int | None) -> Labelling | None:
    """The labels of a revision; None where they are not there."""
    found = None if revision is None else _file(folder, run, revision)
    if found is None:
        return None
    path, changed = found
    if path not in _labellings or _labellings[path][0] != changed:
        _remember(_labellings, path, (changed, read_labelling(path)))
    return _labellings[path][1]


def photo_map(folder: Path, run: str, photo: str) -> np.ndarray | None:
    """Surfel (H, W) of each pixel of a photo's map, −1 for none; None where the run was not prepared or has no such photo."""
    surfels, changed = run_of(folder, run) / SURFELS, prepared_at(folder, run)
    if changed is None:
        return None
    key = (surfels, photo)
    if key not in _maps or _maps[key][0] != changed:
        _remember(_maps, key, (changed, surfel_map(surfels, photo)))
    return _maps[key][1]


def prepared_at(folder: Path, run: str) -> tuple[int, int] | None:
    """What changes whenever a run is prepared anew; None where it was not."""
    try:
        stat = (run_of(folder, run) / SURFELS / RECORD).stat()
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_size


def part_outlines(folder: Path, run: str, photo: str, level: str) -> np.ndarray | None:
    """White outlines of the parts that a photo shows as RGBA (H, W, 4) float32, rows from the bottom; clear elsewhere. None
    where the run was not prepared."""
    surfels = photo_map(folder, run, photo)
    parts = None if surfels is None else part_map(run_of(folder, run) / SURFELS, surfels, level)
    if parts is None:
        return None
    return np.ascontiguousarray(np.repeat(outlines(parts)[::-1, :, None], 4, 2).astype(np.float32))


def _remember(cache: dict[Any, Any], key: Any, value: Any) -> None:
    cache.pop(key, None)
    cache[key] = value
    while len(cache) > KEPT:
        del cache[next(iter(cache))]


def shares(found: Labelling, void: int) -> tuple[dict[int, ClassShare], float]:
    """What each class id has of the surface, and what share of it is void."""
    label, sure = found.label(void), found.confidence()
    whole = max(1, len(label))
    told = {}
    for class_id in found.class_ids.tolist():
        own = label == class_id
        count = int(np.count_nonzero(own))
        told[class_id] = ClassShare(count / whole, float(sure[own].mean()) if count else None)
    return told, float(np.count_nonzero(label == void) / whole)


def overlay(
    found: Labelling, surfels: np.ndarray, colors: dict[int, tuple[float, float, float]], void: int, confidence: bool
) -> np.ndarray:
    """The labels of a photo as RGBA (H, W, 4) float32, sRGB, rows from the bottom as Blender has them.

    Where no surface is it is clear, and so is void. What an earlier epoch gave and nobody confirmed is dotted. With `confidence` unsure places are hatched, and void
    is dark.

    Args:
        surfels: (H, W) of the photo. colors: of the classes by id.
    """
    label = np.append(found.label(void), -1)
    sure = np.append(found.confidence(), 1.0).astype(np.float32)
    table = np.zeros((max([void, *label.tolist(), *colors]) + 2, 4), np.float32)  # the last row is that of no surface
    for class_id, color in colors.items():
        if class_id != void:
            table[class_id] = (*color, 1.0)
    if confidence:
        table[void] = (*VOID_COLOR, 1.0)
    picture = table[label[surfels]]
    if found.carried is not None:
        y, x = np.indices(surfels.shape)
        dots = (x % DOTS < DOTS // 2) & (y % DOTS < DOTS // 2) & np.append(found.carried, False)[surfels]
        picture[dots & (picture[..., 3] > 0), :3] = 1.0
    if confidence:
        y, x = np.indices(surfels.shape)
        stripe = ((x + y) % STRIPE < STRIPE // 2) & (sure[surfels] < UNSURE) & (picture[..., 3] > 0)
        picture[stripe, :3] *= 0.25
    return np.ascontiguousarray(picture[::-1])


def linear(srgb: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values in [0, 1]."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def class_ids(folder: Path) -> set[int]:
    """The ids of the project's classes."""
    return {int(entry["id"]) for entry in (snapshot.project(folder) or {}).get("classes", [])}


def void_of(folder: Path) -> int:
    """The id in label maps that stands for no class."""
    return int((snapshot.project(folder) or {}).get("ignore_id", 0))
