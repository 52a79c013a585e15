"""The verb `label propagate`: from the marks of a revision to the class of every surfel."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..params import LabelPropagateParams
from ..progress import Reporter
from ..project.runs import run_folder
from ..project.store import load_project
from .carry import carried_classes
from .doubts import doubtful
from .journal import marks_at, read_marks, shown_revision
from .lookup import Labelling
from .part_labels import by_parts
from .preparation import FOLDER, Preparation, current, ensured
from .propagation import propagated, trusted
from .revisions import computed, load, made_of, path_of, save, save_first
from .seeds import UNMARKED, Seeds, seeds_of


def propagate(params: LabelPropagateParams, report: Reporter) -> dict[str, Any]:
    """Carry the marks of a revision over the surface; the run is prepared where it is not.

    Returns:
        {"revision", "marks", "surfels", "void": share of the surfels that no class explains, "carried": share that an earlier
        epoch says and nobody confirmed, "confidence": mean of the labelled ones, "classes": [{"id", "name", "surfels", "confidence"}], "conflicts": [{"revision", "other", "surfels"}],
        "doubtful": [{"revision", "looks_like": class id}] of marks that look more like those of another class,
        "unused": revisions of marks that met no surface, or whose class, photo or its pose is gone, "erased": revisions of
        marks of which an eraser left nothing, "self_check": share of the marks of each
        photo that those on the others guess, "parts_seconds": until the labels of whole
        parts were on disk, "seconds", "file"}
    Raises:
        ProjectError: there is no trained run, or the journal is damaged. InputError: there is no such revision.
        TrainingError, DiskError, Cancelled.
    """
    folder = Path(params.project)
    project, marks = load_project(folder), read_marks(folder)
    revision = shown_revision(folder, len(marks)) if params.revision is None else params.revision
    at = marks_at(marks, revision)
    ready, _ = ensured(folder, params.run, report)
    begin = time.perf_counter()
    report.stage("Propagating")
    marked = {mark.class_id for mark in at} | carried_classes(folder, at)
    class_ids = [c.id for c in project.classes if c.id in marked]
    sizes = {image.name: (image.width, image.height) for image in project.images}
    seeds = seeds_of(ready, at, class_ids, sizes)
    made, ids = made_of(ready, at, class_ids), np.array(class_ids, np.int32)
    save_first(folder, params.run, Labelling(revision, by_parts(ready, seeds, len(class_ids), report.check), ids, made))
    parts_seconds = time.perf_counter() - begin
    report.progress(0.2)  # who follows the job looks at the parts now
    start = warm_start(folder, params.run, ready, class_ids, at[-1].parent if at else None)
    trust = trusted(ready, seeds, len(class_ids), report.check)
    probability = propagated(ready, seeds, len(class_ids), start, report.check, trust)
    labelling = Labelling(revision, probability, ids, made)
    labelling = replace(labelling, carried=unconfirmed(labelling, seeds))
    label, sure = labelling.label(project.ignore_id), labelling.confidence()
    names = {c.id: c.name for c in project.classes}
    told = {
        "revision": revision,
        "marks": len(at),
        "surfels": len(label),
        "void": round(float((label == project.ignore_id).mean()), 4),
        "confidence": _mean(sure[label != project.ignore_id]),
        "classes": [
            {"id": i, "name": names[i], "surfels": int((label == i).sum()), "confidence": _mean(sure[label == i])}
            for i in class_ids
        ],
        "conflicts": seeds.conflicts,
        "doubtful": [
            {"revision": mark, "looks_like": class_ids[index]} for mark, index in doubtful(ready, seeds, len(class_ids))
        ],
        "unused": seeds.unused,
        "erased": seeds.erased,
        "carried": 0.0 if labelling.carried is None else round(float(labelling.carried.mean()), 4),
        "self_check": None if trust.right is None else round(trust.right, 4),
        "parts_seconds": round(parts_seconds, 3),
        "seconds": round(time.perf_counter() - begin, 3),
    }
    return {**told, "file": str(save(folder, params.run, replace(labelling, told=told)))}


def propagated_labels(folder: Path, run: str, revision: int | None, report: Reporter) -> tuple[Preparation, Labelling]:
    """The preparation of a run and the labels of a revision (None: the one that is shown), made anew where the run was aligned,
    trained further or got other poses since.

    Raises:
        as `computed` and `propagate`.
    """
    if (run_folder(folder, run) / FOLDER).is_dir() and current(folder, run) is None:
        propagate(LabelPropagateParams(project=folder, run=run, revision=revision), report)
    return computed(folder, run, revision)


def unconfirmed(labelling: Labelling, seeds: Seeds) -> np.ndarray | None:
    """Which surfels (N,) have the class that an earlier epoch gave them, without anybody having said so; None where nothing
    was carried."""
    if seeds.carried is None or not len(labelling.class_ids):
        return None
    told = seeds.carried.label
    wanted = np.append(labelling.class_ids, UNMARKED)[np.where(told >= 0, told, -1)]
    found = (told >= 0) & (labelling.label(UNMARKED) == wanted) & ~seeds.carried.confirmed
    found[seeds.surfel] = False
    return found


def warm_start(
    folder: Path, run: str, ready: Preparation, class_ids: list[int], revision: int | None
) -> np.ndarray | None:
    """Probabilities (N, C) of an earlier revision to begin with; None where it was not computed for these surfels."""
    if revision is None or not path_of(folder, run, revision).is_file():
        return None
    earlier = load(folder, run, revision)
    if earlier is None or len(earlier.probability) != len(ready.surfels):
        return None
    start = np.zeros((len(ready.surfels), len(class_ids)), np.float32)
    for number, class_id in enumerate(earlier.class_ids.tolist()):
        if class_id in class_ids:
            start[:, class_ids.index(class_id)] = earlier.probability[:, number]
    return start


def _mean(values: np.ndarray) -> float | None:
    return round(float(values.mean()), 4) if len(values) else None
