"""The engine as a real process: what it answers, and what it leaves on disk when it is stopped or killed."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from fieldwork.nerfcore.engine import status as st
from fieldwork.nerfcore.engine.jobs import Job
from fieldwork.nerfcore.engine.server import Server, _Stop
from fieldwork.nerfcore.errors import DiskError
from fieldwork.nerfcore.params import RegionParams
from fieldwork.nerfcore.project.schema import Project
from fieldwork.nerfcore.project.store import save_project
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]

ENGINE = ROOT / "tests" / "counting_engine.py"


class Client:
    """The other end of the engine's pipes."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, ENGINE, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=open(folder / "stderr.txt", "ab"),  # noqa: SIM115 - the child writes it
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        )
        self.lines: queue.Queue[bytes] = queue.Queue()
        self.seen: list[dict] = []
        self.number = 0
        self.gone = False  # set: stop reading and close the pipe, as a caller that was killed would
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout
        for line in self.process.stdout:
            self.lines.put(line)
            if self.gone:
                self.process.stdout.close()
                return
        self.lines.put(b"")

    def raw(self, line: bytes) -> None:
        assert self.process.stdin
        self.process.stdin.write(line)
        self.process.stdin.flush()

    def send(self, method: str, **params: object) -> int:
        self.number += 1
        self.raw(
            json.dumps({"jsonrpc": "2.0", "id": self.number, "method": method, "params": params}, default=str).encode()
            + b"\n"
        )
        return self.number

    def next(self, timeout: float = 20.0) -> dict:
        line = self.lines.get(timeout=timeout)
        assert line, "the engine closed its output"
        message = json.loads(line)  # every line must be JSON
        self.seen.append(message)
        return message

    def answer(self, request: int | None, timeout: float = 20.0) -> dict:
        end = time.monotonic() + timeout
        while True:
            message = self.next(max(0.01, end - time.monotonic()))
            if "method" not in message and message["id"] == request:
                return message

    def until_progress(self) -> dict:
        while True:
            message = self.next()
            if message.get("method") == "progress" and (message["params"]["fraction"] or 0) > 0:
                return message["params"]

    def close_stdin(self) -> None:
        assert self.process.stdin
        self.process.stdin.close()


@pytest.fixture
def start(tmp_path):
    clients = []

    def start(*arguments: str) -> Client:
        clients.append(Client(tmp_path, *arguments))
        return clients[-1]

    yield start
    for client in clients:
        client.process.kill()
        client.process.wait()


@pytest.fixture
def project(tmp_path):
    folder = tmp_path / "Projekt mit Ümlaut"
    save_project(folder, Project())
    return folder


def only_job(project: Path) -> st.JobStatus:
    (job,) = st.list_jobs(project)
    return job


def test_module_serves_and_says_who_it_is():
    done = subprocess.run(
        [sys.executable, "-m", "nerfcore", "serve"],
        input=b'{"jsonrpc":"2.0","id":"a","method":"ping"}\n',
        capture_output=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        timeout=60,
        check=True,
    )
    (line,) = done.stdout.splitlines()
    answer = json.loads(line)
    assert answer["id"] == "a"
    assert answer["result"]["protocol"] == 1


def test_job_runs_reports_and_leaves_its_state(start, project):
    client = start()
    answer = client.answer(client.send("count", project=project, steps=30, job="mine"))
    assert answer["result"] == {"steps": 30, "project": str(project)}
    progress = [m["params"] for m in client.seen if m.get("method") == "progress"]
    assert {p["job"] for p in progress} == {"mine"}
    assert progress[-1]["stage"] == "Counting"
    fractions = [p["fraction"] for p in progress if p["fraction"] is not None]
    assert fractions == sorted(fractions)
    assert len(fractions) > 3
    events = [m["params"] for m in client.seen if m.get("method") == "event"]
    # NaN is no JSON: it arrives as null.
    assert events[1] == {"job": "mine", "kind": "train", "step": 10, "loss": None, "where": str(project)}
    job = only_job(project)
    assert (job.state, job.fraction, job.result) == ("done", 1.0, answer["result"])
    on_disk, offset = st.read_events(project, "mine")
    assert [event["step"] for event in on_disk] == [0, 10, 20]
    assert st.read_events(project, "mine", offset) == ([], offset)


def test_eta_is_about_right(start, project):
    client = start()
    client.send("count", project=project, steps=150)
    while True:
        message = client.next()
        if message.get("method") == "progress" and (message["params"]["fraction"] or 0) > 0.4:
            break
    asked = time.monotonic()
    client.answer(1)
    assert message["params"]["eta_s"] == pytest.approx(time.monotonic() - asked, rel=0.6, abs=0.5)


@pytest.mark.parametrize(
    ("line", "code", "text"),
    [
        (b"this is not JSON\n", -32700, "not JSON"),
        (b"\xff\xfe\x00\n", -32700, "not JSON"),
        (b"[1, 2]\n", -32600, "object"),
        (b'{"id": 7, "method": "ping"}\n', -32600, "2.0"),
        (b'{"jsonrpc": "2.0", "id": {}, "method": "ping"}\n', -32600, "id"),
        (b'{"jsonrpc": "2.0", "id": 7, "method": "ping", "params": [1]}\n', -32602, "by name"),
        (b'{"jsonrpc": "2.0", "id": 7, "method": "fly"}\n', -32601, "fly"),
        (b'{"jsonrpc": "2.0", "id": "\\udce9", "method": "fly"}\n', -32601, "fly"),
        (b'{"jsonrpc": "2.0", "id": 7, "method": "fl\\udce9"}\n', -32601, "“fl?”"),
        (b'{"jsonrpc": "2.0", "id": ' + b"9" * 5000 + b', "method": "ping"}\n', -32700, "digits"),
        (b'{"jsonrpc": "2.0", "id": 7, "method": "count", "params": {"stepz": 3}}\n', -32602, "stepz"),
        (
            b'{"jsonrpc": "2.0", "id": 7, "method": "poses", "params": {"project": "x", "preset": "q"}}\n',
            -32602,
            "fast",
        ),
        (b'{"jsonrpc": "2.0", "id": 7, "method": "count", "params": {"project": "x", "job": "../x"}}\n', -32602, "job"),
        (
            b'{"jsonrpc": "2.0", "id": 7, "method": "count", "params": {"project": "x", "detach": 1}}\n',
            -32602,
            "detach",
        ),
        (b'{"jsonrpc": "2.0", "id": 7, "method": "cancel", "params": {"job": "ghost"}}\n', -32602, "ghost"),
    ],
)
def test_bad_requests_are_answered_and_survived(start, line, code, text):
    client = start()
    client.raw(line)
    error = client.next()["error"]
    assert error["code"] == code
    assert text in error["message"]
    assert client.answer(client.send("ping"))["result"]["pid"] == client.process.pid


def test_what_native_code_and_children_print_stays_out_of_the_protocol(start, project, tmp_path):
    client = start()
    # The child reads its stdin: it must not swallow the next request.
    assert client.answer(client.send("count", project=project, steps=1, native=True))["result"]["steps"] == 1
    assert client.answer(client.send("ping"))["result"]["pid"] == client.process.pid
    printed = (tmp_path / "stderr.txt").read_text()
    assert {"native text", "python text", "child text"} <= set(printed.splitlines())


def test_errors_are_typed(start, project):
    client = start()
    error = client.answer(client.send("count", project=project, fail="input"))["error"]
    assert error["code"] == -32000
    assert error["data"] == {"code": "input", "message": "photo.jpg is not an image.", "hint": "Remove it."}
    assert only_job(project).error == error["data"]
    error = client.answer(client.send("count", project=project, fail="bug"))["error"]
    assert error["code"] == -32603
    assert "KeyError" in error["data"]["traceback"][-1]
    assert "Traceback" in Path(error["data"]["log"]).read_text()
    assert only_job(project).state == "failed"  # the older job of the verb is gone


def test_cancel_is_prompt_and_leaves_a_checkpoint(start, project):
    client = start()
    request = client.send("count", project=project, steps=10_000)
    job = client.until_progress()["job"]
    asked = time.monotonic()
    client.send("cancel", job=job)
    assert client.answer(request)["error"]["code"] == -32001
    assert time.monotonic() - asked < 2.0
    assert (project / "checkpoint").exists()
    assert only_job(project).state == "cancelled"


def test_cancel_file_stops_a_job_from_outside(start, project):
    client = start()
    request = client.send("count", project=project, steps=10_000)
    job = client.until_progress()["job"]
    asked = time.monotonic()
    st.request_cancel(project, job)
    assert client.answer(request)["error"]["code"] == -32001
    assert time.monotonic() - asked < 2.0
    assert not st.cancel_path(project, job).exists()


def test_a_path_that_the_system_refuses_ends_its_own_job_only(start, project):
    client = start()
    request = client.send("count", project=project, steps=10_000, job="long")
    client.until_progress()
    refused = client.send("count", project=project.parent / ("x" * 300), job="refused")
    time.sleep(1.2)  # the clock has looked at both
    st.request_cancel(project, "long")
    assert client.answer(request, timeout=5)["error"]["code"] == -32001
    assert "the name is too long" in client.answer(refused)["error"]["message"]
    assert client.answer(client.send("status"))["result"]["jobs"] == []


def test_a_signal_is_heard_while_a_request_is_answered():
    server = Server(io.BytesIO(b'{"jsonrpc": "2.0", "id": 1, "method": "ping"}\n'), io.BytesIO())

    def ping(params):
        raise _Stop

    server._do_ping = ping
    with pytest.raises(_Stop):
        server._handle(b'{"jsonrpc": "2.0", "id": 1, "method": "ping"}\n')


def test_queued_jobs_wait_and_can_be_cancelled(start, project):
    client = start()
    first = client.send("count", project=project, steps=60, job="first")
    second = client.send("count", project=project, steps=5, job="second")
    third = client.send("count", project=project, steps=1, job="third")
    client.send("cancel", job="second")
    assert client.answer(second)["error"]["code"] == -32001
    assert client.answer(first)["result"]["steps"] == 60
    assert client.answer(third)["result"]["steps"] == 1


@pytest.mark.parametrize("how", ["request", "file"])
def test_a_job_that_waits_is_cancelled_at_once(start, project, how):
    client = start()
    first = client.send("count", project=project, steps=100_000, job="first")
    second = client.send("count", project=project, steps=5, job="second")
    client.until_progress()
    if how == "request":
        client.send("cancel", job="second")
    else:
        st.request_cancel(project, "second")
    assert client.answer(second, timeout=5)["error"]["code"] == -32001
    assert {job.id: job.state for job in st.list_jobs(project)} == {"first": "running", "second": "cancelled"}
    assert [job["id"] for job in client.answer(client.send("status"))["result"]["jobs"]] == ["first"]
    client.send("cancel", job="first")
    assert client.answer(first)["error"]["code"] == -32001
    assert client.answer(client.send("count", project=project, steps=1))["result"]["steps"] == 1


def test_a_deaf_job_is_ended_with_its_process(start, project):
    client = start("1.0")
    request = client.send("count", project=project, steps=2000, deaf=True)
    client.next()
    time.sleep(0.3)
    client.send("cancel")
    assert client.answer(request, timeout=5)["error"]["code"] == -32001
    assert client.process.wait(timeout=5) == 3
    assert only_job(project).state == "cancelled"


def test_a_job_of_a_name_that_was_cancelled_before_has_its_time_to_end(start, project):
    client = start("2.0")
    first = client.send("count", project=project, steps=10_000, job="mine")
    client.until_progress()
    client.send("cancel", job="mine")
    assert client.answer(first)["error"]["code"] == -32001
    time.sleep(2.2)
    second = client.send("count", project=project, steps=40, deaf=True, job="mine")
    while client.next().get("method") != "event":  # one that waits is cancelled at once
        pass
    client.send("cancel", job="mine")
    assert client.answer(second)["result"]["steps"] == 40


def test_end_of_stdin_stops_the_job_with_a_checkpoint(start, project):
    client = start()
    client.send("count", project=project, steps=10_000)
    client.until_progress()
    closed = time.monotonic()
    client.close_stdin()
    assert client.process.wait(timeout=10) == 0
    assert time.monotonic() - closed < 3.0
    assert (project / "checkpoint").exists()
    assert only_job(project).state == "cancelled"


@pytest.mark.parametrize("how", ["parameter", "request"])
def test_detached_job_outlives_its_caller_and_can_be_followed(start, project, how):
    client = start()
    client.send("count", project=project, steps=150, **({"detach": True} if how == "parameter" else {}))
    client.until_progress()
    if how == "request":
        client.answer(client.send("detach"))
    client.gone = True
    client.close_stdin()
    time.sleep(0.7)
    job = only_job(project)
    assert job.state == "running"
    assert st.engine_alive(job)
    assert 0 < (job.fraction or 0) < 1
    assert client.process.wait(timeout=20) == 0
    job = only_job(project)
    assert (job.state, job.result) == ("done", {"steps": 150, "project": str(project)})


def test_killed_engine_reads_as_died(start, project):
    client = start()
    client.send("count", project=project, steps=10_000)
    client.until_progress()
    time.sleep(0.7)
    client.process.send_signal(signal.SIGKILL)
    client.process.wait()
    job = only_job(project)
    assert job.state == "died"
    assert "Counting" in job.error["message"]
    assert "again" in job.error["hint"]
    # The lock went with the process: the next engine may work.
    other = start()
    assert other.answer(other.send("count", project=project, steps=2))["result"]["steps"] == 2
    assert only_job(project).state == "done"


def test_a_job_that_ends_while_it_is_read_did_not_die(project, monkeypatch):
    job = st.JobStatus("x", "count", {}, state="running", pid=os.getpid())
    st.write_job(project, job)

    def ends(status):
        st.write_job(project, dataclasses.replace(status, state="done"))
        return False

    monkeypatch.setattr(st, "engine_alive", ends)
    assert only_job(project).state == "done"


def test_a_reused_process_number_is_not_taken_for_the_engine(project):
    job = st.JobStatus(
        "x", "count", {}, state="running", pid=os.getpid(), pid_started=(st.process_start(os.getpid()) or 0) - 100
    )
    st.write_job(project, job)
    assert only_job(project).state == "died"


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_clock_that_is_set_does_not_end_a_job(project, monkeypatch):
    job = st.JobStatus("x", "count", {}, state="running", pid=os.getpid(), pid_started=st.process_start(os.getpid()))
    st.write_job(project, job)
    read = Path.read_text

    def set_forward(path, *args, **values):
        """The kernel takes the time at which it started from the clock."""
        text = read(path, *args, **values)
        return re.sub(r"btime (\d+)", lambda m: f"btime {int(m[1]) + 3600}", text) if path.name == "stat" else text

    monkeypatch.setattr(Path, "read_text", set_forward)
    assert only_job(project).state == "running"


def test_a_job_of_another_computer_lives_as_long_as_it_is_written(project):
    job = st.JobStatus("x", "count", {}, state="running", pid=2**22 + 1, host="another")
    st.write_job(project, job)
    assert only_job(project).state == "running"
    path = st.job_path(project, "x")
    path.write_text(json.dumps(dataclasses.asdict(job) | {"updated": time.time() - 2 * st.STALE}))
    assert only_job(project).state == "died"


def test_two_engines_do_not_write_one_project(start, project):
    first, second = start(), start()
    first.send("count", project=project, steps=10_000)
    first.until_progress()
    error = second.answer(second.send("count", project=project, steps=1))["error"]
    assert error["data"]["code"] == "project"
    assert str(first.process.pid) in error["message"]
    first.answer(first.send("cancel"))


def test_sigterm_stops_even_a_detached_job(start, project):
    client = start()
    client.send("count", project=project, steps=10_000, detach=True)
    client.until_progress()
    client.process.terminate()
    assert client.process.wait(timeout=10) == 0
    assert only_job(project).state == "cancelled"


def test_damaged_job_files_are_no_jobs(project):
    folder = project / st.FOLDER
    folder.mkdir()
    (folder / "half.json").write_text('{"id": "ha')
    (folder / "list.json").write_text("[1]")
    (folder / "other.json").write_text('{"name": 1}')
    assert st.list_jobs(project) == []


def test_events_that_a_full_disk_cut_off_are_left_out(project):
    path = st.events_path(project, "x")
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(
        b'{"kind": "train", "step": 1}\n{"kind": "tr{"kind": "train", "step": 3}\n\xff\n7\n{"step": 4}\n{"ste'
    )
    events, offset = st.read_events(project, "x")
    assert [event["step"] for event in events] == [1, 4]
    assert st.read_events(project, "x", offset) == ([], offset)


def test_a_full_disk_is_told_once_by_a_job(project, caplog, monkeypatch):
    job = Job("x", "region", RegionParams(project=project), 1, lambda message: None, False)
    (project / st.FOLDER).mkdir()
    st.events_path(project, "x").mkdir()  # what cannot be written

    def full(*_):
        raise DiskError("No space left on the disk.")

    monkeypatch.setattr(st, "write_job", full)
    for step in range(3):
        job.event("train", step=step)
        job.heartbeat()
        job.progress(step / 3)
    assert len([record for record in caplog.records if record.levelname == "WARNING"]) == 2


def test_a_project_that_is_not_there_is_not_made(start, tmp_path):
    client = start()
    error = client.answer(client.send("poses", project=tmp_path / "nowhere"))["error"]
    assert error["data"]["code"] == "project"
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize("there", [True, False])
def test_failed_new_leaves_nothing(start, tmp_path, there):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"no photo")
    project = tmp_path / "new"
    if there:
        project.mkdir()
    client = start()
    error = client.answer(client.send("new", project=project, photos=tmp_path / "photos"))["error"]
    assert error["data"]["code"] == "input"
    time.sleep(1.2)  # two looks of the clock that writes states of jobs
    assert (list(project.iterdir()) == []) if there else not project.exists()


def test_a_job_locks_the_project_that_the_one_before_it_made(start, tmp_path):
    """Poses queued while the project does not exist yet: its state is on disk in the end."""
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (200, 100), (90, 120, 30)).save(tmp_path / "photos" / "a.png")
    client = start()
    client.send("new", project=tmp_path / "new", photos=tmp_path / "photos")
    error = client.answer(client.send("poses", project=tmp_path / "new"))["error"]
    assert error["data"]["code"] == "poses"
    assert {job.verb: job.state for job in st.list_jobs(tmp_path / "new")} == {"new": "done", "poses": "failed"}


def test_unwritable_project_is_an_error_that_names_it(start, tmp_path):
    blocked = tmp_path / "blocked"
    save_project(blocked, Project())
    (blocked / "jobs").write_text("a file where a folder must be")
    client = start()
    error = client.answer(client.send("count", project=blocked, steps=1))["error"]
    assert error["data"]["code"] == "disk"
    assert "jobs" in error["message"]


def test_cancel_does_not_wait_for_libraries_that_load(start, project):
    client = start()
    request = client.send("slow_to_load", project=project)
    client.next()  # the job has begun
    time.sleep(0.3)
    asked = time.monotonic()
    client.send("cancel")
    assert client.answer(request)["error"]["code"] == -32001
    assert time.monotonic() - asked < 1.0
    # They go on loading, and the next job has them.
    assert client.answer(client.send("slow_to_load", project=project, steps=1))["result"]["steps"] == 1
