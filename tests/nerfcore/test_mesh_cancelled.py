"""A mesh that is stopped: how soon at each stage, and what is left on disk."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.files import file_hash, staged
from fieldwork.nerfcore.mesh.files import write_surface
from fieldwork.nerfcore.mesh.stored import mesh_folder
from fieldwork.nerfcore.mesh.turntable import SIDE, VIEWS
from fieldwork.nerfcore.params import MeshParams, TrainParams, TurntableParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support import painted_box as box
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from fieldwork.tests.nerfcore.support.meshed import court
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
PROMPT = 2.0  # seconds of a processor from the cancel to the end
DEADLINE = 120.0  # seconds on the clock for anything, on a machine with other work
TINY = {"resolution": 40, "texture": 128, "faces": 2000, "lods": 1, "close_gaps": 5.0}


class Stops(Reporter):
    """Cancels as soon as a stage begins, for the `number`th time any does."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number, self.names = number, list[str]()

    def stage(self, name: str) -> None:
        super().stage(name)
        self.names.append(name)
        if len(self.names) == self.number:
            self.cancel()


class Listens(Reporter):
    """Adds up for each stage the longest time of a processor between two questions whether to go on, of one thread."""

    def __init__(self) -> None:
        super().__init__()
        self.name, self.longest = "Preparing", dict[str, float]()
        self.last = {threading.get_ident(): time.thread_time()}

    def check(self) -> None:
        now, thread = time.thread_time(), threading.get_ident()
        asked = self.last.get(thread, now)
        self.longest[self.name] = max(self.longest.get(self.name, 0.0), now - asked)
        self.last[thread] = now
        super().check()

    def stage(self, name: str) -> None:
        self.check()
        self.name = name


def contents(folder: Path) -> dict[str, str]:
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.suffix != ".lock"]
    return {str(path.relative_to(folder)): file_hash(path) for path in files}


def trained(folder: Path, side: int, views: int) -> Path:
    project = ball_project(folder, views=views, side=side, points=200)
    run_verb("train", TrainParams(project=project, preset="draft", steps=160, set=SMALL), Reporter())
    return project


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(tmp_path_factory.mktemp("cancelled") / "ball", 36, 8)


def meshing(project: Path, folder: Path) -> MeshParams:
    return MeshParams(project=project, out=folder / "a.obj", turntable=folder / "around", split="classes", **TINY)


@pytest.mark.slow
def test_stopped_at_each_stage_nothing_is_written(ball: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    whole = Stops(0)
    run_verb("mesh", meshing(ball, folder), whole)
    assert {"Unwrapping", "Painting the texture", "Looking at it", "Writing"} <= set(whole.names)
    before = contents(ball / "exports"), contents(folder), (ball / "project.json").read_bytes()
    for number in range(1, len(whole.names) + 1):
        report = Stops(number)
        with pytest.raises(Cancelled):
            run_verb("mesh", meshing(ball, folder).model_copy(update={"resolution": 38}), report)
        assert report.names[number - 1 :] == [whole.names[number - 1]], "another stage began"
        after = contents(ball / "exports"), contents(folder), (ball / "project.json").read_bytes()
        assert after == before, whole.names[number - 1]


@pytest.mark.slow
def test_every_stage_of_a_large_mesh_asks_often_whether_to_go_on(tmp_path: Path) -> None:
    project = trained(tmp_path / "ball", 96, 8)
    report = Listens()
    result = run_verb(
        "mesh",
        MeshParams(
            project=project, resolution=256, texture=4096, lods=1, out=tmp_path / "a.glb", turntable=tmp_path / "t"
        ),
        report,
    )
    assert result["faces"] > 10_000
    report.check()
    slow = {name: round(seconds, 1) for name, seconds in report.longest.items() if seconds > PROMPT}
    assert slow == {}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs a signal that ends nothing by itself")
@pytest.mark.parametrize("stage", ["Rendering depth maps", "Unwrapping", "Painting the texture", "Looking at it"])
def test_ctrl_c_ends_the_command(ball: Path, tmp_path: Path, stage: str) -> None:
    command = [sys.executable, "-m", "fieldwork.nerfcore", "mesh", str(ball), "--resolution", "96", "--texture", "512"]
    process = subprocess.Popen(
        [*command, "--out", str(tmp_path / "out" / "a.glb"), "--turntable", str(tmp_path / "out")],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT.parent)},
    )
    watchdog = threading.Timer(DEADLINE, process.kill)
    watchdog.start()
    try:
        assert process.stderr is not None
        before = contents(ball / "exports"), (ball / "project.json").read_bytes()
        for line in process.stderr:
            if line.startswith(stage):
                break
        else:
            pytest.fail(f"{stage} never began")
        spent = sum(psutil.Process(process.pid).cpu_times()[:2])
        process.send_signal(signal.SIGINT)
        last = spent
        while process.poll() is None:
            try:
                last = sum(psutil.Process(process.pid).cpu_times()[:2])
            except psutil.Error:  # it has just ended
                break
            time.sleep(0.02)
        assert process.wait() == 130
    finally:
        watchdog.cancel()
        process.kill()
        process.communicate()
    assert last - spent < PROMPT
    assert (contents(ball / "exports"), (ball / "project.json").read_bytes()) == before
    assert not (tmp_path / "out").exists() or contents(tmp_path / "out") == {}


@pytest.mark.parametrize("ending", ["glb", "obj", "ply", "usdc"])
def test_a_file_that_is_stopped_is_not_there(tmp_path: Path, ending: str) -> None:
    report = Reporter()
    report.cancel()
    with pytest.raises(Cancelled):
        write_surface(
            tmp_path / f"a.{ending}", box.surface(), box.features(), "none", box.texture(), check=report.check
        )
    assert list(tmp_path.iterdir()) == []


def test_files_change_all_together_or_not_at_all(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).write_text("old")
    with pytest.raises(RuntimeError), staged(tmp_path) as place:  # noqa: PT012
        (place / "a").write_text("new")
        raise RuntimeError
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a": "old", "b": "old"}
    with staged(tmp_path) as place:
        (place / "a").write_text("new")
        (place / "c").write_text("new")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a": "new", "b": "old", "c": "new"}


def test_the_turntable_of_a_mesh_that_is_there(tmp_path: Path) -> None:
    project = court(tmp_path / "court")
    files = run_verb("turntable", TurntableParams(project=project), Reporter())["files"]
    assert len(files) == 2 * VIEWS
    folder = mesh_folder(project, "main") / "turntable"
    assert {Path(file).parent for file in files} == {folder}
    for name in ("color_0.png", "class_0.png"):
        with Image.open(folder / name) as image:
            pixels = np.asarray(image).reshape(-1, 3).astype(int)
        assert image.size == (SIDE, SIDE)
        shown = (pixels != pixels[0]).any(1)  # the corner is background
        assert 0.05 < shown.mean() < 0.9
    # The plinth's blue is much bluer than red, whatever the light; nothing else is.
    assert (pixels[:, 2] > 2 * pixels[:, 0]).sum() > 500
    before = contents(folder)
    report = Reporter()
    report.cancel()
    with pytest.raises(Cancelled):
        run_verb("turntable", TurntableParams(project=project), report)
    assert contents(folder) == before
