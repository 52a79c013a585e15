"""What nobody foresaw ends in a sentence, a log file and one JSON object, never in a traceback."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from fieldwork.nerfcore import cli
from fieldwork.nerfcore.engine import protocol as rpc
from fieldwork.nerfcore.engine.server import Server
from fieldwork.nerfcore.errors import Cancelled, explained
from fieldwork.nerfcore.files import disk_errors, write_text
from fieldwork.nerfcore.params import RegionParams
from fieldwork.nerfcore.poses.align import align
from fieldwork.nerfcore.poses.worker import answer_to
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.runs import run_folder
from fieldwork.nerfcore.render.run import load_trained
from fieldwork.tests.nerfcore.support.ball import ball_project

ROOT = Path(__file__).resolve().parents[2]
COMMAND = [sys.executable, "-m", "fieldwork.nerfcore"]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT.parent)}


class OutOfMemoryError(RuntimeError):
    """As torch calls it."""


RAISED = [
    (MemoryError(), "memory", "memory"),
    (OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB"), "memory", "memory"),
    (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 4 bytes"), "memory", "memory"),
    (OSError(errno.EFBIG, "File too large", "/p/a.png"), "disk", "/p/a.png"),
    (OSError(errno.ENOSPC, "No space left on device"), "disk", "No space"),
    (OSError(errno.ENAMETOOLONG, "File name too long", "/p/xx"), "disk", "too long"),
    (ImportError("libtorch_cpu.so: failed to map segment from shared object"), "memory", "load the libraries"),
    (RecursionError("maximum recursion depth exceeded"), "input", "nested"),
    (KeyError("lens"), "internal", "KeyError"),
    (SystemError("error return without exception set"), "internal", "SystemError"),
]


@pytest.mark.parametrize(("error", "code", "words"), RAISED, ids=lambda value: type(value).__name__)
def test_a_failure_nobody_foresaw(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], error, code: str, words: str
) -> None:
    def fail(*_: object) -> None:
        raise error

    project = ball_project(tmp_path / "p")
    monkeypatch.setattr(cli, "run_verb", fail)
    assert cli.main(["evaluate", str(project), "--json"]) == 1
    out, err = capfd.readouterr()
    told = json.loads(out)["error"]
    assert told["code"] == code
    assert words in told["message"]
    assert told["hint"]
    assert "Traceback" not in out + err
    if code == "internal":
        log = Path(told["log"])
        assert log.is_relative_to(project / "jobs")
        assert "Traceback" in log.read_text(encoding="utf-8")
        assert str(log) in err


def test_a_cancelled_command_prints_one_object_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def cancelled(*_: object) -> None:
        raise Cancelled

    project = ball_project(tmp_path / "p")
    monkeypatch.setattr(cli, "run_verb", cancelled)
    assert cli.main(["evaluate", str(project), "--json"]) == 130
    out, err = capfd.readouterr()
    assert json.loads(out)["error"]["code"] == "cancelled"
    assert "Run the same command again to go on." in err


def test_a_cancelled_training_names_what_makes_it_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def cancelled(*_: object) -> None:
        raise Cancelled

    project = ball_project(tmp_path / "p")
    monkeypatch.setattr(cli, "run_verb", cancelled)
    for options, words in (([], "again with --resume to go on"), (["--resume"], "again to go on")):
        assert cli.main(["train", str(project), "--json", *options]) == 130
        out, err = capfd.readouterr()
        assert words in json.loads(out)["error"]["hint"]
        assert words in err


def test_a_failure_without_a_project_is_logged_too(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(cli, "run_verb", fail)
    assert cli.main(["doctor"]) == 1
    named = re.search(r"(\S+\.log)", capfd.readouterr().err)
    assert named
    log = Path(named[1])
    assert "ZeroDivisionError" in log.read_text(encoding="utf-8")
    log.unlink()


@pytest.mark.parametrize(("ok", "options", "code"), [(True, ["--strict"], 0), (False, ["--strict"], 3), (False, [], 0)])
def test_a_machine_with_problems_fails_where_it_is_strict(
    monkeypatch: pytest.MonkeyPatch, ok: bool, options: list[str], code: int
) -> None:
    monkeypatch.setattr(cli, "run_verb", lambda *_: {"ok": ok, "problems": [] if ok else ["No disk."]})
    assert cli.main(["doctor", *options]) == code


def test_the_engine_says_the_same() -> None:
    for error, code, words in RAISED:
        answer = rpc.as_rpc_error(error, "a.log", ["Traceback"])
        assert answer.data is not None
        assert answer.data["code"] == code
        assert words in answer.message
        assert answer.code == (rpc.INTERNAL_ERROR if code == "internal" else rpc.FAILED)


def test_pose_worker_names_what_failed() -> None:
    assert answer_to(MemoryError(), Path("w"))["code"] == "memory"
    assert answer_to(RuntimeError("database or disk is full"), Path("w"))["code"] == "disk"
    assert answer_to(RuntimeError("No registered database factory succeeded."), Path("w"))["code"] == "disk"
    lost = answer_to(SystemError("<built-in method> error return without exception set"), Path("w"))
    assert (lost["code"], "Memory" in lost["hint"]) == ("poses", True)


@pytest.mark.parametrize("number", [errno.EFBIG, errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG])
def test_refusals_of_the_disk_are_sentences(number: int) -> None:
    with pytest.raises(Exception, match="some/file") as caught, disk_errors(Path("some/file")):
        raise OSError(number, os.strerror(number))
    assert explained(caught.value).code == "disk"


def test_a_file_in_the_way_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with pytest.raises(Exception, match="a file is in its way"):
        write_text(tmp_path / "out" / "a.txt", "x")
    assert (tmp_path / "out").read_text() == "mine"


def test_a_field_of_another_shape_is_a_damaged_run(tmp_path: Path) -> None:
    from fieldwork.nerfcore.params import TrainParams
    from fieldwork.nerfcore.train.verb import train
    from fieldwork.tests.nerfcore.support.ball import SMALL

    project = ball_project(tmp_path / "p")
    train(TrainParams(project=project, preset="draft", steps=2, set=SMALL), Reporter())
    path = run_folder(project, "main") / "config.json"
    value = json.loads(path.read_text())
    value["config"]["field"]["width"] = 8
    path.write_text(json.dumps(value))
    with pytest.raises(Exception, match=r"field\.safetensors.*config\.json"):
        load_trained(project, "main")


def test_no_direction_is_up(tmp_path: Path) -> None:
    from fieldwork.nerfcore.params import AlignParams

    project = ball_project(tmp_path / "p")
    for up in ("nan,0,1", "inf,0,0"):
        with pytest.raises(Exception, match="finite"):
            align(AlignParams(project=project, up=up), Reporter())
    with pytest.raises(Exception, match="3 numbers"):
        align(AlignParams(project=project, up="0,1"), Reporter())


def test_nested_json_does_not_end_the_engine() -> None:
    requests = b"[" * 200_000 + b"\n" + b'{"a":' * 200_000 + b"\n"
    requests += b'{"jsonrpc": "2.0", "id": 1, "method": "ping"}\n'
    answers = io.BytesIO()
    Server(io.BytesIO(requests), answers).serve()
    replies = [json.loads(line) for line in answers.getvalue().splitlines()]
    assert [reply.get("error", {}).get("code") for reply in replies] == [rpc.PARSE_ERROR, rpc.PARSE_ERROR, None]
    assert replies[-1]["result"]["protocol"] == rpc.VERSION


def test_an_immediate_edit_that_fails_is_answered(tmp_path: Path) -> None:
    assert RegionParams(project=tmp_path)
    request = {"jsonrpc": "2.0", "id": 1, "method": "region", "params": {"project": str(tmp_path / "none")}}
    answers = io.BytesIO()
    Server(io.BytesIO(json.dumps(request).encode() + b"\n"), answers).serve()
    assert json.loads(answers.getvalue())["error"]["data"]["code"] == "project"


def run(*arguments: str, **options) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run([*COMMAND, *arguments], env=ENVIRONMENT, cwd=ROOT.parent, timeout=60, **options)


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX shells")
@pytest.mark.parametrize(
    ("redirection", "words"),
    [(">&-", "no standard output"), (">/dev/full", "No space left"), ("| sleep 0", "Nobody reads")],
    ids=["closed", "full", "broken pipe"],
)
def test_results_that_nobody_takes(tmp_path: Path, redirection: str, words: str) -> None:
    project = ball_project(tmp_path / "p")
    command = f"{' '.join(COMMAND)} classes {project} --json {redirection}; echo ${{PIPESTATUS[0]}} >&2"
    done = subprocess.run(
        ["bash", "-c", command], env=ENVIRONMENT, cwd=ROOT.parent, capture_output=True, timeout=60, check=False
    )
    told = done.stderr.decode()
    assert words in told
    assert told.rstrip().endswith("1")
    assert "Traceback" not in told


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX shells")
@pytest.mark.parametrize(
    ("command", "code", "words"),
    [
        ("nosuch --json >/dev/full", 2, "No such command"),
        ("nosuch --json | sleep 0", 2, "No such command"),
        ("--help >/dev/full", 1, "No space left"),
        ("train -h | sleep 0", 1, ""),
    ],
)
def test_help_and_wrong_usage_that_nobody_takes(command: str, code: int, words: str) -> None:
    command = f"{' '.join(COMMAND)} {command}; echo ${{PIPESTATUS[0]}} >&2"
    done = subprocess.run(
        ["bash", "-c", command], env=ENVIRONMENT, cwd=ROOT.parent, capture_output=True, timeout=60, check=False
    )
    told = done.stderr.decode()
    assert words in told
    assert told.rstrip().endswith(str(code))
    assert "Traceback" not in told


@pytest.mark.parametrize(("verb", "meant"), [("trian", "train"), ("label strok", "stroke")])
def test_verbs_that_are_misspelt_say_what_was_meant(capsys: pytest.CaptureFixture[str], verb: str, meant: str) -> None:
    assert cli.main([*verb.split(), "p"]) == 2
    assert f"Did you mean '{meant}'" in capsys.readouterr().err


@pytest.mark.parametrize(("arguments", "code"), [("plan . --views nope --json", 2), ("section -h", 0)])
def test_terminals_that_lack_characters(arguments: str, code: int) -> None:
    environment = {**ENVIRONMENT, "PYTHONIOENCODING": "latin-1"}
    command = [*COMMAND, *arguments.split()]
    done = subprocess.run(command, env=environment, cwd=ROOT.parent, capture_output=True, timeout=60, check=False)
    assert done.returncode == code
    assert b"Traceback" not in done.stderr
    if "--json" in arguments:
        assert "“views.0”" in json.loads(done.stdout)["error"]["message"]
    else:
        assert b"\\u2026" in done.stdout


@pytest.mark.skipif(sys.platform == "win32", reason="limits of POSIX")
def test_files_may_only_be_small(tmp_path: Path) -> None:
    project = ball_project(tmp_path / "p")
    before = (project / "project.json").read_bytes()
    command = f"ulimit -f 1; exec {' '.join(COMMAND)} classes {project} --file {tmp_path / 'c.json'} --json"
    (tmp_path / "c.json").write_text(json.dumps([f"{'class' * 20}{i}" for i in range(200)]))
    done = subprocess.run(["bash", "-c", command], env=ENVIRONMENT, cwd=ROOT.parent, capture_output=True, timeout=60)
    assert done.returncode == 1
    assert json.loads(done.stdout)["error"]["code"] == "disk"
    assert (project / "project.json").read_bytes() == before


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_cancelled_while_libraries_load(tmp_path: Path) -> None:
    project = ball_project(tmp_path / "p")
    process = subprocess.Popen(
        [*COMMAND, "train", str(project)], env=ENVIRONMENT, cwd=ROOT.parent, stderr=subprocess.PIPE
    )
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline and not (project / "jobs" / "engine.lock.owner").exists():
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    begin = time.monotonic()
    assert process.wait(30) == 130
    assert time.monotonic() - begin < 2.5
    assert process.stderr is not None
    assert b"Cancelled" in process.stderr.read()


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_cancelled_while_the_command_line_itself_loads(tmp_path: Path) -> None:
    """The line that Python prints of each module it imports says when it is there."""
    project = ball_project(tmp_path / "p")
    command = [sys.executable, "-v", *COMMAND[1:], "classes", str(project)]
    process = subprocess.Popen(command, env=ENVIRONMENT, cwd=ROOT.parent, stderr=subprocess.PIPE)
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith(b"import 'pydantic"):
            break
    process.send_signal(signal.SIGINT)
    rest = process.stderr.read()
    assert process.wait(30) == 130
    assert b"Traceback" not in rest


ARCHIVE = """
import sys
from fieldwork.nerfcore.streams import keep_quiet_about_destructors
class Archive:
    def __del__(self):
        raise ValueError("seek of closed file")
if sys.argv[1] == "quiet":
    keep_quiet_about_destructors()
Archive()
"""


@pytest.mark.parametrize("quiet", [True, False])
def test_what_fails_while_objects_are_thrown_away_is_not_shown(quiet: bool) -> None:
    command = [sys.executable, "-c", ARCHIVE, "quiet" if quiet else "as usual"]
    done = subprocess.run(command, env=ENVIRONMENT, cwd=ROOT.parent, capture_output=True, text=True, check=True)
    assert ("Traceback" in done.stderr) != quiet
