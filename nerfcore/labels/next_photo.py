"""The verb `label next`: which photo shows most of what is not known yet; before any mark, what is most like all the rest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..params import LabelNextParams
from ..progress import Reporter
from ..project.store import load_project
from .journal import marks_at, read_marks, shown_revision
from .lookup import Labelling
from .preparation import Preparation, ensured
from .propagate import propagated_labels

BLANK_BONUS = 0.5  # of surfels that no class explains: what is there may be a class without marks; not tuned
SAMPLES, SHOWN = 4000, 800  # surfels of the scene that are compared, and of each photo


def next_photo(params: LabelNextParams, report: Reporter) -> dict[str, Any]:
    """The photos that are most useful to mark next, best first. Without any mark the run is prepared where it is not.

    Returns:
        {"photos": [{"name", "score": see `usefulness`, and before any mark
        `first_photos`, "void": share of its surface that is void, "marks"}], "revision"}
    Raises:
        ProjectError: there is no trained run, or the revision was not propagated. InputError: no such revision.
        TrainingError, DiskError, Cancelled.
    """
    folder = Path(params.project)
    load_project(folder)
    known = read_marks(folder)
    revision = shown_revision(folder, len(known)) if params.revision is None else params.revision
    marks = marks_at(known, revision)
    marked = [mark.photo for mark in marks]
    if marks:
        ready, labelling = propagated_labels(folder, params.run, revision, report)
        scores = usefulness(ready, labelling, set(marked))
        order = np.argsort(-scores, kind="stable")[: params.count].tolist()
        best = [(ready.photos[index].name, float(scores[index])) for index in order]
        void = 1 - labelling.probability.sum(1)
    else:
        ready, _ = ensured(folder, params.run, report)
        best = first_photos(ready, [photo.name for photo in ready.photos], params.count)
        void = np.ones(len(ready.surfels))
    listed = []
    for name, score in best:
        seen = shown_by(ready, name)
        blank = float(void[seen].mean()) if len(seen) else 1.0
        entry = {"name": name, "score": round(score, 4), "void": round(blank, 4), "marks": marked.count(name)}
        listed.append(entry)
    return {"photos": listed, "revision": revision}


def usefulness(ready: Preparation, labelling: Labelling, marked: set[str]) -> np.ndarray:
    """How much (V,) marks on each photo would tell: Σ over surfels of doubt, times by how much they look more like something
    that the photo shows than like anything on those that are marked, as a share of what can be won. Doubt is the entropy of
    classes and void, in units of its maximum, and a bonus for void."""
    p = np.concatenate([labelling.probability, 1 - labelling.probability.sum(1, keepdims=True)], 1).clip(1e-9, 1)
    entropy = -(p * np.log(p)).sum(1) / np.log(max(p.shape[1], 2))
    doubt = entropy + BLANK_BONUS * p[:, -1]
    names = [photo.name for photo in ready.photos]
    some, distance = distances(ready, names)
    nearest = distance.max(0)
    for number, name in enumerate(names):
        if name in marked:
            nearest = np.minimum(nearest, distance[number])
    gain = ((nearest - distance).clip(0) * doubt[some]).sum(1)
    return gain / max(float((nearest * doubt[some]).sum()), 1e-9)


def first_photos(ready: Preparation, names: list[str], count: int) -> list[tuple[str, float]]:
    """The photos, of these names, to begin with: one after the other those by which most of the scene comes to look like
    something that a chosen photo shows. Of each the share by which it lessens the distance of surfels' columns to the nearest
    ones that are shown; before any photo that is the distance to the photo least like it."""
    _, distance = distances(ready, names)
    nearest = distance.max(0, initial=0)
    whole, left, chosen = max(float(nearest.sum()), 1e-9), list(range(len(names))), []
    while left and len(chosen) < count:
        best = min(left, key=lambda number: float(np.minimum(nearest, distance[number]).sum()))
        nearer = np.minimum(nearest, distance[best])
        chosen.append((names[best], float((nearest - nearer).sum()) / whole))
        nearest = nearer
        left.remove(best)
    return chosen


def distances(ready: Preparation, names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Some surfels (M,) of the scene, and how far each is, in columns of what it looks like, from the nearest of some surfels
    that each of the photos shows (V, M). A photo that shows none is as far as the farthest."""
    random = np.random.default_rng(0)
    total = len(ready.surfels)
    some = np.sort(random.choice(total, min(SAMPLES, total), replace=False))
    columns = ready.columns(some)
    found = np.full((len(names), len(some)), np.nan, np.float32)
    for number, name in enumerate(names):
        seen = shown_by(ready, name)
        if len(seen):
            own = ready.columns(np.sort(random.choice(seen, min(SHOWN, len(seen)), replace=False)))
            found[number] = torch.cdist(columns, own).amin(1).numpy()
    blank = np.isnan(found[:, :1])[:, 0]
    found[blank] = found[~blank].max(0) if not blank.all() else 0
    return some, found


def shown_by(ready: Preparation, photo: str) -> np.ndarray:
    """The surfels (S,) that a photo shows, each once."""
    surfel, _ = ready.map_of(photo)
    seen = np.unique(surfel)
    return seen[seen >= 0]
