"""Which revision of the marks classes are from, and how files say so."""

from __future__ import annotations

import re

from .schema import Project

LABEL_REVISION = "label_revision"  # what results and files call it
MAPS = "labels/revision_{}"  # in the project: the label maps that were made from the marks of a revision
SUGGESTED = "labels/suggested"  # in the project: those that a model guessed


def label_facts(revision: int | None) -> dict[str, int]:
    """How files say from which revision of the marks their classes are: {"label_revision": number}; empty where they are
    from none."""
    return {} if revision is None else {LABEL_REVISION: revision}


def revision_of(path: str) -> int | None:
    """The revision of the marks that a label map of the project was made from; None where it was made from none."""
    found = re.match(MAPS.format(r"(\d+)") + "/", path)
    return None if found is None else int(found.group(1))


def is_made(path: str) -> bool:
    """Whether a label map of the project was made here, from marks or as the guess of a model, and not given with the photo."""
    return revision_of(path) is not None or path.startswith(f"{SUGGESTED}/")


def map_revision(project: Project) -> int | None:
    """The revision of the marks that label maps of the photos were made from; None where none was."""
    known = (revision_of(image.label) for image in project.images if image.label)
    return next((revision for revision in known if revision is not None), None)
