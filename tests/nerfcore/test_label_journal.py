"""The journal of marks: what is written stays, whatever happens to the last line; revisions are undone and none is lost."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from fieldwork.nerfcore.cli import main
from fieldwork.nerfcore.errors import DiskError, InputError, ProjectError
from fieldwork.nerfcore.labels import journal
from fieldwork.nerfcore.labels.journal import FOLDER, JOURNAL, append_mark, marks_at, read_marks, show, shown_revision
from fieldwork.nerfcore.labels.stroke import checkout, stroke
from fieldwork.nerfcore.params import LabelCheckoutParams, LabelStrokeParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import edit_project
from fieldwork.tests.nerfcore.support.ball import ball_project
from fieldwork.tests.nerfcore.test_engine import start  # noqa: F401
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

NUMBERS = st.floats(allow_nan=False, allow_infinity=False, width=32)
MARKS = st.fixed_dictionaries(
    {
        "photo": st.text(st.characters(exclude_characters="/\\", exclude_categories=["Cs"]), min_size=1).filter(
            lambda name: name not in (".", "..")
        ),
        "shape": st.sampled_from(["line", "outline", "click"]),
        "points": st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=5),
        "width": st.floats(min_value=0.01, max_value=1e4),
        "class_id": st.none() | st.integers(0, 65535),
        "erase": st.booleans(),
        "author": st.text(st.characters(exclude_categories=["Cs"]), max_size=20),
    }
)
LINE = {"photo": "00", "shape": "line", "points": [(1.0, 2.0), (3.0, 4.0)], "width": 2.0, "class_id": 1}


@given(st.lists(MARKS, min_size=1, max_size=6), st.integers(1, 40))
@settings(max_examples=40)
def test_marks_are_read_as_they_were_written_and_a_torn_line_is_dropped(
    tmp_path_factory: pytest.TempPathFactory, values: list[dict], cut: int
) -> None:
    project = tmp_path_factory.mktemp("p")
    written = [append_mark(project, value) for value in values]
    assert read_marks(project) == written
    path = project / FOLDER / JOURNAL
    whole = path.read_bytes()
    last = whole.rstrip(b"\n").rfind(b"\n") + 1
    path.write_bytes(whole[: max(last, len(whole) - cut)])
    assert read_marks(project) == written[:-1]
    again = append_mark(project, values[-1])
    assert again.revision == len(written)
    assert read_marks(project) == [*written[:-1], again]


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL on Windows")
def test_sigkill_while_marks_are_written_loses_none_that_was_acknowledged(tmp_path: Path) -> None:
    """A process that writes marks as fast as it can dies in the middle of one, again and again."""
    writer = (
        "import sys\n"
        "from pathlib import Path\n"
        "from fieldwork.nerfcore.labels.journal import append_mark\n"
        "points = [(float(i), 0.5) for i in range(2000)]\n"
        "while True:\n"
        "    mark = append_mark(Path(sys.argv[1]), {'photo': '00', 'shape': 'line', 'points': points, 'class_id': 1})\n"
        "    print(mark.revision, flush=True)\n"
    )
    told = 0
    for delay in (0.0, 0.003, 0.01, 0.02, 0.05):
        with subprocess.Popen(
            [sys.executable, "-c", writer, str(tmp_path)], stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            first = process.stdout.readline()  # it is at work
            assert first, "the journal that a killed process leaves can be written to"
            time.sleep(delay)
            process.send_signal(signal.SIGKILL)
            lines = [first, *process.stdout.read().split("\n")]
            told = max(int(line) for line in lines if line.strip())
        marks = read_marks(tmp_path)
        assert [mark.revision for mark in marks] == list(range(1, len(marks) + 1))
        # The last one may be on disk though nobody was told.
        assert told <= len(marks) <= told + 1
    assert told >= 5


def test_undo_shows_an_earlier_revision_and_a_mark_then_grows_from_it(tmp_path: Path) -> None:
    for _ in range(3):
        append_mark(tmp_path, LINE)
    show(tmp_path, 1)
    fourth = append_mark(tmp_path, {**LINE, "class_id": 2})
    assert (fourth.revision, fourth.parent) == (4, 1)
    marks = read_marks(tmp_path)
    assert [m.revision for m in marks_at(marks, 4)] == [1, 4]
    assert [m.revision for m in marks_at(marks, 3)] == [1, 2, 3]
    assert marks_at(marks, 0) == []
    assert shown_revision(tmp_path, 4) == 4
    with pytest.raises(InputError, match="no revision 5"):
        show(tmp_path, 5)


def test_marks_from_all_sides_come_one_after_the_other(tmp_path: Path) -> None:
    def work() -> None:
        for _ in range(10):
            append_mark(tmp_path, LINE)

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [mark.revision for mark in read_marks(tmp_path)] == list(range(1, 31))


@pytest.mark.parametrize("line", ['{"revision": 1}', "nonsense", '{"revision": 7, "parent": 0}'])
def test_damage_before_the_last_line_is_told_and_not_skipped(tmp_path: Path, line: str) -> None:
    append_mark(tmp_path, LINE)
    path = tmp_path / FOLDER / JOURNAL
    path.write_text(line + "\n" + path.read_text())
    with pytest.raises(ProjectError, match=r"journal\.jsonl is damaged in line 1"):
        read_marks(tmp_path)


def test_a_revision_out_of_order_is_damage(tmp_path: Path) -> None:
    append_mark(tmp_path, LINE)
    path = tmp_path / FOLDER / JOURNAL
    path.write_text(path.read_text() * 2)
    with pytest.raises(ProjectError, match=r"line 2: it is revision 1 of 0"):
        read_marks(tmp_path)


def test_on_a_full_disk_nothing_is_appended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    append_mark(tmp_path, LINE)
    before = (tmp_path / FOLDER / JOURNAL).read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(DiskError, match="No space left"):
            append_mark(tmp_path, LINE)
    assert (tmp_path / FOLDER / JOURNAL).read_bytes() == before
    assert append_mark(tmp_path, LINE).revision == 2


def test_a_mark_that_cannot_be_shown_is_not_appended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    append_mark(tmp_path, LINE)

    def full(*_: object) -> None:
        raise DiskError("No space left on the disk.")

    with monkeypatch.context() as patch:
        patch.setattr(journal, "write_json", full)
        with pytest.raises(DiskError, match="No space left"):
            append_mark(tmp_path, LINE)
    assert len(read_marks(tmp_path)) == 1


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    return ball_project(tmp_path / "p", views=4)


def marked(ball: Path, **values: object) -> dict:
    given_values = {"photo": "00", "points": [(5, 5), (30, 30)], "class_id": 1, **values}
    return stroke(LabelStrokeParams.model_validate({"project": ball, **given_values}), Reporter())


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"class_id": 9}, "no class 9"),
        ({"photo": "moon"}, "no photo “moon”"),
        ({"points": [(60, 60), (90, 60)]}, "lies outside the photo “00”, which is 40×40"),
        ({"points": [(-30, -30)], "width": 4}, "lies outside"),
    ],
)
def test_a_wrong_mark_is_told_and_not_written(ball: Path, values: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        marked(ball, **values)
    assert not (ball / FOLDER / JOURNAL).exists()


def test_a_photo_without_pose_cannot_be_marked(ball: Path) -> None:
    poses = json.loads((ball / "poses" / "poses.json").read_text())
    poses["images"] = poses["images"][1:]
    (ball / "poses" / "poses.json").write_text(json.dumps(poses))
    with pytest.raises(InputError, match="“00” has no pose"):
        marked(ball)


@pytest.mark.parametrize("values", [{}, {"class_id": 1, "void": True}, {"void": True, "erase": True}])
def test_a_mark_means_one_thing(values: dict) -> None:
    with pytest.raises(ValidationError, match="one of class_id, void and erase"):
        LabelStrokeParams.model_validate({"project": "p", "photo": "00", "points": [(1, 1)], **values})


def test_verbs_and_command_line_say_the_same(ball: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert marked(ball, author="Ada") == {"revision": 1, "parent": 0, "marks": 1}
    assert main(["label", "stroke", str(ball), "--photo", "01", "--points", "20,8 25,9", "--void", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["revision"] == 2
    assert main(["label", "checkout", str(ball), "--revision", "1", "--json"]) == 0
    shown = json.loads(capfd.readouterr().out)
    assert (shown["revision"], shown["newest"], shown["parent"], shown["marks"]) == (1, 2, 0, 1)
    assert checkout(LabelCheckoutParams(project=ball), Reporter())["revision"] == 1
    first, second = read_marks(ball)
    assert (first.author, second.void, second.points) == ("Ada", True, [(20.0, 8.0), (25.0, 9.0)])
    assert main(["label", "stroke", str(ball), "--photo", "01", "--points", "20;8", "--void"]) == 2


def test_a_mark_of_a_class_that_is_gone_stays_in_the_journal(ball: Path) -> None:
    marked(ball)
    with edit_project(ball) as project:
        project.classes = project.classes[1:]
    assert [mark.class_id for mark in read_marks(ball)] == [1]


def test_the_engine_takes_marks_beside_a_job(start, ball: Path) -> None:  # noqa: F811
    client = start()
    job = client.send("count", project=ball, steps=400)
    client.until_progress()
    line = {"project": ball, "photo": "00", "points": [[5, 5], [30, 30]]}
    first = client.send("label stroke", **line, class_id=2)
    wrong = client.send("label stroke", **line, class_id=9)
    undone = client.send("label checkout", project=ball, revision=0)
    assert client.answer(first)["result"] == {"revision": 1, "parent": 0, "marks": 1}
    assert client.answer(wrong)["error"]["data"]["code"] == "input"
    assert client.answer(undone)["result"]["marks"] == 0
    assert all(message.get("id") != job for message in client.seen), "the job is still at work"
    client.send("cancel")
    untrained = client.send("label prepare", project=ball)
    assert "fieldwork train" in client.answer(untrained, 60)["error"]["message"]
    assert sorted(path.name for path in (ball / "jobs").glob("label-prepare-*")) != []


def test_a_mark_that_is_sent_twice_is_one_mark(tmp_path: Path) -> None:
    first = append_mark(tmp_path, {**LINE, "key": "a"})
    other = append_mark(tmp_path, {**LINE, "key": "b"})
    assert append_mark(tmp_path, {**LINE, "key": "a"}) == first
    assert read_marks(tmp_path) == [first, other]
    assert shown_revision(tmp_path, 2) == 2
    # A process that was killed behind the journal has not shown it: whoever sends it again sees it, and marks grow from it.
    third = append_mark(tmp_path, {**LINE, "key": "c"})
    show(tmp_path, 2)
    assert append_mark(tmp_path, {**LINE, "key": "c"}) == third
    assert shown_revision(tmp_path, 3) == 3
    assert [append_mark(tmp_path, LINE).revision, append_mark(tmp_path, LINE).revision] == [4, 5], (
        "without a key each is one"
    )
