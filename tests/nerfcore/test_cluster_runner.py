"""What a campaign does with answers, on a line that is made up: retries, lost workers, full disks, cancels."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
from fieldwork.nerfcore.cluster import run
from fieldwork.nerfcore.cluster.run import Options, Runner
from fieldwork.nerfcore.cluster.tasks import Task
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.nerfcore.support.cluster_tasks import FakeLink, bad, chain, good


def run_with(tasks: list[Task], line: Any, tmp_path: Path, report: Reporter | None = None, **options: Any) -> Runner:
    runner = Runner(tasks, line, Options(tmp_path, **options), report or Reporter(), lambda _: None, lambda _: None)
    runner.run()
    assert line.closed
    return runner


def test_failures_are_tried_again_but_not_those_of_the_user(tmp_path):
    counts: dict[str, int] = {}

    def answer(command: dict[str, Any]) -> dict[str, Any]:
        counts[command["id"]] = counts.get(command["id"], 0) + 1
        return {"a0": bad("poses"), "b0": bad("input")}.get(command["id"]) or good(command)

    runner = run_with([*chain("a"), *chain("b"), *chain("c")], FakeLink(answer), tmp_path, retries=2)
    assert counts == {"a0": 3, "b0": 1, "c0": 1, "c1": 1, "c2": 1}
    assert runner.tasks.all["a0"].answer["error"]["code"] == "poses"


def test_it_is_said_which_cluster_was_joined(tmp_path, caplog):
    caplog.set_level("INFO")
    run_with(chain("a", 1), FakeLink(good, nodes=2), tmp_path)
    assert "Joined the cluster at 10.0.0.1:6379 (2 workers, 2 cores)." in caplog.text
    own = run.welcome({"joined": False, "address": "127.0.0.1:1", "nodes": []})
    assert "started for the time of the campaign" in own


def test_a_task_that_ends_its_workers_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "MOST_LOSSES", 3)
    line = FakeLink(lambda command: None if command["id"] == "a0" else good(command))
    runner = run_with([*chain("a"), *chain("b")], line, tmp_path)
    error = runner.tasks.all["a0"].answer["error"]
    assert error["code"] == "lost"
    assert "3 workers were lost" in error["message"]
    assert runner.tasks.all["b2"].state == "done"


def test_lost_workers_cost_no_retries(tmp_path):
    lost = {"a0": 5, "b1": 3}

    def answer(command: dict[str, Any]) -> dict[str, Any] | None:
        lost[command["id"]] = lost.get(command["id"], 0) - 1
        return None if lost[command["id"]] >= 0 else good(command)

    runner = run_with([*chain("a"), *chain("b")], FakeLink(answer), tmp_path, retries=0)
    assert all(task.state == "done" for task in runner.tasks.all.values())
    assert [runner.tasks.all[name].losses for name in ("a0", "b1", "b2")] == [5, 3, 0]


def test_a_worker_with_a_full_disk_gets_nothing_while_others_work(tmp_path):
    def answer(command: dict[str, Any]) -> dict[str, Any]:
        if "n0" in command["avoid"]:
            return {**good(command), "node": "n1"}
        return {**bad("full"), "state": "full"}

    line = FakeLink(answer, nodes=2)
    run_with(chain("a"), line, tmp_path)
    assert [command["avoid"] for command in line.sent] == [[]] + [["n0"]] * 3


def test_a_disk_that_fills_up_while_it_is_written_to_costs_no_retry(tmp_path, monkeypatch):
    def answer(command: dict[str, Any]) -> dict[str, Any]:
        return {**good(command), "node": "n1"} if "n0" in command["avoid"] else bad("disk")

    line = FakeLink(answer, nodes=2)
    report = Reporter()
    runner = run_with(chain("a"), line, tmp_path, report, retries=0)
    assert all(task.state == "done" for task in runner.tasks.all.values())
    assert (runner.tasks.all["a0"].disks, runner.tasks.all["a0"].attempts) == (1, 0)
    assert report.warnings == ["disk! Mend it."]
    # One that meets nothing but full disks is reported in the end.
    monkeypatch.setattr(run, "RESTED", 0.0)
    monkeypatch.setattr(run, "MOST_LOSSES", 3)
    runner = run_with(chain("b", 1), FakeLink(lambda _: bad("disk")), tmp_path, retries=0)
    assert (runner.tasks.all["b0"].state, runner.tasks.all["b0"].disks) == ("failed", 3)


def test_a_capture_that_may_not_be_written_costs_its_workers_one_rest(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "RESTED", 0.1)
    error = {**bad("disk"), "error": {**bad("disk")["error"], "denied": True}}
    line = FakeLink(lambda command: error if command["id"] == "a0" else good(command))
    runner = run_with([*chain("a"), *chain("b")], line, tmp_path, retries=1)
    task = runner.tasks.all["a0"]
    assert (task.state, task.disks, task.attempts) == ("failed", 1, 2)
    assert runner.tasks.all["b2"].state == "done"


def test_a_cancel_while_the_cluster_is_joined_ends_the_line(tmp_path):
    line = FakeLink(good)
    line.open = lambda check: check()
    report = Reporter()
    report.cancel()
    with pytest.raises(Cancelled):
        run_with(chain("a"), line, tmp_path, report)
    assert line.closed


def test_a_task_that_was_silent_when_the_head_went_has_a_new_attempt(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "SILENT", 0.1)
    monkeypatch.setattr(run, "DEAF", 0.2)
    line = FakeLink(good)
    begun: list[float] = []

    def send(**command: Any) -> None:
        line.sent.append(command)
        if command["do"] == "submit":
            begun.append(time.monotonic())
            if len(begun) == 1:
                line.waiting.append({"kind": "told", "id": "a0", "node": "n0"})

    def get(timeout: float) -> dict[str, Any] | None:
        if line.waiting:
            return line.waiting.pop(0)
        time.sleep(0.02)
        if line.sent[-1]["do"] == "cancel":
            return None
        if len(begun) > 1 and time.monotonic() - begun[-1] > 0.5:
            return {"kind": "answer", "id": "a0", "answer": good({})}
        return {"kind": "told", "id": "a0", "node": "n0"} if len(begun) > 1 else {}

    line.send, line.get = send, get
    runner = run_with(chain("a", 1), line, tmp_path)
    assert [command["do"] for command in line.sent] == ["submit", "cancel", "submit"]
    assert runner.tasks.all["a0"].losses == 0


def test_a_silent_worker_is_cut_off(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "SILENT", 0.3)
    line = FakeLink(good)
    line.first = True

    def send(**command: Any) -> None:
        line.sent.append(command)
        if command["do"] == "cancel":
            line.waiting.append({"kind": "answer", "id": command["id"], "answer": {"state": "cancelled"}})
        elif line.first:
            line.first = False
            line.waiting.append({"kind": "told", "id": command["id"], "node": "n0"})
        else:
            line.waiting.append({"kind": "answer", "id": command["id"], "answer": good(command)})

    line.send = send
    runner = run_with(chain("a", 1), line, tmp_path)
    assert [(command["do"], command.get("force")) for command in line.sent] == [
        ("submit", None),
        ("cancel", True),
        ("submit", None),
    ]
    assert runner.tasks.all["a0"].losses == 1


def test_a_worker_out_of_reach_is_not_waited_for(tmp_path, monkeypatch):
    """It neither works nor obeys: as if its network cable was pulled."""
    monkeypatch.setattr(run, "SILENT", 0.2)
    monkeypatch.setattr(run, "DEAF", 0.3)
    line, first = FakeLink(good), []

    def send(**command: Any) -> None:
        line.sent.append(command)
        if command["do"] == "submit" and not first:
            first.append(command)
            line.waiting.append({"kind": "told", "id": command["id"], "node": "n0"})
        elif command["do"] == "submit":
            line.waiting.append({"kind": "answer", "id": command["id"], "answer": good(command)})

    line.send = send
    runner = run_with(chain("a", 1), line, tmp_path)
    assert [command["do"] for command in line.sent] == ["submit", "cancel", "drop", "submit"]
    assert (runner.tasks.all["a0"].state, runner.tasks.all["a0"].losses) == ("done", 1)


def test_the_time_without_workers_counts_from_when_one_last_worked(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "PATIENCE", 0.5)
    line, begin = FakeLink(good), time.monotonic()
    there, line.nodes = line.nodes, []
    name = "a0"
    course = [
        (0.1, {"kind": "nodes", "nodes": there}),
        *((0.2 + 0.1 * k, {"kind": "told", "id": name, "node": "n0", "stage": "Training"}) for k in range(6)),
        (0.8, {"kind": "nodes", "nodes": []}),
        (0.8, {"kind": "lost", "id": name, "reason": "preempted"}),
        (1.0, {"kind": "nodes", "nodes": there}),
    ]

    def get(timeout: float) -> dict[str, Any] | None:
        if course and time.monotonic() - begin >= course[0][0]:
            return course.pop(0)[1]
        if not course and runner.tasks.running:
            return {"kind": "answer", "id": name, "answer": good({})}
        time.sleep(0.01)
        return {}

    line.send, line.get = (lambda **_: None), get
    runner = Runner(chain("a", 1), line, Options(tmp_path), Reporter(), lambda _: None, lambda _: None)
    runner.run()
    assert runner.tasks.all[name].state == "done"


def test_those_who_watch_hear_of_a_campaign_that_waits_for_its_head(tmp_path, monkeypatch):
    """Who hears nothing for a minute takes it to have stopped."""

    class Away(FakeLink):
        def open_again(self, check: Any) -> dict[str, Any]:
            for _ in range(3):
                runner.watched = 0.0  # seconds later
                check()
            return super().open(check)

    line = Away(good)
    line.waiting.append(None)
    seen: list[int] = []
    watch = lambda progress: seen.append(len(progress.nodes))  # noqa: E731
    runner = Runner(chain("a", 1), line, Options(tmp_path), Reporter(), lambda _: None, watch)
    runner.run()
    assert seen.count(0) == 3
    assert seen[-1] == 1


def test_a_cancel_reaches_the_workers(tmp_path):
    report, line = Reporter(), FakeLink(good)

    def send(**command: Any) -> None:
        line.sent.append(command)
        if command["do"] == "submit":
            report.cancel()
        elif not command["force"]:
            line.waiting.append({"kind": "answer", "id": command["id"], "answer": {"state": "cancelled"}})

    line.send = send
    with pytest.raises(Cancelled):
        run_with(chain("a"), line, tmp_path, report)
    assert [command["do"] for command in line.sent] == ["submit", "cancel"]
    assert line.closed
