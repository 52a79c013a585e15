"""Who labelled what when, as a table."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from fieldwork.nerfcore.errors import InputError, SettingError
from fieldwork.nerfcore.labels.exchange import export_labels
from fieldwork.nerfcore.labels.journal import append_mark, show
from fieldwork.nerfcore.params import LabelExportParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import Project, SemanticClass
from fieldwork.nerfcore.project.store import save_project


def exported(folder: Path, out: Path, **values: object) -> dict:
    given = {"project": folder, "out": out, "format": "history", **values}
    return export_labels(LabelExportParams.model_validate(given), Reporter())


def test_all_marks_are_listed_with_author_and_time_and_whether_they_count(tmp_path: Path) -> None:
    folder = tmp_path / "p"
    save_project(folder, Project(classes=[SemanticClass(id=1, name="stone, grey", color=(0.5, 0.5, 0.5))]))
    with pytest.raises(InputError, match="no marks"):
        exported(folder, tmp_path / "history.csv")
    line = {"shape": "line", "width": 2.0}
    first = append_mark(folder, {**line, "photo": "a", "points": [(1, 2), (3, 4)], "class_id": 1, "author": "Ada"})
    append_mark(folder, {**line, "places": [(0, 0, 0)], "author": "Bob"})
    show(folder, 1)
    append_mark(folder, {**line, "photo": "b", "points": [(1, 2)], "erase": True})
    append_mark(folder, {"shape": "carried", "file": "marks/carried_1.npz", "author": "Ada"})
    result = exported(folder, tmp_path / "history.csv")
    assert (result["revision"], result["photos"]) == (4, 2)
    rows = list(csv.DictReader((tmp_path / "history.csv").read_text().splitlines()))
    assert [row["author"] for row in rows] == ["Ada", "Bob", "", "Ada"]
    assert [row["place"] for row in rows] == ["a", "surface", "b", "marks/carried_1.npz"]
    assert [row["says"] for row in rows] == ["class", "void", "erase", "carried"]
    assert [row["class"] for row in rows] == ["stone, grey", "", "", ""]
    assert [row["shown"] for row in rows] == ["yes", "no", "yes", "yes"], "the second one was undone"
    assert rows[0]["time"] == first.time
    assert rows[2]["parent"] == "1"
    exported(folder, tmp_path / "first.csv", revision=1)
    rows = list(csv.DictReader((tmp_path / "first.csv").read_text().splitlines()))
    assert [row["shown"] for row in rows] == ["yes", "no", "no", "no"]
    with pytest.raises(SettingError, match=r"does not end in \.csv"):
        exported(folder, tmp_path / "history.txt")
