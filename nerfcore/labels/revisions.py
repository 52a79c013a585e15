"""Labels of the surfels at a revision of the marks, as `label propagate` leaves them in runs/RUN/revisions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ..errors import ProjectError
from ..files import atomic_path
from ..project.fingerprints import digest
from ..project.runs import run_folder
from ..project.store import load_project
from .journal import Mark, marks_at, read_marks, shown_revision
from .lookup import FIRST, REVISIONS, Labelling, read_labelling
from .preparation import Preparation, current

KEPT = 32  # results; the oldest go first


def made_of(ready: Preparation, marks: list[Mark], class_ids: list[int]) -> str:
    """Digest of what labels are made from."""
    said = [mark.model_dump(mode="json", exclude=None if mark.size else {"size"}) for mark in marks]
    return digest([ready.inputs, said, class_ids])


def path_of(project: Path, run: str, revision: int) -> Path:
    return run_folder(project, run) / REVISIONS / f"{revision}.npz"


def save(project: Path, run: str, labelling: Labelling) -> Path:
    """Atomically write the labels of a revision, and forget the oldest ones beyond `KEPT`. Raises DiskError."""
    path = _written(path_of(project, run, labelling.revision), labelling)
    others = sorted((p for p in path.parent.glob("*.npz") if p.name != FIRST), key=lambda p: p.stat().st_mtime)
    for old in others[:-KEPT]:
        old.unlink(missing_ok=True)  # another engine may be at it, too
    return path


def save_first(project: Path, run: str, labelling: Labelling) -> Path:
    """Atomically write the labels of parts, probability (P, C), in the place of those of an earlier revision. Raises
    DiskError."""
    return _written(path_of(project, run, labelling.revision).with_name(FIRST), labelling)


def _written(path: Path, labelling: Labelling) -> Path:
    more = {} if labelling.carried is None else {"carried": labelling.carried}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez(
            file,
            revision=labelling.revision,
            probability=labelling.probability.astype(np.float16),
            class_ids=labelling.class_ids,
            made=labelling.made,
            told=json.dumps(labelling.told),
            **more,
        )
    return path


def load(project: Path, run: str, revision: int) -> Labelling | None:
    """The labels of a revision; None where they were not computed or cannot be read."""
    return read_labelling(path_of(project, run, revision))


def computed(project: Path, run: str, revision: int | None) -> tuple[Preparation, Labelling]:
    """The preparation of a run and the labels of a revision (None: the one that is shown), both of its present field.

    Raises:
        ProjectError: the run was not prepared, or the revision not propagated, since it was trained; a class is gone.
        InputError: there is no such revision.
    """
    ready = current(project, run)
    if ready is None:
        raise ProjectError(
            f"The run “{run}” of {project} is not prepared for labelling since it was trained, aligned or got other poses.",
            "Run `fieldwork label propagate`, which prepares it too.",
        )
    marks = read_marks(project)
    wanted = shown_revision(project, len(marks)) if revision is None else revision
    at = marks_at(marks, wanted)
    found = load(project, run, wanted)
    if found is None or found.made != made_of(ready, at, found.class_ids.tolist()):
        raise ProjectError(
            f"Revision {wanted} of the marks was not propagated over the present field of the run “{run}”.",
            "Run `fieldwork label propagate`.",
        )
    if not set(found.class_ids.tolist()) <= {c.id for c in load_project(project).classes}:
        raise ProjectError(
            f"Revision {wanted} of the marks was propagated before a class of it was removed.",
            "Run `fieldwork label propagate`.",
        )
    return ready, found
