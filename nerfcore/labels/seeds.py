"""From marks on photos to known surfels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from .drawing import covered
from .journal import Mark
from .preparation import Preparation

VOID = -1  # class index of surfels that are marked as none of the classes
UNMARKED = -2


@dataclass(frozen=True)
class Seeds:
    """Known surfels, ascending: surfel (S,), label (S,) class index or VOID, mark (S,) revision of the mark each is from;
    conflicts: [{"revision", "other", "surfels"}] of marks that say different things of the same place; unused: revisions
    of marks that met no surface."""

    surfel: np.ndarray
    label: np.ndarray
    mark: np.ndarray
    conflicts: list[dict[str, int]]
    unused: list[int]


def seeds_of(
    ready: Preparation, marks: Sequence[Mark], class_ids: Sequence[int], sizes: Mapping[str, tuple[int, int]]
) -> Seeds:
    """The surfels that marks cover, of which the latest mark decides. Pixels at depth edges say nothing: their rays may hit
    what lies behind.

    Args:
        class_ids: id of each class index. sizes: width and height of the photos the marks were drawn on, by name.
    Raises:
        InputError: a marked photo has no pose any more.
    """
    index = {class_id: number for number, class_id in enumerate(class_ids)}
    label = np.full(len(ready.surfels), UNMARKED, np.int32)
    source = np.zeros(len(ready.surfels), np.int32)
    overlaps: dict[tuple[int, int], int] = {}
    unused = []
    for mark in marks:
        if mark.class_id is not None and mark.class_id not in index:
            unused.append(mark.revision)
            continue
        surfels = marked_surfels(ready, mark, sizes[mark.photo])
        if not len(surfels):
            unused.append(mark.revision)
        elif mark.erase:
            label[surfels] = UNMARKED
        else:
            new = VOID if mark.class_id is None else index[mark.class_id]
            other = surfels[(label[surfels] != UNMARKED) & (label[surfels] != new)]
            for revision, count in zip(*np.unique(source[other], return_counts=True)):
                overlaps[mark.revision, int(revision)] = int(count)
            label[surfels], source[surfels] = new, mark.revision
    surfel = np.flatnonzero(label != UNMARKED)
    conflicts = [{"revision": a, "other": b, "surfels": count} for (a, b), count in sorted(overlaps.items())]
    return Seeds(surfel, label[surfel], source[surfel], conflicts, unused)


def marked_surfels(ready: Preparation, mark: Mark, size: tuple[int, int]) -> np.ndarray:
    """The surfels (S,) that a mark on a photo of this width and height covers, each once; with shape "part" all those of
    the parts that are covered."""
    surfel, edge = ready.map_of(mark.photo)
    rows, columns = surfel.shape
    scale = columns / size[0]
    points = np.array(mark.points, np.float64) * [scale, rows / size[1]]
    touched = covered(mark.shape, points, mark.width * scale, columns, rows) & (surfel >= 0)
    clear = touched & ~edge
    found = np.unique(surfel[touched if mark.erase else clear])
    return np.flatnonzero(np.isin(ready.part, ready.part[found])) if mark.shape == "part" else found
