"""What a campaign on a cluster decides, without one: order of tasks, room, estimates, status, refusals."""

from __future__ import annotations

import importlib.util
import json
import re
import time
from pathlib import Path
from typing import Any

import pytest
from fieldwork.nerfcore import __version__, cli
from fieldwork.nerfcore.cluster import link, run, worker
from fieldwork.nerfcore.cluster import status as st
from fieldwork.nerfcore.cluster.estimate import Durations, finish_times, remaining
from fieldwork.nerfcore.cluster.link import Link
from fieldwork.nerfcore.cluster.run import Options, Runner, limited
from fieldwork.nerfcore.cluster.tasks import Need, Task, Tasks
from fieldwork.nerfcore.console import ConsoleReporter, campaign_table
from fieldwork.nerfcore.errors import Cancelled, InputError, PosesError, SettingError
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.workflows.campaign import plan
from fieldwork.nerfcore.workflows.captures import read_list
from PIL import Image
from rich.console import Console


def chain(group: str, stages: int = 3, priority: int = 0, need: Need | None = None) -> list[Task]:
    return [
        Task(
            f"{group}{i}",
            group,
            f"stage{i}",
            "m:f",
            {},
            needs=(f"{group}{i - 1}",) if i else (),
            priority=priority,
            need=need or Need(),
        )
        for i in range(stages)
    ]


def order(tasks: Tasks, fail: str = "") -> list[str]:
    """The tasks in the order in which one worker gets them."""
    taken = []
    while (task := tasks.take(0.0, lambda _: True)) is not None:
        taken.append(task.id)
        tasks.fail(task, {}) if task.id == fail else tasks.finish(task, {})
    return taken


def test_a_capture_that_was_begun_is_brought_to_its_end_first():
    tasks = Tasks([*chain("a"), *chain("b"), *chain("c", priority=2)])
    assert order(tasks) == ["c0", "c1", "c2", "a0", "a1", "a2", "b0", "b1", "b2"]
    assert tasks.finished


def test_what_depends_on_a_failure_is_left_out_and_nothing_else():
    tasks = Tasks([*chain("a"), *chain("b")])
    assert order(tasks, fail="a1") == ["a0", "a1", "b0", "b1", "b2"]
    assert [tasks.all[f"a{i}"].state for i in range(3)] == ["done", "failed", "left out"]
    assert tasks.finished


def test_a_task_that_waits_for_room_is_not_overtaken_for_ever():
    tasks = Tasks([*chain("big", 1, need=Need(cores=2)), *chain("small", 1)])
    assert tasks.take(0.0, lambda task: task.need.cores <= 1) is None
    assert tasks.take(0.0, lambda task: task.need.cores <= 2).id == "big0"


def test_a_task_that_was_put_back_waits_its_time():
    tasks = Tasks(chain("a", 1))
    task = tasks.take(0.0, lambda _: True)
    tasks.put_back(task, not_before=5.0)
    assert tasks.take(4.0, lambda _: True) is None
    assert tasks.take(6.0, lambda _: True) is task


def test_no_more_is_asked_for_than_a_worker_has():
    def node(cores: float, memory: float, gpus: float = 0.0) -> dict[str, Any]:
        return {"cores": cores, "memory_gb": memory, "gpus": gpus}

    small, large, gpu = node(1, 4), node(8, 32), node(4, 16, 1)
    assert limited(Need(2, 3), [small]) == Need(1, 3)
    assert limited(Need(2, 30), [small, large]) == Need(2, 30)
    assert limited(Need(2, 100), [small, large]) == Need(2, 0.95 * 32)
    assert limited(Need(2, 8, 0.5), [small, large]) == Need(2, 8, 0)
    assert limited(Need(8, 8, 0.5), [large, gpu]) == Need(4, 8, 0.5)


def test_estimates_follow_what_was_measured_and_the_cores_there_are():
    durations = Durations({"stage0": [4.0, 2.0, 3.0]})
    durations.add("stage1", 10.0)
    tasks = chain("a", 2) + chain("b", 2)
    one, two = (finish_times(tasks, cores, lambda t: durations.of(t.stage)) for cores in (1, 2))
    assert one == {"a0": 3.0, "a1": 13.0, "b0": 16.0, "b1": 26.0}
    assert max(two.values()) == 13.0
    wide = finish_times([*chain("a", 1, need=Need(cores=2)), *chain("b", 1)], 2, lambda _: 1.0, overhead=0.5)
    assert wide == {"a0": 1.5, "b0": 3.0}
    tasks[0].state = "done"
    assert max(finish_times(tasks, 1, lambda t: durations.of(t.stage)).values()) == 23.0
    running = tasks[1]
    running.state, running.begun, running.fraction = "running", 100.0, 0.5
    assert remaining(running, durations, 106.0) == pytest.approx(6.0)


def test_two_thousand_captures_are_planned_in_five_seconds(tmp_path):
    path = tmp_path / "list.csv"
    path.write_text("photos,preset\n" + "".join(f"c{i}/photos,standard\n" for i in range(2000)))
    begin = time.monotonic()
    captures = read_list(path)
    tasks = plan(captures, tmp_path)
    finish_times(Tasks(tasks).all.values(), 64, lambda task: 1.0)
    seconds = time.monotonic() - begin
    print(f"2000 captures, {len(tasks)} tasks: {seconds:.2f} s")
    assert len(tasks) == 12_000
    assert seconds < 5.0


def test_memory_and_shares_of_a_gpu_follow_the_plan_of_the_run(tmp_path):
    path = tmp_path / "list.csv"
    path.write_text(
        "photos,preset,set\na,draft,field.table_log2=14\nb,high,field.table_log2=22\nc,high,field.table_log2=24\n"
    )
    needs = [{task.stage: task.need for task in plan([c], tmp_path)} for c in read_list(path)]
    shares = [need["train"].gpu for need in needs]
    assert shares == sorted(shares)
    assert shares[0] < 1.0 == shares[-1]
    assert [need["poses"].gpu for need in needs] == [0.0] * 3
    assert needs[0]["train"].memory_gb < needs[1]["train"].memory_gb < needs[2]["train"].memory_gb


# What a worker does.


def said(values: dict[str, Any], report: Reporter) -> dict[str, Any]:
    report.stage("Speaking")
    report.warn("A word.")
    if values.get("fails"):
        raise PosesError("No poses.", "Take more photos.")
    if values.get("odd"):
        raise KeyError("odd")
    while values.get("long"):
        report.check()
        time.sleep(0.01)
    return {"said": values["what"]}


def ask(place: Path, /, **changes: Any) -> dict[str, Any]:
    job = {
        "function": f"{__name__}:said",
        "values": {"what": "ä"},
        "version": __version__,
        "folder": str(place),
        "cores": 1,
        "keep_free_gb": 0.0,
        **changes,
    }
    return json.loads(worker.execute(json.dumps(job), lambda _: None))


def test_a_worker_answers_in_json(tmp_path):
    answer = ask(tmp_path)
    assert (answer["state"], answer["result"], answer["warnings"]) == ("done", {"said": "ä"}, ["A word."])
    assert answer["free_gb"] > 0
    failed = ask(tmp_path, values={"fails": True})
    assert (failed["state"], failed["error"]) == (
        "failed",
        {"code": "poses", "message": "No poses.", "hint": "Take more photos."},
    )
    assert ask(tmp_path, values={"odd": True})["error"]["code"] == "internal"


@pytest.mark.parametrize(
    ("changes", "state", "words"),
    [
        ({"version": "9.9"}, "refused", f"has Fieldwork {__version__}, this campaign 9.9"),
        ({"folder": "/not/here"}, "refused", "does not have the folder /not/here"),
        ({"keep_free_gb": 1e9}, "full", "GB free"),
    ],
)
def test_a_worker_refuses_what_it_cannot_do(tmp_path, changes, state, words):
    answer = ask(tmp_path, **changes)
    assert answer["state"] == state
    assert words in answer["error"]["message"]
    assert answer["error"]["hint"]


def test_an_interrupt_ends_the_work_of_a_worker(tmp_path):
    import _thread
    import threading

    threading.Timer(0.5, _thread.interrupt_main).start()
    begin = time.monotonic()
    assert ask(tmp_path, values={"long": True})["state"] == "cancelled"
    assert time.monotonic() - begin < 3.0


# What the campaign does with answers, on a line that is made up.


class FakeLink:
    """Answers every task by a function of its job; None loses the worker."""

    def __init__(self, answer: Any, nodes: int = 1) -> None:
        self.answer, self.told, self.closed = answer, [], False
        self.nodes = [
            {"id": f"n{i}", "host": f"h{i}", "cores": 1.0, "memory_gb": 64.0, "gpus": 0.0} for i in range(nodes)
        ]
        self.messages: Any = self
        self.waiting: list[dict[str, Any] | None] = []
        self.sent: list[dict[str, Any]] = []

    def open(self, check: Any) -> dict[str, Any]:
        return {"nodes": self.nodes}

    open_again = open

    def send(self, **command: Any) -> None:
        self.sent.append(command)
        if command["do"] == "submit":
            found = self.answer(command)
            if found is not None:
                self.waiting.append({"kind": "answer", "id": command["id"], "answer": found})
            else:
                self.waiting.append({"kind": "lost", "id": command["id"], "reason": "gone"})

    def get(self, timeout: float) -> dict[str, Any] | None:
        return self.waiting.pop(0) if self.waiting else {}

    def empty(self) -> bool:
        return not self.waiting

    def close(self) -> None:
        self.closed = True


def good(command: dict[str, Any]) -> dict[str, Any]:
    return {"state": "done", "result": {}, "seconds": 1.0, "warnings": [], "node": "n0"}


def bad(code: str) -> dict[str, Any]:
    error = {"code": code, "message": f"{code}!", "hint": "Mend it."}
    return {"state": "failed", "error": error, "seconds": 1.0, "warnings": [], "node": "n0"}


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


# What is told.


def test_without_the_extra_it_is_said_how_to_install_it(tmp_path, monkeypatch, capfd):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "ray" else find(name, *rest))
    path = tmp_path / "list.csv"
    path.write_text("photos\na\n")
    assert cli.main(["batch", str(path), "--cluster", "auto", "--json"]) == 1
    error = json.loads(capfd.readouterr().out)["error"]
    assert error["code"] == "setting"
    assert 'pip install "fieldwork[cluster]"' in error["hint"]


@pytest.mark.parametrize("address", ["", "local", "http://x:1", "head", "head:port", "ray://", "a b:1"])
def test_only_addresses_are_taken(address, monkeypatch):
    monkeypatch.setattr(link, "require_ray", lambda: None)
    with pytest.raises(SettingError, match="no address of a cluster"):
        Link(address)
    for fine in ("auto", "head:6379", "10.0.0.1:6379", "ray://head.lan:10001", "[::1]:6379"):
        Link(fine)


def test_a_wheel_that_is_none_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(link, "require_ray", lambda: None)
    (tmp_path / "a.whl").write_text("no archive")
    for wheel in (tmp_path / "a.whl", tmp_path / "none.whl", tmp_path):
        with pytest.raises(InputError, match="is no wheel"):
            Link("auto", wheel)


def rows() -> list[dict[str, Any]]:
    return [
        st.capture_row("/c/done <1>", "done", fraction=1.0, figures={"held out (dB)": "24.1"}),
        st.capture_row("/c/wait", "waiting", stage="new"),
        st.capture_row("/c/bad", "failed", error="No poses <b>at all</b>.", hint="Take more."),
        st.capture_row("/c/run", "running", stage="train", fraction=0.4, eta_s=75.0),
    ]


def test_the_page_tells_of_failures_first_and_shows_pictures(tmp_path):
    project = tmp_path / "vase"
    (project / "exports/main/renders").mkdir(parents=True)
    Image.new("RGB", (800, 600), (200, 30, 30)).save(project / "exports/main/renders/orbit_0000.png")
    Image.new("RGB", (800, 600), (0, 0, 0)).save(project / "exports/main/renders/orbit_0000_depth.png")
    folder = tmp_path / "list-campaign"
    picture = st.add_picture(folder, project, 3)
    with Image.open(folder / picture) as small:
        assert small.size == (320, 240)
        assert abs(small.getpixel((100, 100))[0] - 200) < 8
    made = rows()
    made[0]["picture"] = picture
    value = st.status("list", "running", 0.0, made, [{"cores": 4.0}], 130.0)
    st.write_status(folder, value, page=True)
    assert json.loads((folder / st.STATUS_FILE).read_text())["counts"] == {
        "failed": 1,
        "running": 1,
        "waiting": 1,
        "done": 1,
    }
    page = (folder / st.PAGE).read_text()
    places = [page.index(f"{name}</a>") for name in ("bad", "run", "wait", "done &lt;1&gt;")]
    assert places == sorted(places)
    assert "No poses &lt;b&gt;at all&lt;/b&gt;." in page
    assert f'src="{picture}"' in page
    assert "24.1" in page
    assert "about 2 min left" in re.sub(r"\s+", " ", page)
    assert st.add_picture(folder, tmp_path / "nothing", 4) == ""


def test_the_table_in_the_terminal():
    value = st.status("list", "running", 0.0, rows(), [{"cores": 4.0}], 6000.0)
    console = Console(width=110, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(campaign_table(value))
    lines = console.export_text().splitlines()
    title = " ".join(line.strip() for line in lines[: next(i for i, line in enumerate(lines) if "┏" in line)])
    assert "1 done, 1 failed, 1 running, 1 waiting, 1 worker, about 1.7 h left" in title
    assert next(i for i, line in enumerate(lines) if "bad" in line) < next(
        i for i, line in enumerate(lines) if "run " in line
    )
    assert any("train" in line and "40%" in line and "75 s" in line for line in lines)


def test_without_a_terminal_there_are_no_tables(capfd):
    with ConsoleReporter(quiet=False) as report:
        report.event("campaign", **st.status("list", "running", 0.0, rows(), [], None))
    assert capfd.readouterr().err == ""


def test_growth_is_drawn_from_measured_times(tmp_path):
    from fieldwork.nerfcore.cluster import growth

    report = tmp_path / "list-report.json"
    entries = {
        "a": {"state": "done", "stages": {"new": 1.0, "train": 9.0, "render": 0.0}},
        "b": {"state": "failed", "error": "", "hint": ""},
    }
    report.write_text(json.dumps({"captures": entries}))
    chains = growth.measured(report)
    assert chains == [{"new": 1.0, "train": 9.0}]
    assert growth.makespan(chains, 4, 1, 0.0) == 40.0
    assert growth.makespan(chains, 4, 2, 0.5) == 22.0
    assert growth.makespan(chains, 4, 64, 0.0) == 10.0
    growth.main([str(report), str(tmp_path / "growth.png"), "--captures", "4", "8"])
    with Image.open(tmp_path / "growth.png") as picture:
        assert len(picture.convert("RGB").getcolors(1 << 20)) > 20
    report.write_text("{}")
    with pytest.raises(Exception, match="no report of a batch"):
        growth.measured(report)
