"""What is written as Windows wants it: on a file system that behaves like its own."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest
import torch
from fieldwork.nerfcore import files
from fieldwork.nerfcore.engine import status as st
from fieldwork.nerfcore.errors import DiskError
from fieldwork.nerfcore.files import write_json, write_text
from fieldwork.nerfcore.params import TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.runs import fresh_folder, run_folder, swap_in
from fieldwork.nerfcore.render.kept_grid import KeptGrid
from fieldwork.nerfcore.sampling.render_grid import FineDensity
from fieldwork.nerfcore.train.verb import train
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from fieldwork.tests.nerfcore.support.windows_files import behave_like_windows, closes_after

pytestmark = pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="what is open is read from /proc")


@pytest.fixture(autouse=True)
def windows(monkeypatch: pytest.MonkeyPatch) -> None:
    behave_like_windows(monkeypatch)


def test_the_stand_in_refuses_what_windows_refuses(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("a")
    with open(path, "rb") as held:
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fsync(held.fileno())
        for refused in (path.unlink, lambda: os.replace(path, tmp_path / "b"), lambda: os.rename(tmp_path, tmp_path)):
            with pytest.raises(PermissionError, match="in use"):
                refused()
    mapped = torch.UntypedStorage.from_file(str(path), False, 1)  # its file is closed
    with pytest.raises(PermissionError, match="in use"):
        os.replace(tmp_path / "c", path)
    del mapped
    os.replace(path, tmp_path / "b")
    assert (tmp_path / "b").read_text() == "a"


def test_files_are_written(tmp_path: Path) -> None:
    write_json(tmp_path / "project.json", {"a": 1})
    write_json(tmp_path / "project.json", {"a": 2})
    assert os.listdir(tmp_path) == ["project.json"]


def test_a_file_that_is_being_read_is_replaced_when_its_reader_is_done(tmp_path: Path) -> None:
    path = tmp_path / "project.json"
    write_text(path, "old")
    reader = threading.Thread(target=closes_after, args=(open(path), 0.2))  # noqa: SIM115
    reader.start()
    write_text(path, "new")
    reader.join()
    assert path.read_text() == "new"


def test_a_file_that_stays_open_is_told_and_left_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "READERS_TAKE", 0.1)
    path = tmp_path / "project.json"
    write_text(path, "old")
    with open(path), pytest.raises(DiskError, match=r"project\.json"):
        write_text(path, "new")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["project.json"]


def test_a_run_whose_file_is_open_elsewhere_keeps_its_place(tmp_path: Path) -> None:
    run, fresh = run_folder(tmp_path, "main"), fresh_folder(tmp_path, "main")
    for folder, text in ((run, "old"), (fresh, "new")):
        folder.mkdir(parents=True)
        (folder / "field.safetensors").write_text(text)
    with open(run / "field.safetensors"), pytest.raises(DiskError):
        swap_in(tmp_path, "main")
    assert (run / "field.safetensors").read_text() == "old"
    swap_in(tmp_path, "main")
    assert (run / "field.safetensors").read_text() == "new"


def test_a_job_begins_while_that_of_an_earlier_one_is_read(tmp_path: Path) -> None:
    for name in ("old", "new"):
        st.write_job(tmp_path, st.JobStatus(name, "train", {}, state="done" if name == "old" else "queued"))
    new = st.JobStatus("new", "train", {}, state="running")
    with open(st.job_path(tmp_path, "old")):
        st.prune_jobs(tmp_path, new)
    st.prune_jobs(tmp_path, new)
    assert [path.name for path in (tmp_path / st.FOLDER).iterdir()] == ["new.json"]


def test_a_training_that_goes_on_replaces_the_checkpoint_that_it_came_from(tmp_path: Path) -> None:
    project = ball_project(tmp_path / "ball", views=6, side=16)
    params = TrainParams(project=project, preset="draft", steps=3, set=SMALL)
    train(params, Reporter())
    result = train(params.model_copy(update={"steps": 5, "resume": True}), Reporter())
    assert result["steps"] == 5


def test_a_kept_grid_is_replaced_while_it_is_used(tmp_path: Path) -> None:
    kept = KeptGrid(tmp_path / "grid.safetensors", "one")
    kept.save(2, FineDensity(torch.arange(3).int(), torch.ones(3, 8).half()))
    used = kept.load(2, torch.device("cpu"))
    assert used is not None
    kept.save(2, used.with_more(FineDensity(torch.tensor([7]).int(), torch.ones(1, 8).half())))
    more = kept.load(2, torch.device("cpu"))
    assert more is not None
    assert more.coarse.tolist() == [0, 1, 2, 7]
