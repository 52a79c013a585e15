"""The verb `label next`: which photo shows most of what is not known yet."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..params import LabelNextParams
from ..progress import Reporter
from ..project.store import load_project
from .journal import marks_at, read_marks
from .lookup import Labelling
from .preparation import Preparation
from .revisions import computed

BLANK_BONUS = 0.5  # of surfels that no class explains: what is there may be a class without marks; not tuned


def next_photo(params: LabelNextParams, report: Reporter) -> dict[str, Any]:
    """The photos that are most useful to mark next, best first.

    Returns:
        {"photos": [{"name", "score": share of the doubt in the scene that the photo shows, "void": share of its surface
        that is void, "marks"}], "revision"}
    Raises:
        ProjectError: the run was not prepared or the revision not propagated. InputError: no such revision.
    """
    folder = Path(params.project)
    load_project(folder)
    ready, labelling = computed(folder, params.run, params.revision)
    marks = marks_at(read_marks(folder), labelling.revision)
    marked = [mark.photo for mark in marks]
    scores = usefulness(ready, labelling)
    void = 1 - labelling.probability.sum(1)
    listed = []
    for index in np.argsort(-scores, kind="stable")[: params.count].tolist():
        name = ready.photos[index].name
        seen = shown_by(ready, name)
        blank = float(void[seen].mean()) if len(seen) else 1.0
        entry = {"name": name, "score": float(scores[index]), "void": blank, "marks": marked.count(name)}
        listed.append({key: round(v, 4) if isinstance(v, float) else v for key, v in entry.items()})
    return {"photos": listed, "revision": labelling.revision}


def usefulness(ready: Preparation, labelling: Labelling) -> np.ndarray:
    """Share (V,) of the scene's doubt that each photo shows: Σ over the surfels in it of entropy (of classes and void, in
    units of its maximum) and a bonus for void."""
    p = np.concatenate([labelling.probability, 1 - labelling.probability.sum(1, keepdims=True)], 1).clip(1e-9, 1)
    entropy = -(p * np.log(p)).sum(1) / np.log(max(p.shape[1], 2))
    doubt = entropy + BLANK_BONUS * p[:, -1]
    total = max(float(doubt.sum()), 1e-9)
    return np.array([doubt[shown_by(ready, photo.name)].sum() / total for photo in ready.photos])


def shown_by(ready: Preparation, photo: str) -> np.ndarray:
    """The surfels (S,) that a photo shows, each once."""
    surfel, _ = ready.map_of(photo)
    seen = np.unique(surfel)
    return seen[seen >= 0]
