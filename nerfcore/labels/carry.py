"""The verb `label carry`: the labels of one epoch of an object, carried to the next capture of it.

marks/carried_DIGEST.npz   places (M, 3) in the frame of marks on the surface, class_id (M,) and sure (M,) of each, and `reach`: how far
                           from one a surfel may be to be told of it; the journal names the file
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from ..errors import InputError, ProjectError
from ..files import UNREADABLE_ARRAYS, atomic_path
from ..geometry.registration import Registered, by_points, by_surfaces
from ..geometry.similarity import similarity_scale, transform_points
from ..params import LabelCarryParams
from ..progress import Reporter
from ..project.fingerprints import array_digest
from ..project.schema import SemanticClass
from ..project.store import edit_project, load_project, world_from_marks
from .journal import FOLDER, Mark, append_mark, marks_at, read_marks, shown_revision, taken_ids
from .preparation import Preparation, ensured
from .revisions import computed

REACH = 3.0  # distances of neighbouring surfels: what is farther from the earlier surface has no counterpart there
SAME_SIDE = 0.5  # cosine between normals of what is the same surface
CHANGED = 25.0  # distance in CIE Lab, beyond which a place looks different: what stands there may be another thing
LEAST = 0.01  # share of the surface that has a counterpart, below which the epochs do not fit
POINTS = 20_000  # of a surface that is registered


@dataclass(frozen=True)
class Told:
    """Places of the present surface (N,) that the earlier epoch tells something of: class_id (N,), −1 for nothing, and how
    sure (N,)."""

    class_id: np.ndarray
    sure: np.ndarray


def carry(params: LabelCarryParams, report: Reporter) -> dict[str, Any]:
    """Carry the labels that an earlier epoch shows to this one, or confirm those that were carried.

    They count as a mark: undo takes them back. Marks that are drawn later correct them. Both runs are prepared where they
    are not.

    Returns:
        {"revision", "carried": share of the surface that got a class, "unmatched": share without a counterpart,
        "changed": share that looks different and got none, "rms": of the registration in world units, None when
        confirming, "classes": names that were new to the project}
    Raises:
        ProjectError: one of them has no trained run, or the earlier one no labels. InputError: the epochs do not fit, the
        file of common points, nothing to carry or to confirm. TrainingError, DiskError, Cancelled.
    """
    folder = Path(params.project)
    if params.other is None:
        return confirm(folder, params.author)
    other = Path(params.other)
    project, earlier = load_project(folder), load_project(other)
    past, labelling = computed(other, params.other_run, None)
    if not len(labelling.class_ids):
        raise InputError(f"{other} shows no labels.", "Label it first, or show a revision with marks there.")
    now, _ = ensured(folder, params.run, report)
    report.stage("Registering")
    with_scale = not (project.frame.scale_known and earlier.frame.scale_known)
    found = by_points(params.points, with_scale) if params.points else registered(now, past, with_scale, report)
    report.stage("Carrying labels")
    names = {c.id: c for c in earlier.classes}
    label = labelling.label(-1)
    told, spacing, share = counterparts(now, past, label, labelling.confidence(), found)
    if share["unmatched"] > 1 - LEAST:
        raise InputError(
            f"Next to nothing of {folder} lies where {other} was: the epochs were not registered.",
            "Give common points (--points), or align both projects.",
        )
    used = sorted(set(told.class_id[told.class_id >= 0].tolist()))
    if not used:
        raise InputError(
            f"{other} shows no class where {folder} has surface that looks the same.",
            "Mark more there, or label this one.",
        )
    ids, added = classes_of(
        folder, [names.get(i) or SemanticClass(id=i, name=str(i), color=(0.5, 0.5, 0.5)) for i in used]
    )
    mapped = np.array([ids[i] for i in used], np.int64)[np.searchsorted(used, told.class_id).clip(0, len(used) - 1)]
    chosen = told.class_id >= 0
    marks_from_world = np.linalg.inv(world_from_marks(project))
    places = transform_points(marks_from_world, now.world[0][chosen])
    file = write_carried(
        folder, places, mapped[chosen], told.sure[chosen], spacing * similarity_scale(marks_from_world)
    )
    mark = append_mark(folder, {"shape": "carried", "file": file, "author": params.author})
    return {
        "revision": mark.revision,
        "carried": round(float(chosen.mean()), 4),
        **share,
        "rms": found.rms,
        "classes": added,
    }


def confirm(folder: Path, author: str) -> dict[str, Any]:
    """Note that the labels that were carried are right. Raises InputError where none were."""
    marks = read_marks(folder)
    at = marks_at(marks, shown_revision(folder, len(marks)))
    last = next((mark.shape for mark in reversed(at) if mark.shape in ("carried", "confirmed")), None)
    if last != "carried":
        raise InputError("There are no carried labels to confirm.", "Carry some with `fieldwork label carry`.")
    mark = append_mark(folder, {"shape": "confirmed", "author": author})
    none = {"carried": 0.0, "unmatched": 0.0, "changed": 0.0}
    return {"revision": mark.revision, **none, "rms": None, "classes": []}


def registered(now: Preparation, past: Preparation, with_scale: bool, report: Reporter) -> Registered:
    """The surface of the earlier epoch brought over the present one."""
    random = np.random.default_rng(0)
    (here, normals), (there, _) = now.world, past.world
    some = random.permutation(len(here))[:POINTS]
    return by_surfaces((here[some], normals[some]), random.permutation(there)[:POINTS], with_scale, report)


def counterparts(
    now: Preparation, past: Preparation, label: np.ndarray, sure: np.ndarray, found: Registered
) -> tuple[Told, float, dict[str, float]]:
    """What the earlier epoch's labels (M,), −1 for none, say of the present surfels; the distance of neighbouring surfels
    in the world; shares of what has no counterpart and of what looks changed."""
    places, normals = now.world
    rotation = found.transform[:3, :3] / similarity_scale(found.transform)
    then, facing = transform_points(found.transform, past.world[0]), past.world[1] @ rotation.T
    spacing = float(np.median(np.asarray(now.tree.query(places, k=2)[0])[:, 1]))
    distance, nearest = (np.asarray(part) for part in scipy.spatial.KDTree(then).query(places))
    there = (distance <= REACH * spacing) & ((normals * facing[nearest]).sum(1) > SAME_SIDE)
    # Exposure may differ between the epochs as a whole: only what differs more than the rest has changed.
    shift = np.asarray(now.surfels.lab) - np.asarray(past.surfels.lab)[nearest]
    shift = shift - (np.median(shift[there], 0) if there.any() else 0)
    changed = there & (np.linalg.norm(shift, axis=1) > CHANGED)
    alike = there & ~changed
    told = np.where(alike, label[nearest], -1)
    share = {"unmatched": round(float((~there).mean()), 4), "changed": round(float(changed.mean()), 4)}
    return Told(told, np.where(alike, sure[nearest], 0).astype(np.float32)), REACH * spacing, share


def classes_of(folder: Path, wanted: list[SemanticClass]) -> tuple[dict[int, int], list[str]]:
    """The project's ids of an earlier project's classes, by their names there; classes that are missing are added. Also the
    names of those."""
    ids, added = {}, []
    with edit_project(folder) as project:
        known = {c.name: c.id for c in project.classes}
        taken = taken_ids(folder, project)
        for one in wanted:
            if one.name not in known:
                number = one.id if one.id not in taken else next(i for i in count(1) if i not in taken)
                project.classes.append(one.model_copy(update={"id": number}))
                known[one.name] = number
                taken.add(number)
                added.append(one.name)
            ids[one.id] = known[one.name]
    return ids, added


def write_carried(folder: Path, places: np.ndarray, class_id: np.ndarray, sure: np.ndarray, reach: float) -> str:
    """Write carried labels beside the journal; the path of the file in the project. Raises DiskError."""
    arrays = {
        "places": places.astype(np.float32),
        "class_id": class_id.astype(np.uint16),
        "sure": sure.astype(np.float16),
    }
    name = f"{FOLDER}/carried_{array_digest(*arrays.values())}.npz"
    with atomic_path(folder / name) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, reach=reach, **arrays)
    return name


def carried_classes(folder: Path, marks: list[Mark]) -> set[int | None]:
    """The classes that the last carried labels among these marks name. Raises ProjectError."""
    last = next((mark for mark in reversed(marks) if mark.shape == "carried"), None)
    if last is None:
        return set()
    try:
        with np.load(folder / last.file, allow_pickle=False) as data:
            return set(np.unique(data["class_id"]).tolist())
    except (*UNREADABLE_ARRAYS, KeyError) as error:
        raise ProjectError(
            f"The labels that were carried are not readable: {folder / last.file} ({error}).",
            "Show the revision before them (`fieldwork label checkout`), and carry them again.",
        ) from error
