"""Edits of a project: one at a time, none lost, also beside a running job; and projects of earlier versions."""

from __future__ import annotations

import json
import re
import threading
from pathlib import Path

import pytest
from fieldwork.nerfcore.cli import main
from fieldwork.nerfcore.errors import FieldworkError, ProjectError, SettingError
from fieldwork.nerfcore.params import AlignParams, ClassesParams, Params, RegionParams
from fieldwork.nerfcore.poses.align import align
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project import store
from fieldwork.nerfcore.project.edit import classes, region
from fieldwork.nerfcore.project.lock import project_lock
from fieldwork.nerfcore.project.migrate import migrated
from fieldwork.nerfcore.project.schema import IDENTITY, ImageRecord, Project, SemanticClass
from fieldwork.nerfcore.project.store import edit_project, load_project, record_step, save_project
from fieldwork.tests.nerfcore.test_engine import project as engine_project  # noqa: F401
from fieldwork.tests.nerfcore.test_engine import start  # noqa: F401
from pydantic import ValidationError

pytestmark = pytest.mark.usefixtures("each_file_system")

BOX = [[-1.0, -2.0, 0.0], [1.0, 2.0, 3.0]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    stone = SemanticClass(id=1, name="Stein", color=(0.5, 0.25, 0.0), priority=2.0)
    save_project(tmp_path / "p", Project(classes=[stone], images=[ImageRecord(name="a", sha256="00ff")]))
    return tmp_path / "p"


def test_edits_from_all_sides_come_one_after_the_other(folder: Path) -> None:
    """Before, each read the file, and the last one to write it undid the others."""

    def work(name: str) -> None:
        for i in range(20):
            record_step(folder, name, {}, {"i": i})

    threads = [threading.Thread(target=work, args=(name,)) for name in ("train", "mesh", "align")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    steps = load_project(folder).provenance
    for name in ("train", "mesh", "align"):
        assert [step.result["i"] for step in steps if step.verb == name] == list(range(20))


def test_align_keeps_an_edit_made_while_it_reads(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def points_of(place: Path) -> store.Points:
        region(RegionParams(project=folder, bounds=BOX), Reporter())  # meanwhile, in Blender
        return store.Points.empty()

    monkeypatch.setattr("fieldwork.nerfcore.poses.align.load_points", points_of)
    store.save_poses(folder, store.Poses(), store.Points.empty())
    align(AlignParams(project=folder, up="z"), Reporter())
    assert load_project(folder).frame.bounds == BOX


def test_an_edit_that_fails_writes_nothing(folder: Path) -> None:
    before = (folder / "project.json").read_bytes()

    def fail() -> None:
        with edit_project(folder) as project:
            project.classes = []
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert (folder / "project.json").read_bytes() == before
    record_step(folder, "train", {}, {})  # and the lock is free


def test_a_lock_that_stays_is_told(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "PATIENCE", 0.1)
    with edit_project(folder), pytest.raises(ProjectError, match="locked by another program"):
        record_step(folder, "train", {}, {})


@pytest.mark.parametrize(
    ("verb", "values"),
    [
        (ClassesParams, {"classes": [{"id": 3, "name": "Holz"}]}),
        (RegionParams, {"bounds": [[0, 0, 0], [1, 1, 1]]}),
        (RegionParams, {"clear": True}),
    ],
)
def test_classes_and_regions_wait_for_the_lock(
    folder: Path, monkeypatch: pytest.MonkeyPatch, verb: type[Params], values: dict
) -> None:
    monkeypatch.setattr(store, "PATIENCE", 0.1)
    edit = {ClassesParams: classes, RegionParams: region}[verb]
    before = load_project(folder)
    with edit_project(folder), pytest.raises(ProjectError, match="locked by another program"):
        edit(verb.model_validate({"project": folder, **values}), Reporter())
    assert load_project(folder) == before


def test_no_project_no_folder(tmp_path: Path) -> None:
    with pytest.raises(ProjectError, match="folder is not there"):
        classes(ClassesParams(project=tmp_path / "unplugged", classes=[]), Reporter())
    assert not (tmp_path / "unplugged").exists()


def test_classes(folder: Path) -> None:
    params = ClassesParams.model_validate(
        {"project": folder, "classes": [{"id": 3, "name": "Holz", "color": [0, 1, 0]}, {"id": 1, "name": "Granit"}]}
    )
    value = classes(params, Reporter())["classes"]
    assert value[0] == {"id": 1, "name": "Granit", "color": [0.5, 0.25, 0.0], "priority": 2.0}
    assert value[1] == {"id": 3, "name": "Holz", "color": [0.0, 1.0, 0.0], "priority": 1.0}
    assert classes(ClassesParams(project=folder), Reporter())["classes"] == value


@pytest.mark.parametrize(
    ("entries", "sentence"),
    [
        ([{"id": 1, "name": "a"}, {"id": 1, "name": "b"}], "Two classes have the id 1"),
        ([{"id": 1, "name": "a"}, {"id": 2, "name": " a"}], "Two classes are called “a”"),
        ([{"id": 0, "name": "a"}], "stands for void"),
        ([{"id": 70000, "name": "a"}], "id 70000"),
        ([{"id": -1, "name": "a"}], "id -1"),
        ([{"id": 2, "name": ""}], "no name"),
        ([{"id": 2, "name": "a", "color": [2, 0, 0]}], "colour of “a”"),
        ([{"id": i, "name": str(i)} for i in range(1, 257)], "256 classes are too many"),
    ],
)
def test_classes_that_contradict_are_refused(folder: Path, entries: list[dict], sentence: str) -> None:
    before = (folder / "project.json").read_bytes()
    with pytest.raises(SettingError, match=sentence):
        classes(ClassesParams.model_validate({"project": folder, "classes": entries}), Reporter())
    assert (folder / "project.json").read_bytes() == before


@pytest.mark.parametrize(
    ("verb", "values"),
    [
        (ClassesParams, {"classes": [{"id": 2, "name": "a", "color": [float("nan"), 0, 0]}]}),
        (ClassesParams, {"classes": [{"id": 2, "name": "a", "priority": float("inf")}]}),
        (RegionParams, {"bounds": [[0, 0, 0], [1, 1, float("inf")]]}),
        (RegionParams, {"bounds": [[0, 0, float("nan")], [1, 1, 1]]}),
    ],
)
def test_numbers_that_are_none_are_refused(folder: Path, verb: type[Params], values: dict) -> None:
    with pytest.raises(ValidationError, match="finite number"):
        verb.model_validate({"project": folder, **values})


def test_classes_of_a_file(folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """What is listed can be edited and given back; files of `new` are understood too."""
    assert main(["classes", str(folder), "--json"]) == 0
    listed = json.loads(capfd.readouterr().out)
    listed["classes"][0]["priority"] = 5.0
    (tmp_path / "c.json").write_text(json.dumps(listed))
    assert main(["classes", str(folder), "--file", str(tmp_path / "c.json"), "--json"]) == 0
    changed = json.loads(capfd.readouterr().out)["classes"]
    assert changed == [{"id": 1, "name": "Stein", "color": [0.5, 0.25, 0.0], "priority": 5.0}]
    (tmp_path / "c.json").write_text('{"classes": {"1": {"name": "Fels", "color": [255, 0, 51]}}}')
    assert main(["classes", str(folder), "--file", str(tmp_path / "c.json"), "--json"]) == 0
    changed = json.loads(capfd.readouterr().out)["classes"]
    assert changed == [{"id": 1, "name": "Fels", "color": [1.0, 0.0, 0.2], "priority": 5.0}]
    assert main(["classes", str(folder), "--file", str(tmp_path / "none.json")]) == 1
    assert "none.json does not exist" in capfd.readouterr().err


def test_region(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["region", str(folder), "--box", "-1", "-2", "0", "1", "2", "3", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["bounds"] == BOX
    assert region(RegionParams(project=folder), Reporter()) == {"bounds": BOX}
    assert main(["region", str(folder), "--clear", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["bounds"] is None
    assert load_project(folder).frame.bounds is None


@pytest.mark.parametrize(
    "bounds",
    [
        [[0, 0, 0], [1, 1, 0]],
        [[0, 0, 0], [1, -1, 1]],
        [[0, 0], [1, 1]],
        [[0, 0, 0]],
        [],
    ],
)
def test_impossible_regions_are_refused(folder: Path, bounds: list) -> None:
    with pytest.raises(SettingError, match="region"):
        region(RegionParams(project=folder, bounds=bounds), Reporter())
    assert load_project(folder).frame.bounds is None


def test_region_given_and_cleared(folder: Path) -> None:
    with pytest.raises(SettingError, match="one of the two"):
        region(RegionParams(project=folder, bounds=BOX, clear=True), Reporter())


def test_command_line_edits_beside_a_job(folder: Path) -> None:
    with project_lock(folder, "train"):
        assert main(["region", str(folder), "--box", "-1", "-2", "0", "1", "2", "3", "--quiet"]) == 0
        assert main(["align", str(folder), "--up", "z", "--quiet"]) == 1
    assert load_project(folder).frame.bounds == BOX


def test_engine_edits_beside_a_job(start, engine_project: Path) -> None:  # noqa: F811
    client = start()
    job = client.send("count", project=engine_project, steps=200)
    client.until_progress()
    for i in range(5):
        client.send("region", project=engine_project, bounds=[[0, 0, 0], [1, 1, 1 + i]])
    edit = client.send("classes", project=engine_project, classes=[{"id": 4, "name": "Gold", "color": [1, 0.8, 0]}])
    wrong = client.send("region", project=engine_project, bounds=[[0, 0, 0], [0, 0, 0]])
    odd = client.send("region", project=engine_project, colour=1)
    assert client.answer(edit)["result"] == {
        "classes": [{"id": 4, "name": "Gold", "color": [1.0, 0.8, 0.0], "priority": 1.0}]
    }
    assert client.answer(wrong)["error"]["data"]["code"] == "setting"
    assert client.answer(odd)["error"]["code"] == -32602
    assert all(message.get("id") != job for message in client.seen), "the job is still at work"
    project = load_project(engine_project)
    assert project.frame.bounds == [[0, 0, 0], [1, 1, 5]]  # the last one, not any
    assert [c.name for c in project.classes] == ["Gold"]
    client.send("cancel")
    client.answer(job)


def test_edits_are_done_before_the_engine_ends(start, engine_project: Path) -> None:  # noqa: F811
    client = start()
    for i in range(20):
        client.send("region", project=engine_project, bounds=[[0, 0, 0], [1, 1, 1 + i]])
    client.close_stdin()
    assert client.process.wait(20) == 0
    assert load_project(engine_project).frame.bounds == [[0, 0, 0], [1, 1, 20]]


def version_1() -> dict:
    """A project.json as version 0.1 wrote it."""
    image = {
        "name": "a", "file": "images/a.jpg", "source": "/home/me/a.jpg", "sha256": "00ff", "width": 8, "height": 6,
        "camera_group": "x", "focal_px": 7.5, "exif": {"make": "x"}, "sharpness": 1.5, "label": "labels/a.png",
        "mask": None, "confidence": None, "depth": None, "split": "test", "status": "ok", "reason": "",
    }  # fmt: skip
    frame = {"world_from_sfm": IDENTITY, "up_confidence": 0.5, "scale_known": True, "bounds": BOX}
    step = {"verb": "new", "time": "2025-11-01T10:00:00+00:00", "version": "0.1.0", "settings": {"a": 1}, "result": {}}
    return {
        "format": "fieldwork-project", "version": 1, "created": "2025-11-01T10:00:00+00:00", "images": [image],
        "classes": [{"id": 1, "name": "Stein", "color": [1.0, 0.0, 0.0], "priority": 1.0}], "ignore_id": 0,
        "mask_mode": "ignore", "frame": frame, "provenance": [step],
    }  # fmt: skip


def test_version_1_is_migrated(tmp_path: Path) -> None:
    path = tmp_path / "project.json"
    path.write_text(json.dumps(version_1()))
    project = load_project(tmp_path)
    assert project.version == 2
    assert re.fullmatch("[0-9a-f]{32}", project.uuid)
    assert json.loads(path.read_text())["version"] == 1  # reading does not write
    assert load_project(tmp_path).uuid == project.uuid
    region(RegionParams(project=tmp_path, clear=True), Reporter())
    written = json.loads(path.read_text())
    assert (written["version"], written["uuid"]) == (2, project.uuid)
    kept = {key: value for key, value in version_1().items() if key not in ("version", "frame", "provenance")}
    kept["images"] = [{**image, "instances": None} for image in kept["images"]]  # came later
    assert {key: written[key] for key in kept} == kept
    assert written["provenance"][0].items() >= version_1()["provenance"][0].items()
    written["images"] = []  # the identity is the file's own from now on
    path.write_text(json.dumps(written))
    assert load_project(tmp_path).uuid == project.uuid


def test_migration_is_pure() -> None:
    value = version_1()
    assert migrated(value)["uuid"] == migrated(version_1())["uuid"]
    assert value == version_1()
    other = version_1()
    other["images"][0]["sha256"] = "11"
    assert migrated(other)["uuid"] != migrated(value)["uuid"]
    assert migrated(migrated(value)) == migrated(value)


def test_damaged_version_1_says_so(tmp_path: Path) -> None:
    (tmp_path / "project.json").write_text(json.dumps(version_1() | {"images": "none"}))
    with pytest.raises(FieldworkError, match="images"):
        load_project(tmp_path)


def test_new_projects_differ() -> None:
    assert Project().uuid != Project().uuid
