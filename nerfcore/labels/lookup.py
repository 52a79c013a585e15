"""What labelling leaves in a run, looked up with numpy alone: Blender's side reads it too.

runs/RUN/surfels/prepared.json, pixel_surfel.npy   which pixel of which photo shows which surfel
runs/RUN/surfels/parts.npy                         the parts of the surface that surfels belong to, at two levels
runs/RUN/revisions/N.npz                           the labels of the surfels at revision N of the marks
runs/RUN/revisions/parts.npz                       those of the parts alone, of the revision that was last begun
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..files import UNREADABLE_ARRAYS

SURFELS, RECORD = "surfels", "prepared.json"
REVISIONS, FIRST = "revisions", "parts.npz"
UNREADABLE = (*UNREADABLE_ARRAYS, KeyError, TypeError)  # what damaged files raise
LEVELS = ("fine", "coarse")  # of the parts of the surface
LEAST = 0.5  # probability of all classes together below which a surfel is void


@dataclass(frozen=True)
class PhotoMap:
    """Where the map of one photo lies: its name, width and height of the map, and its first pixel among those of all."""

    name: str
    width: int
    height: int
    first: int


@dataclass(frozen=True)
class Labelling:
    """What a revision says of N surfels: probability (N, C) of each class, what is missing to 1 being void; class_ids (C,);
    made: digest of the marks and the preparation it comes from; told: what `label propagate` said of it;
    carried: (N,) which are labelled as an earlier epoch was, and nobody confirmed it, None for none."""

    revision: int
    probability: np.ndarray
    class_ids: np.ndarray
    made: str
    told: dict[str, Any] = field(default_factory=dict)
    carried: np.ndarray | None = None

    def label(self, void: int) -> np.ndarray:
        """Class id (N,) int32 of each surfel; `void` where no class explains it."""
        return np.append(self.class_ids, void).astype(np.int32)[self._best]

    def confidence(self) -> np.ndarray:
        """Probability (N,) float32 of what `label` says, void included."""
        return self._sure

    @cached_property
    def _total(self) -> np.ndarray:
        return self.probability @ np.ones(self.probability.shape[1], np.float32)

    @cached_property
    def _best(self) -> np.ndarray:
        """Class index (N,) of each surfel, that behind the last one where it is void."""
        if not len(self.class_ids):
            return np.zeros(len(self.probability), np.intp)
        return np.where(self._total > LEAST, self.probability.argmax(1), len(self.class_ids))

    @cached_property
    def _sure(self) -> np.ndarray:
        best = self.probability.max(1, initial=0)
        return np.where(self._total > LEAST, best, 1 - self._total).clip(0, 1).astype(np.float32)


def read_labelling(path: Path) -> Labelling | None:
    """The labels in a file of runs/RUN/revisions; None where they were not computed or cannot be read."""
    try:
        with np.load(path, allow_pickle=False) as data:
            probability = data["probability"].astype(np.float32)
            told = json.loads(str(data["told"])) if "told" in data else {}
            carried = data.get("carried", None)
            return Labelling(int(data["revision"]), probability, data["class_ids"], str(data["made"]), told, carried)
    except UNREADABLE:
        return None


def read_first(revisions: Path, surfels: Path, revision: int) -> Labelling | None:
    """The labels of a revision by whole parts, which are there before those of the surfels; None where the folder
    runs/RUN/revisions holds none, or those of another revision."""
    found = read_labelling(revisions / FIRST)
    if found is None or found.revision != revision:
        return None
    try:
        part = np.load(surfels / "parts.npy", mmap_mode="r", allow_pickle=False)[:, 0]
        return Labelling(revision, found.probability[part], found.class_ids, f"{found.made} by parts", found.told)
    except (*UNREADABLE, IndexError):
        return None


def photo_maps(record: dict[str, Any]) -> dict[str, PhotoMap]:
    """The photos of a preparation, by name. Raises KeyError or TypeError where the record is none of one."""
    return {photo["name"]: PhotoMap(**photo) for photo in record["photos"]}


def surfel_map(surfels: Path, name: str) -> np.ndarray | None:
    """Surfel (H, W) int32 of each pixel of a photo's map, −1 for none; None where runs/RUN/surfels has none of it."""
    try:
        photo = photo_maps(json.loads((surfels / RECORD).read_text(encoding="utf-8")))[name]
        pixels = np.load(surfels / "pixel_surfel.npy", mmap_mode="r", allow_pickle=False)
        return np.array(part_of(pixels, photo))
    except UNREADABLE:
        return None


def part_of(pixels: np.ndarray, photo: PhotoMap) -> np.ndarray:
    """The map (H, W) of one photo among those of all (P,)."""
    return pixels[photo.first : photo.first + photo.width * photo.height].reshape(photo.height, photo.width)


def part_map(surfels: Path, shown: np.ndarray, level: str) -> np.ndarray | None:
    """Part (H, W) of each pixel of a map (H, W) of surfels, −1 for none; None where runs/RUN/surfels has none of it."""
    try:
        parts = np.load(surfels / "parts.npy", mmap_mode="r", allow_pickle=False)[:, LEVELS.index(level)]
        return np.append(parts, -1)[shown]
    except (*UNREADABLE, IndexError):
        return None


def outlines(part: np.ndarray) -> np.ndarray:
    """Pixels (H, W) bool of a map of parts (H, W) at whose right or lower side another part begins."""
    found = np.zeros(part.shape, bool)
    found[:, :-1] |= part[:, :-1] != part[:, 1:]
    found[:-1] |= part[:-1] != part[1:]
    return found
