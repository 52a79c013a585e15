"""Many captures in one go: lists, retries, the report, going on. What one capture does is tested elsewhere."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from fieldwork.nerfcore import cli
from fieldwork.nerfcore.errors import Cancelled, InputError, PosesError, SettingError
from fieldwork.nerfcore.params import BatchParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import Project
from fieldwork.nerfcore.project.store import save_project
from fieldwork.nerfcore.workflows import batch as module
from fieldwork.nerfcore.workflows.batch import BatchError, batch, read_list
from fieldwork.tests.nerfcore.support.photos import folder_of


@pytest.fixture
def reconstructed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Stands for the work itself; returns the names of the captures it was asked for.

    “broken” never works, “shaky” at the second attempt, “empty” has no photos.
    """
    asked: list[str] = []

    def work(params, report):
        name = params.out.name
        asked.append(name)
        report.stage("Working")
        report.progress(0.5)
        if "empty" in name:
            raise InputError("There are no photos.", "Take some.")
        if "broken" in name or ("shaky" in name and asked.count(name) == 1):
            raise PosesError("The photos do not overlap.", "Take more.")
        if "bug" in name:
            raise KeyError("no such thing")
        save_project(params.out, Project())
        return {"project": str(params.out), "stages": {"new": 0.1}}

    monkeypatch.setattr(module, "reconstruct", work)
    return asked


def write_list(folder: Path, *names: str) -> Path:
    path = folder / "captures.csv"
    path.write_text("photos,preset\n" + "".join(f"{name}/photos,draft\n" for name in names))
    return path


def test_one_bad_capture_does_not_stop_the_others(tmp_path, reconstructed):
    path = write_list(tmp_path, "vase", "broken", "bug", "empty", "shaky")
    with pytest.raises(BatchError, match="3 of 5 captures failed") as failure:
        batch(BatchParams(list=path), Reporter())
    result = failure.value.result
    assert [Path(p).name for p in result["done"]] == ["vase_fieldwork", "shaky_fieldwork"]
    assert [f["error"] for f in result["failed"]] == [
        "The photos do not overlap.",
        "KeyError: 'no such thing'",
        "There are no photos.",
    ]
    # Tried again, except where that is no use.
    counts = {name: reconstructed.count(f"{name}_fieldwork") for name in ("vase", "broken", "bug", "empty", "shaky")}
    assert counts == {"vase": 1, "broken": 2, "bug": 2, "empty": 1, "shaky": 2}
    report = json.loads((tmp_path / "captures-report.json").read_text())["captures"]
    assert report[str(tmp_path / "shaky_fieldwork")]["attempts"] == 2
    assert not (tmp_path / "broken_fieldwork").exists(), "no empty folder stays"


def test_a_second_call_does_what_is_not_done(tmp_path, reconstructed):
    path = write_list(tmp_path, "vase", "shaky")
    with pytest.raises(BatchError):
        batch(BatchParams(list=path, retries=0), Reporter())
    reconstructed[:] = ["shaky_fieldwork"]
    result = batch(BatchParams(list=path, retries=0), Reporter())
    assert (len(result["done"]), result["failed"], result["skipped"]) == (2, [], 1)
    assert reconstructed == ["shaky_fieldwork"] * 2
    # Other settings, another capture.
    path.write_text(path.read_text().replace("vase/photos,draft", "vase/photos,high"))
    assert batch(BatchParams(list=path), Reporter())["skipped"] == 1


def test_a_capture_that_was_begun_with_other_settings_is_not_done_any_more(tmp_path, monkeypatch):
    made: list[str] = []

    def work(params, report):
        made.append(params.preset)
        save_project(params.out, Project())
        if params.preset == "high":
            raise Cancelled
        return {"stages": {}}

    monkeypatch.setattr(module, "reconstruct", work)
    path = write_list(tmp_path, "vase")
    batch(BatchParams(list=path), Reporter())
    path.write_text(path.read_text().replace("draft", "high"))
    with pytest.raises(Cancelled):
        batch(BatchParams(list=path), Reporter())
    path.write_text(path.read_text().replace("high", "draft"))
    assert batch(BatchParams(list=path), Reporter())["skipped"] == 0
    assert made == ["draft", "high", "draft"]


@pytest.mark.parametrize("file", ["p3.jpg", "labels/p1.png", "masks/p1.png", "classes.json"])
def test_a_capture_with_other_files_is_done_again(tmp_path, reconstructed, file):
    photos = folder_of(tmp_path / "vase/photos", 3)
    for name in ("labels", "masks"):
        (photos / name).mkdir()
    path = write_list(tmp_path, "vase", "gone")
    batch(BatchParams(list=path), Reporter())
    assert batch(BatchParams(list=path), Reporter())["skipped"] == 2, "what cannot be read says nothing"
    (photos / file).write_bytes(b"{}")
    assert batch(BatchParams(list=path), Reporter())["skipped"] == 1
    assert batch(BatchParams(list=path), Reporter())["skipped"] == 2


def test_reports_that_do_not_say_of_which_files_still_count(tmp_path, reconstructed):
    folder_of(tmp_path / "vase/photos", 3)
    path, report = write_list(tmp_path, "vase"), tmp_path / "captures-report.json"
    batch(BatchParams(list=path), Reporter())
    value = json.loads(report.read_text())
    (entry,) = value["captures"].values()
    assert set(entry.pop("inputs")) >= {"photos", "labels", "masks"}
    report.write_text(json.dumps(value))
    assert batch(BatchParams(list=path), Reporter())["skipped"] == 1


def test_cancelled_batch_keeps_what_is_done(tmp_path, reconstructed):
    class Stop(Reporter):
        def stage(self, name: str) -> None:
            if name.startswith("second"):
                self.cancel()

    path = write_list(tmp_path, "first", "second")
    with pytest.raises(Cancelled):
        batch(BatchParams(list=path), Stop())
    report = json.loads((tmp_path / "captures-report.json").read_text())["captures"]
    assert [entry["state"] for entry in report.values()] == ["done"]
    assert batch(BatchParams(list=path), Reporter())["skipped"] == 1


def test_notes_are_told_with_their_capture(tmp_path, monkeypatch):
    class Listener(Reporter):
        told: list[str] = []

        def note(self, message: str) -> None:
            self.told.append(message)

    def work(params, report):
        report.note("3 of 9 photos are compared: the time is used up.")
        return {"stages": {}}

    monkeypatch.setattr(module, "reconstruct", work)
    batch(BatchParams(list=write_list(tmp_path, "vase")), Listener())
    assert Listener.told == ["vase_fieldwork (1 of 1): 3 of 9 photos are compared: the time is used up."]


def test_lists_of_both_kinds_say_the_same(tmp_path):
    table = tmp_path / "list.csv"
    table.write_text(
        "photos,out,preset,time_limit,set\n"
        "a/images,,draft,30,loss.semantic_weight=0.1 field.levels=6\n"
        "walk.mp4,/elsewhere/walk,,,\n",
        encoding="utf-8-sig",
    )
    objects = tmp_path / "list.json"
    objects.write_text(
        json.dumps(
            [
                {
                    "photos": "a/images",
                    "preset": "draft",
                    "time_limit": 30,
                    "set": {"loss.semantic_weight": "0.1", "field.levels": "6"},
                },
                {"photos": "walk.mp4", "out": "/elsewhere/walk"},
            ]
        )
    )
    assert read_list(table) == read_list(objects)
    first, second = (capture.params for capture in read_list(table))
    assert first.out == tmp_path / "a_fieldwork"
    assert first.photos == tmp_path / "a/images"
    assert first.time_limit == 30
    assert (second.out, second.preset) == (Path("/elsewhere/walk"), "standard")


@pytest.mark.parametrize(
    ("name", "text", "error", "words"),
    [
        ("a.csv", "photos\n", InputError, "lists no captures"),
        ("a.csv", "photos,speed\nx,1\n", SettingError, "capture 1: there is no setting “speed”"),
        ("a.csv", "photos\nx,y,z\n", InputError, "more cells"),
        ("a.csv", "photos,out\nx,p\ny,p\n", SettingError, "two captures with the project"),
        ("a.csv", "photos,out\nx,p\ny,q/../p\n", SettingError, "two captures with the project"),
        ("a.csv", "photos,preset\nx,best\n", SettingError, "preset"),
        (
            "a.csv",
            "photos,set\nx,\ny,loss.semantic=0.1\n",
            SettingError,
            "capture 2: There is no setting “loss.semantic”",
        ),
        ("a.csv", "photos,set\nx,loss.semantic_weight=-1\n", SettingError, "capture 1: The setting"),
        ("a.csv", "photos,priority\nx,soon\n", SettingError, "capture 1: “priority”"),
        ("a.json", "{", InputError, "damaged"),
        ("a.json", '{"photos": "x"}', InputError, "no array"),
        ("a.txt", "x", InputError, "neither"),
        ("none.csv", None, InputError, "cannot be read"),
    ],
)
def test_wrong_lists_are_told(tmp_path, name, text, error, words):
    path = tmp_path / name
    if text is not None:
        path.write_text(text)
    with pytest.raises(error, match=words):
        read_list(path)


def test_exit_codes_and_json(tmp_path, reconstructed, capfd):
    path = write_list(tmp_path, "vase", "empty")
    assert cli.main(["batch", str(path), "--json"]) == 1
    value = json.loads(capfd.readouterr().out)
    assert value["error"]["code"] == "batch"
    assert (len(value["done"]), len(value["failed"])) == (1, 1)
    write_list(tmp_path, "vase")
    assert cli.main(["batch", str(path), "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["failed"] == []
    assert cli.main(["batch"]) == 2


def test_the_list_of_the_documentation_is_one(tmp_path):
    text = (Path(module.__file__).parents[2] / "docs/cli.md").read_text("utf-8")
    (example,) = re.findall(r"```csv\n(photos.*?)```", text, re.S)
    path = tmp_path / "captures.csv"
    path.write_text(example)
    vase, walk = (capture.params for capture in read_list(path))
    assert (vase.out, vase.blend, vase.time_limit) == (tmp_path / "vase_fieldwork", tmp_path / "vase.blend", 120)
    assert (walk.out, walk.labels, walk.preset) == (tmp_path / "walk_fieldwork", None, "standard")


def test_captures_of_a_higher_priority_come_first(tmp_path, reconstructed):
    path = tmp_path / "captures.csv"
    path.write_text("photos,priority\nlast/photos,-1\nmiddle/photos,\nfirst/photos,5\nsecond/photos,0\n")
    batch(BatchParams(list=path), Reporter())
    assert reconstructed == [f"{name}_fieldwork" for name in ("first", "middle", "second", "last")]
