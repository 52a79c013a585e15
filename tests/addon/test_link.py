"""Blender's end of the line, with a real engine at the other: answers, cancel, death, reattaching."""

from __future__ import annotations

import ast
import os
import sys
import time
from pathlib import Path

import pytest
from fieldwork.addon.engine import link as module
from fieldwork.addon.engine.link import Link, engine_environment
from fieldwork.addon.errors import EngineError
from fieldwork.nerfcore.engine import status as st

ROOT = Path(__file__).resolve().parents[2]
ENGINE = [sys.executable, str(ROOT / "tests" / "counting_engine.py")]


@pytest.fixture
def link(tmp_path):
    link = Link(sys.executable, tmp_path / "log" / "engine.log", ENGINE)
    yield link
    link.close(timeout=2.0)


@pytest.fixture
def project(tmp_path):
    folder = tmp_path / "project with blanks"
    folder.mkdir()
    (folder / "project.json").write_text('{"format": "fieldwork-project", "version": 1}')
    return folder


def wait_for(link: Link, condition, timeout: float = 20.0) -> None:
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        link.pump(timeout=0.05)


def test_link_needs_only_the_standard_library():
    own = {"link", "in_use", "place", "errors"}
    for name in ("link.py", "in_use.py", "place.py", "../errors.py"):
        tree = ast.parse((Path(module.__file__).parent / name).read_text())
        imports = [node for node in ast.walk(tree) if isinstance(node, (ast.Import, ast.ImportFrom))]
        relative = {node.module for node in imports if isinstance(node, ast.ImportFrom) and node.level}
        absolute = {node.module for node in imports if isinstance(node, ast.ImportFrom) and not node.level}
        absolute |= {alias.name for node in imports if isinstance(node, ast.Import) for alias in node.names}
        assert relative <= own
        assert {found.partition(".")[0] for found in absolute} <= sys.stdlib_module_names


def test_blocking_run_returns_the_result_and_hands_out_events(link, project):
    seen = []
    result = link.run_blocking("count", {"project": project, "steps": 30}, lambda kind, data: seen.append((kind, data)))
    assert result == {"steps": 30, "project": str(project)}
    assert {"progress", "event"} <= {kind for kind, _ in seen}
    assert link.alive
    # The same process serves the next request.
    pid = link.process.pid
    assert link.run_blocking("ping", {})["pid"] == pid


def test_errors_come_with_their_kind_and_advice(link, project):
    with pytest.raises(EngineError) as caught:
        link.run_blocking("count", {"project": project, "fail": "input"})
    assert (caught.value.kind, caught.value.hint) == ("input", "Remove it.")
    with pytest.raises(EngineError) as caught:
        link.run_blocking("count", {"project": project, "fail": "bug"})
    assert caught.value.kind == "internal"
    assert "KeyError" in caught.value.detail
    with pytest.raises(EngineError, match="stepz"):
        link.run_blocking("count", {"project": project, "stepz": 1})


def test_cancel_answers_within_two_seconds(link, project):
    outcome, seen = [], []
    link.request(
        "count",
        {"project": project, "steps": 100_000, "job": "mine"},
        lambda *answer: outcome.append(answer),
        lambda kind, data: seen.append(data),
    )
    wait_for(link, lambda: any(data.get("fraction") for data in seen))
    begin = time.monotonic()
    link.cancel("mine")
    wait_for(link, lambda: outcome)
    assert time.monotonic() - begin < 2.0
    assert outcome[0][1].kind == "cancelled"


def test_killed_engine_is_noticed_told_and_replaced(link, project):
    outcome, seen = [], []
    link.request(
        "count",
        {"project": project, "steps": 100_000, "native": True},
        lambda *answer: outcome.append(answer),
        lambda kind, data: seen.append(data),
    )
    wait_for(link, lambda: any(data.get("fraction") for data in seen))
    link.process.kill()
    wait_for(link, lambda: outcome)
    error = outcome[0][1]
    assert error.kind == "died"
    assert "signal 9" in error.message
    assert "child text" in error.detail  # what it last wrote to stderr
    assert not link.busy
    assert link.run_blocking("count", {"project": project, "steps": 1})["steps"] == 1


def test_engine_that_cannot_start_says_so(tmp_path):
    link = Link(tmp_path / "no" / "python", tmp_path / "engine.log")
    with pytest.raises(EngineError, match="no engine at") as caught:
        link.run_blocking("ping", {})
    assert caught.value.kind == "missing"


def test_engine_without_its_packages_dies_with_the_reason(tmp_path):
    link = Link(sys.executable, tmp_path / "engine.log", [sys.executable, "-c", "import no_such_module"])
    with pytest.raises(EngineError, match="no_such_module") as caught:
        link.run_blocking("ping", {})
    assert caught.value.kind == "died"


def test_closing_cancels_and_detaching_does_not(link, project):
    link.request("count", {"project": project, "steps": 100_000, "job": "a"}, on_event=lambda *_: None)
    wait_for(link, lambda: st.job_path(project, "a").is_file())
    link.close()
    assert st.read_job(st.job_path(project, "a")).state == "cancelled"

    link.request("count", {"project": project, "steps": 100, "job": "b"}, on_event=lambda *_: None)
    wait_for(link, lambda: (job := st.read_job(st.job_path(project, "b"))) and job.state == "running")
    link.close(detach=True)
    states = set()
    for _ in range(200):
        job = st.read_job(st.job_path(project, "b"))
        states.add(job.state)
        if job.finished:
            break
        time.sleep(0.1)
    assert states == {"running", "done"}


def test_environment_of_the_engine():
    env = engine_environment({"PYTHONHOME": "/blender", "PYTHONPATH": "/x", "PATH": "/bin", "OMP_NUM_THREADS": "1"})
    assert env["PYTHONPATH"] == str(ROOT)
    assert "PYTHONHOME" not in env
    assert env["PYTHONNOUSERSITE"] == "1"
    assert env["OMP_WAIT_POLICY"] == "passive"
    assert env["OMP_NUM_THREADS"] == "1"
    assert "OMP_NUM_THREADS" not in engine_environment({})


def test_each_process_has_a_log_and_old_ones_go(tmp_path):
    for number in range(12):
        path = tmp_path / f"engine-{number}.log"
        path.write_text("x")
        os.utime(path, (number + 1, number + 1))
    (tmp_path / "doctor.log").write_text("x")
    link = Link(sys.executable, tmp_path / "engine-99.log", ENGINE)
    link.start()
    link.close()
    kept = sorted(int(path.stem.split("-")[1]) for path in tmp_path.glob("engine-*.log"))
    assert kept == [*range(4, 12), 99]
    assert (tmp_path / "doctor.log").exists()


def test_the_engine_has_no_window_on_windows(tmp_path, monkeypatch):
    started = {}

    def popen(command, **how):
        started.update(how)
        raise OSError("no")

    monkeypatch.setattr(module.sys, "platform", "win32")
    for name, flag in {"CREATE_NEW_PROCESS_GROUP": 2, "CREATE_NO_WINDOW": 8}.items():
        monkeypatch.setattr(module.subprocess, name, flag, raising=False)
    monkeypatch.setattr(module.subprocess, "Popen", popen)
    with pytest.raises(EngineError, match="cannot be started"):
        Link(sys.executable, tmp_path / "engine.log", ENGINE).start()
    assert started["creationflags"] & 8
