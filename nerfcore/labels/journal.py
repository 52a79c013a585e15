"""The marks of a project: an append-only file, one JSON object a line, and which revision of it is shown.

marks/journal.jsonl   one mark a line; line n makes revision n of its parent, the revision it was drawn on
marks/shown.json      {"revision": n}; revision 0 has no marks

Undoing shows an earlier revision and deletes nothing; a mark drawn then has that one as its parent. What is shown at
revision n are the marks of n, of its parent, and so on.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from ..errors import DiskError, InputError, ProjectError, wrong_value
from ..files import disk_errors, write_json
from ..project.schema import ImageName, OwnFile, Project, now
from ..project.store import locked

FOLDER = "marks"
JOURNAL = "journal.jsonl"
SHOWN = "shown.json"
LOCK_FILE = "jobs/marks.lock"

Shape = Literal["line", "outline", "click", "part", "carried", "confirmed"]
DRAWN = ("line", "outline", "click", "part")


class Mark(BaseModel):
    """One mark: on a photo points in pixels of its working copy, and the brush's width in the same; size: width and height of
    that copy, for the photo may be read anew at another size (marks of earlier versions have none). On the surface places
    in the frame of the first poses (which neither alignment nor later poses change), and the width in its units. class_id: None for void and for what
    erases. level: how large the parts are that a mark of shape "part" takes. key: which mark it is to whoever sent it.

    With shape "carried" the labels of an earlier epoch in `file` (see carry.py), with "confirmed" the word of the author
    that what was carried before is right.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    revision: int = Field(ge=1)
    parent: int = Field(ge=0)
    time: str = Field(default_factory=now)
    author: str = ""
    key: str = ""
    photo: ImageName = ""
    size: tuple[int, int] | None = None
    shape: Shape
    points: list[tuple[float, float]] = []
    places: list[tuple[float, float, float]] = []
    file: OwnFile = ""
    width: float = Field(default=1.0, gt=0)
    level: Literal["fine", "coarse"] = "fine"
    class_id: int | None = None
    erase: bool = False

    @property
    def void(self) -> bool:
        return self.class_id is None and not self.erase and self.drawn

    @property
    def drawn(self) -> bool:
        """Whether somebody drew it, on a photo or on the surface."""
        return self.shape in DRAWN

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.drawn and bool(self.photo) + bool(self.places) != 1:
            raise ValueError("a mark is on a photo or on the surface")
        if self.drawn and not (self.points or self.places):
            raise ValueError("a mark has at least one point")
        if (self.shape == "carried") != bool(self.file):
            raise ValueError("labels that were carried stand in a file")
        return self


def read_marks(project: Path) -> list[Mark]:
    """All marks, by revision; a last line that a kill cut off is left out.

    Raises:
        ProjectError: the journal is damaged elsewhere.
    """
    path = Path(project) / FOLDER / JOURNAL
    try:
        whole = path.read_bytes()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise ProjectError(f"{path} cannot be read: {error.strerror}.", "Check its permissions.") from error
    marks: list[Mark] = []
    for number, line in enumerate(whole[: _whole_lines(whole)].splitlines(), 1):
        try:
            mark = Mark.model_validate_json(line)
        except ValidationError as error:
            what = wrong_value(error.errors()[0])
            raise ProjectError(
                f"{path} is damaged in line {number}: {what}.",
                "Restore it from a backup, or delete that line and after.",
            ) from error
        if mark.revision != number or mark.parent >= number:
            raise ProjectError(
                f"{path} is damaged in line {number}: it is revision {mark.revision} of {mark.parent}.",
                "Restore it from a backup.",
            )
        marks.append(mark)
    return marks


def _whole_lines(text: bytes) -> int:
    """Number of bytes of the lines that were written to their end."""
    return text.rfind(b"\n") + 1


def append_mark(project: Path, values: dict[str, object], below: int | None = None) -> Mark:
    """Append a mark to the journal, drawn on the revision that is shown, and show it. On disk when this returns.

    A mark whose key is there already was sent twice: it is not appended again.

    Args:
        values: of `Mark`, but for revision, parent and time.
        below: the revision that it was drawn on, where that is not the one that is shown: marks drawn on that one since are
            appended once more on top of it, for of two marks on one place the later counts. What was undone meanwhile is
            no longer there to be drawn on.
    Returns:
        the mark that is shown now: this one, or the last of those on top of it.
    Raises:
        ProjectError: the journal is damaged or stays locked. DiskError: nothing was appended.
    """
    project = Path(project)
    path = project / FOLDER / JOURNAL
    with locked(path, project / LOCK_FILE):
        marks = read_marks(project)
        sent = next((m for m in reversed(marks) if m.key and m.key == values.get("key")), None)
        if sent is not None:
            top, before = _written_with(marks, sent)
            if shown_revision(project, len(marks)) == before:  # killed between writing and showing it
                _show(project, top.revision)
            return top
        shown = shown_revision(project, len(marks))
        there = marks_at(marks, shown)
        places = [0, *(mark.revision for mark in there)]
        at = places.index(below) if below in places else len(there)
        fresh = [Mark.model_validate({**values, "revision": len(marks) + 1, "parent": places[at]})]
        for mark in there[at:]:
            above = {"revision": len(marks) + 1 + len(fresh), "parent": fresh[-1].revision}
            fresh.append(mark.model_copy(update=above))
        lines = "".join(mark.model_dump_json() + "\n" for mark in fresh).encode()
        with disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            end = _append(path, lines)
            try:
                _show(project, fresh[-1].revision)
            except (DiskError, OSError):
                os.truncate(path, end)
                raise
    return fresh[-1]


def _written_with(marks: list[Mark], sent: Mark) -> tuple[Mark, int]:
    """Of a mark of the journal: itself or the last of those that were put on top of it, and the revision shown before."""
    place = {"revision", "parent"}
    earlier = {mark.model_dump_json(exclude=place): mark.revision for mark in marks[: sent.revision - 1]}
    top, before = sent, sent.parent
    for mark in marks[sent.revision :]:
        drawn = earlier.get(mark.model_dump_json(exclude=place))
        if drawn is None or mark.parent != top.revision:
            break
        top, before = mark, drawn
    return top, before


def _append(path: Path, lines: bytes) -> int:
    """Append lines behind the whole lines of a file and fsync it; where that fails the file is as it was. Returns where they
    begin."""
    with open(path, "ab+") as file:
        file.seek(0)
        end = _whole_lines(file.read())
        file.truncate(end)
        try:
            file.write(lines)
            file.flush()
            os.fsync(file.fileno())
        except OSError:
            os.truncate(path, end)
            raise
    return end


def shown_revision(project: Path, newest: int) -> int:
    """The revision that is shown, of `newest` there are; the newest where none was chosen."""
    try:
        value = json.loads((Path(project) / FOLDER / SHOWN).read_text(encoding="utf-8"))["revision"]
    except (OSError, ValueError, KeyError, TypeError):
        return newest
    return value if isinstance(value, int) and 0 <= value <= newest else newest


def show(project: Path, revision: int) -> None:
    """Show a revision from now on.

    Raises:
        InputError: there is no such revision. ProjectError, DiskError.
    """
    project = Path(project)
    with locked(project / FOLDER / JOURNAL, project / LOCK_FILE):
        require_revision(revision, len(read_marks(project)))
        _show(project, revision)


def _show(project: Path, revision: int) -> None:
    write_json(project / FOLDER / SHOWN, {"revision": revision})


def require_revision(revision: int, newest: int) -> None:
    """Raise InputError where a journal of `newest` revisions has not this one."""
    if not 0 <= revision <= newest:
        raise InputError(f"There is no revision {revision} of the marks.", f"The newest is {newest}, 0 has no marks.")


def taken_ids(folder: Path, project: Project) -> set[int]:
    """The ids that a new class must not get: those of classes, of void, and of classes that were removed, for what marks
    and label maps say of them must not become that of the new one. Raises ProjectError."""
    named = {mark.class_id for mark in read_marks(folder) if mark.class_id is not None}
    return named | {c.id for c in project.classes} | {*project.former_class_ids, project.ignore_id}


def marks_at(marks: list[Mark], revision: int) -> list[Mark]:
    """The marks of a revision, oldest first. Raises InputError where there is no such revision."""
    require_revision(revision, len(marks))
    found = []
    while revision > 0:
        mark = marks[revision - 1]
        found.append(mark)
        revision = mark.parent
    return found[::-1]
