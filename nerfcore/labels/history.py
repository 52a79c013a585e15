"""Who labelled what when: the journal of marks as a table."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from ..files import write_text
from ..project.schema import Project
from .journal import Mark, marks_at

COLUMNS = ["revision", "parent", "time", "author", "place", "shape", "says", "class", "points", "shown"]


def write_history(path: Path, project: Project, marks: list[Mark], revision: int) -> Path:
    """Write all marks as CSV, also those that were undone: “shown” says which count at the revision. Raises DiskError."""
    names = {c.id: c.name for c in project.classes}
    counted = {mark.revision for mark in marks_at(marks, revision)}
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for mark in marks:
        place = mark.photo or ("surface" if mark.places else mark.file)
        name = "" if mark.class_id is None else names.get(mark.class_id, str(mark.class_id))
        count = len(mark.points or mark.places)
        about = [mark.revision, mark.parent, mark.time, mark.author, place, mark.shape, meaning(mark), name, count]
        table.writerow([*about, "yes" if mark.revision in counted else "no"])
    write_text(path, text.getvalue())
    return path


def meaning(mark: Mark) -> str:
    """What a mark says, in a word."""
    if not mark.drawn:
        return mark.shape
    return "erase" if mark.erase else "void" if mark.void else "class"
