"""`batch --dry-run`: what there is to do, what is missing and how long it may take, without anything being done."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
from fieldwork.nerfcore import cli
from fieldwork.nerfcore.cluster import link
from fieldwork.nerfcore.errors import SettingError
from fieldwork.nerfcore.params import BatchParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import Project
from fieldwork.nerfcore.project.store import save_project
from fieldwork.nerfcore.workflows.batch import batch
from fieldwork.nerfcore.workflows.captures import read_list


def captures(folder: Path, names: list[str], photos: int = 3) -> Path:
    for name in names:
        (folder / name / "photos").mkdir(parents=True)
        for number in range(photos):
            (folder / name / "photos" / f"{number}.jpg").touch()
    path = folder / "captures.csv"
    path.write_text("photos,preset\n" + "".join(f"{name}/photos,draft\n" for name in names))
    return path


def test_nothing_is_done_and_all_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    path = captures(tmp_path, ["a", "b", "c"])
    (tmp_path / "b/photos").rename(tmp_path / "b/elsewhere")
    before = sorted(tmp_path.rglob("*"))
    found = batch(BatchParams(list=path, dry_run=True), Reporter())
    assert sorted(tmp_path.rglob("*")) == before
    assert (found["captures"], found["skipped"]) == (3, 0)
    assert found["missing"] == [str(tmp_path / "b/photos")]
    assert found["tasks"] == dict.fromkeys(["new", "poses", "train", "mesh", "evaluate", "render"], 3)
    assert found["measured"] == []
    hours = [found["hours"][cores] for cores in ("2", "8", "64")]
    assert hours == sorted(hours, reverse=True)
    assert hours[0] > hours[2] > 0
    assert "3 captures to do, 18 tasks" in caplog.text
    assert "That is a guess" in caplog.text
    assert "Photos of 1 are not there" in caplog.text


def test_what_was_measured_is_told_from(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    path = captures(tmp_path, ["a", "b"])
    done = read_list(path)[0].params
    save_project(done.out, Project())
    seconds = dict.fromkeys(["new", "poses", "train", "mesh", "evaluate", "render"], 3600.0)
    entry = {"state": "done", "settings": done.model_dump(mode="json"), "stages": seconds}
    path.with_name("captures-report.json").write_text(json.dumps({"captures": {str(done.out): entry}}))
    found = batch(BatchParams(list=path, dry_run=True), Reporter())
    assert (found["captures"], found["skipped"], len(found["measured"])) == (1, 1, 6)
    assert found["hours"] == dict.fromkeys(["2", "8", "64"], 6.0), "stages of one capture come one after the other"
    assert found["core_hours"] == 9.0, "three of them take two cores"
    assert "a guess" not in caplog.text


def test_what_is_wrong_is_told_before_anything_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link, "require_ray", lambda: None)
    path = captures(tmp_path, ["a"])
    with pytest.raises(SettingError, match="no address of a cluster"):
        batch(BatchParams(list=path, cluster="nowhere", dry_run=True), Reporter())
    path.write_text("photos,blend\na/photos,/elsewhere/a.blend\n")
    with pytest.raises(SettingError, match="is outside of"):
        batch(BatchParams(list=path, dry_run=True), Reporter())


def test_on_the_command_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = captures(tmp_path, ["a"])
    assert cli.main(["batch", str(path), "--dry-run", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["captures"] == 1


@pytest.mark.slow
def test_two_thousand_captures_are_planned_by_the_command_a_user_types(tmp_path: Path) -> None:
    """5 s of the clock are asked on a machine of its own; what other programs take is not counted here."""
    pytest.importorskip("ray", reason="the extra “cluster” is not installed")
    resource = pytest.importorskip("resource", reason="processor time of other programs is not told here")
    path = captures(tmp_path, [f"c{number}" for number in range(2000)])
    command = [
        sys.executable,
        "-m",
        "fieldwork.nerfcore",
        "batch",
        str(path),
        "--cluster",
        "auto",
        "--dry-run",
        "--json",
    ]
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    found = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    clock, after = time.monotonic() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"2000 captures planned in {clock:.1f} s, {seconds:.1f} s of the processor")
    assert sum(json.loads(found.stdout)["tasks"].values()) == 12_000
    assert seconds < 8.0
