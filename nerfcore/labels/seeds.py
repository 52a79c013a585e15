"""From marks on photos to known surfels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import scipy

from ..errors import ProjectError
from ..files import UNREADABLE_ARRAYS
from ..geometry.similarity import similarity_scale, transform_points
from ..project.store import load_project, world_from_marks
from .drawing import covered
from .journal import Mark
from .lookup import LEVELS
from .preparation import Preparation

VOID = -1  # class index of surfels that are marked as none of the classes
UNMARKED = -2
SAME_SIDE = 0.3  # cosine between normals of one side of a surface
OFF_IT = 3.0  # distances of neighbouring surfels that a drawn place may be off them. Not tuned
MOST_STEPS = 10_000  # of a brush between two places


@dataclass(frozen=True)
class Seeds:
    """Known surfels, ascending: surfel (S,), label (S,) class index or VOID, mark (S,) revision of the mark each is from;
    conflicts: [{"revision", "other", "surfels"}] of marks that say different things of the same place; unused: revisions
    of marks that met no surface, or whose photo or class is gone; photo (S,): number of the photo that each mark is on, all on the surface having one more;
    erased: revisions of marks of which an eraser left nothing.
    """

    surfel: np.ndarray
    label: np.ndarray
    mark: np.ndarray
    conflicts: list[dict[str, int]]
    unused: list[int]
    carried: Carried | None = None
    photo: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))
    erased: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class Carried:
    """What an earlier epoch says of N surfels: label (N,) class index, VOID or UNMARKED where it says nothing; sure (N,) in
    [0, 1]; confirmed: whether somebody said that it is right."""

    label: np.ndarray
    sure: np.ndarray
    confirmed: np.ndarray


def seeds_of(
    ready: Preparation, marks: Sequence[Mark], class_ids: Sequence[int], sizes: Mapping[str, tuple[int, int]]
) -> Seeds:
    """The surfels that marks cover, of which the latest mark decides. Pixels at depth edges say nothing: their rays may hit
    what lies behind.

    Args:
        class_ids: id of each class index. sizes: width and height of the photos, by name.
    Raises:
        ProjectError: carried labels are missing or damaged.
    """
    index = {class_id: number for number, class_id in enumerate(class_ids)}
    label = np.full(len(ready.surfels), UNMARKED, np.int32)
    source = np.zeros(len(ready.surfels), np.int32)
    overlaps: dict[tuple[int, int], int] = {}
    unused, wiped = [], set()
    carried: Carried | None = None
    for mark in marks:
        if mark.shape == "carried":
            carried = carried_labels(ready, ready.folder.parents[2] / mark.file, class_ids)
            continue
        if mark.shape == "confirmed":
            if carried is not None:
                carried.confirmed[:] = True
            continue
        gone = bool(mark.photo) and (mark.photo not in sizes or mark.photo not in ready.of_photo)
        if gone or (mark.class_id is not None and mark.class_id not in index):
            unused.append(mark.revision)
            continue
        if mark.places:
            surfels = placed_surfels(ready, mark)
        else:
            surfels = marked_surfels(ready, mark, mark.size or sizes[mark.photo])
        if not len(surfels):
            unused.append(mark.revision)
        elif mark.erase:
            wiped |= set(np.unique(source[surfels[label[surfels] != UNMARKED]]).tolist())
            label[surfels] = UNMARKED
            if carried is not None:
                carried.label[surfels] = UNMARKED
        else:
            new = VOID if mark.class_id is None else index[mark.class_id]
            other = surfels[(label[surfels] != UNMARKED) & (label[surfels] != new)]
            for revision, count in zip(*np.unique(source[other], return_counts=True)):
                overlaps[mark.revision, int(revision)] = int(count)
            label[surfels], source[surfels] = new, mark.revision
    surfel = np.flatnonzero(label != UNMARKED)
    left = set(np.unique(source[surfel]).tolist())
    conflicts = [
        {"revision": a, "other": b, "surfels": count} for (a, b), count in sorted(overlaps.items()) if a in left
    ]
    names = sorted({mark.photo for mark in marks})
    number = {mark.revision: names.index(mark.photo) for mark in marks}
    photo = np.array([number[revision] for revision in source[surfel].tolist()], np.int32)
    return Seeds(surfel, label[surfel], source[surfel], conflicts, unused, carried, photo, sorted(wiped - left))


def one_hot(label: np.ndarray, classes: int) -> np.ndarray:
    """Probabilities (S, classes) float32 of what is certain, by class index (S,) or VOID."""
    found = np.zeros((len(label), classes), np.float32)
    known = label != VOID
    found[np.flatnonzero(known), label[known]] = 1
    return found


def marked_surfels(ready: Preparation, mark: Mark, size: tuple[int, int]) -> np.ndarray:
    """The surfels (S,) that a mark on a photo covers which had this width and height then, each once; with shape "part" all those of
    the parts that are covered (see parts.py)."""
    surfel, edge = ready.map_of(mark.photo)
    rows, columns = surfel.shape
    scale = columns / size[0]
    points = np.array(mark.points, np.float64) * [scale, rows / size[1]]
    touched = covered(mark.shape, points, mark.width * scale, columns, rows) & (surfel >= 0)
    clear = touched & ~edge
    found = np.unique(surfel[touched if mark.erase else clear])
    return whole_parts(ready, mark, found) if mark.shape == "part" else found


def placed_surfels(ready: Preparation, mark: Mark) -> np.ndarray:
    """The surfels (S,) that a mark on the surface covers, each once: those no farther from it than half of its width that
    face as the nearest one does, so that a brush on one side of a sheet leaves the other side alone. Between two places the
    brush marks nothing where it is off the surface: over a gap, or from a near thing to what is behind it."""
    to_world = world_from_marks(load_project(ready.folder.parents[2]))
    places = transform_points(to_world, np.array(mark.places, np.float64))
    radius = mark.width / 2 * similarity_scale(to_world)
    tree, normal = ready.tree, ready.world[1]
    corners = [places[:1]]
    for begin, end in pairwise(places) if mark.shape == "line" else ():
        steps = min(int(np.ceil(float(np.linalg.norm(end - begin)) / max(radius / 2, 1e-9))), MOST_STEPS)
        corners.append(begin + (end - begin) * (np.arange(1, steps + 1) / max(steps, 1))[:, None])
    along = np.concatenate(corners) if mark.shape == "line" else places
    distance, nearest = (np.asarray(part) for part in tree.query(along))
    there = np.isfinite(distance)
    spacing = np.full(len(along), np.inf)
    spacing[there] = np.linalg.norm(
        ready.world[0][ready.neighbours[nearest[there], -1]] - ready.world[0][nearest[there]], axis=1
    )
    # Where it was drawn the surface may be a little off the surfels.
    drawn = np.ones(len(along), bool)
    if mark.shape == "line":
        drawn[:] = False
        drawn[np.cumsum([0, *(len(part) for part in corners[1:])])] = True
    on_it = there & (distance <= np.maximum(radius, np.where(drawn, OFF_IT, 1) * spacing))
    along, nearest = along[on_it], nearest[on_it]
    if not len(nearest):
        return np.zeros(0, np.int64)
    if mark.shape == "part":
        return whole_parts(ready, mark, np.unique(nearest))
    found = [nearest]
    for number, near in zip(nearest, tree.query_ball_point(along, radius)):
        near = np.array(near, np.int64)
        found.append(near[normal[near] @ normal[number] > SAME_SIDE])
    return np.unique(np.concatenate(found))


def whole_parts(ready: Preparation, mark: Mark, surfels: np.ndarray) -> np.ndarray:
    """All surfels of the parts, at the mark's level, that some surfels (S,) are of."""
    part = np.asarray(ready.parts[:, LEVELS.index(mark.level)])
    return np.flatnonzero(np.isin(part, part[surfels]))


def carried_labels(ready: Preparation, path: Path, class_ids: Sequence[int]) -> Carried:
    """What a file of carried labels (see carry.py) says of the present surfels.

    Raises:
        ProjectError: it is missing or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            places, told, sure, reach = data["places"], data["class_id"], data["sure"], float(data["reach"])
    except (*UNREADABLE_ARRAYS, KeyError) as error:
        raise ProjectError(
            f"The labels that were carried are not readable: {path} ({error}).",
            "Show the revision before them (`fieldwork label checkout`), and carry them again.",
        ) from error
    marks_from_world = np.linalg.inv(world_from_marks(load_project(ready.folder.parents[2])))
    distance, nearest = scipy.spatial.KDTree(places).query(transform_points(marks_from_world, ready.world[0]))
    index = np.full(max([*class_ids, int(told.max(initial=0))]) + 1, UNMARKED, np.int32)
    index[list(class_ids)] = np.arange(len(class_ids))
    label = np.where(np.asarray(distance) <= reach, index[told[nearest]], UNMARKED).astype(np.int32)
    return Carried(label, sure[nearest].astype(np.float32), np.zeros(len(label), bool))
