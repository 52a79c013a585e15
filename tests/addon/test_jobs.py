"""The queue of jobs, pumped by hand: what the timer does in a window."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

bpy = pytest.importorskip("bpy")

from fieldwork.addon import machine  # noqa: E402
from fieldwork.addon.engine import link  # noqa: E402
from fieldwork.addon.engine.link import Link  # noqa: E402
from fieldwork.addon.errors import EngineError, SceneError  # noqa: E402
from fieldwork.addon.jobs import (  # noqa: E402
    computer,
    gate,
    refresh,
    timer,
)
from fieldwork.addon.jobs.follow import follow, reattach  # noqa: E402
from fieldwork.addon.jobs.job import CURVE_POINTS  # noqa: E402
from fieldwork.addon.jobs.queue import Queue  # noqa: E402
from fieldwork.addon.jobs.timer import tick  # noqa: E402
from fieldwork.addon.project import (  # noqa: E402
    classes,
    edits,
    recent,
    runs,
    snapshot,
)
from fieldwork.nerfcore.engine import status as st  # noqa: E402
from fieldwork.nerfcore.errors import DiskError  # noqa: E402
from fieldwork.tests.addon.support import make_project  # noqa: E402

ENGINE = [sys.executable, str(Path(__file__).resolve().parents[1] / "counting_engine.py")]


@pytest.fixture(autouse=True)
def refreshed(monkeypatch):
    """The jobs whose changes were brought into the scenes, which have no settings here."""
    jobs = []
    monkeypatch.setattr(refresh, "refresh_scenes", jobs.append)
    return jobs


@pytest.fixture
def settings(monkeypatch, tmp_path):
    """Preferences of the test, and an engine that counts."""

    class Settings(machine._Defaults):
        pass

    monkeypatch.setattr(machine, "preferences", lambda: Settings)
    monkeypatch.setattr(machine, "user_folder", lambda *parts: Path(tmp_path, "user", *parts))
    monkeypatch.setattr(machine, "engine_python", lambda: Path(sys.executable))
    monkeypatch.setattr("fieldwork.addon.jobs.queue.open_link", lambda python, log: Link(python, log, ENGINE))
    return Settings


@pytest.fixture
def queue(settings):
    queue = Queue()
    yield queue
    queue.stop_engine(timeout=2.0)


@pytest.fixture
def project(tmp_path):
    folder = tmp_path / "project"
    folder.mkdir()
    (folder / "project.json").write_text('{"format": "fieldwork-project", "version": 1}')
    return folder


def tick_until(queue, condition, timeout=120.0):
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        tick(queue)
        time.sleep(0.02)


def count(queue, project, **params):
    return queue.make("count", {"project": str(project), **params})


def test_jobs_run_one_after_the_other(queue, project):
    order = []
    first, second = (
        queue.make("count", {"project": str(project), "steps": 20}, lambda job: order.append(job)) for _ in range(2)
    )
    queue.submit(first)
    queue.submit(second)
    assert (first.state, second.state) == ("running", "queued")
    tick_until(queue, lambda: second.state == "done")
    assert order == [first, second]
    assert first.result == {"steps": 20, "project": str(project)}
    assert [step for step, _, _ in first.curve] == [0, 10]
    assert queue.current is None
    assert queue.last is second


def test_a_job_ends_with_its_engine_though_another_is_asked_at_once(queue, project, monkeypatch):
    read = link._read

    class Late:
        def __init__(self, messages):
            self.messages = messages

        def put(self, message):
            if message is None:
                time.sleep(0.3)  # a thread that is not run at once
            self.messages.put(message)

    monkeypatch.setattr(link, "_read", lambda stream, messages: read(stream, Late(messages)))
    job = count(queue, project, steps=100_000)
    queue.submit(job)
    tick_until(queue, lambda: job.curve)
    queue.link.process.kill()
    queue.link.process.wait()
    queue.ask("ping", {})
    assert (job.state, job.error.kind) == ("failed", "died")
    assert queue.running is None


def test_neither_starting_nor_watching_a_job_blocks(queue, project):
    begin, busy_since = time.perf_counter(), time.thread_time()
    queue.submit(count(queue, project, steps=60))
    seconds, busy = time.perf_counter() - begin, time.thread_time() - busy_since
    tick_until(queue, lambda: queue.last is not None)
    assert max(busy, queue.slowest_cpu) < 0.1
    # Where other programs want more processors than there are, waiting for one is not Fieldwork's doing.
    if os.getloadavg()[0] <= (os.cpu_count() or 1):
        assert max(seconds, queue.slowest_tick) < 0.1


def test_cancel_running_and_waiting_jobs(queue, project):
    running, waiting = count(queue, project, steps=100_000), count(queue, project)
    queue.submit(running)
    queue.submit(waiting)
    tick_until(queue, lambda: running.fraction)
    queue.cancel(waiting)
    assert waiting.state == "cancelled"
    begin = time.monotonic()
    queue.cancel()
    assert running.state == "cancelling"
    tick_until(queue, lambda: running.state == "cancelled")
    assert time.monotonic() - begin < 2.0


def test_killed_engine_fails_the_job_and_the_next_one_gets_a_new_engine(queue, project):
    job = count(queue, project, steps=100_000)
    queue.submit(job)
    tick_until(queue, lambda: job.fraction)
    queue.link.process.kill()
    tick_until(queue, lambda: job.state == "failed")
    assert job.error.kind == "died"
    report = job.report()
    assert "stopped unexpectedly" in report
    assert str(project) in report
    again = count(queue, project, steps=2)
    queue.submit(again)
    tick_until(queue, lambda: again.state == "done")


def test_missing_engine_is_told(queue, project, monkeypatch):
    monkeypatch.setattr(machine, "engine_python", lambda: None)
    job = count(queue, project)
    queue.submit(job)
    assert job.state == "failed"
    assert job.error.kind == "missing"
    with pytest.raises(EngineError, match="not installed"):
        queue.run(count(queue, project))


def test_reattach_follows_a_detached_job_to_its_end(queue, settings, project, refreshed):
    job = count(queue, project, steps=150)
    queue.submit(job)
    tick_until(queue, lambda: job.fraction)
    queue.stop_engine(detach=True)
    assert queue.link is None

    # Another Blender opens the project.
    other = Queue()
    reattach(other, project)
    assert other.followed is not None
    assert other.followed.state == "running"
    followed = other.followed
    tick_until(other, lambda: followed.state == "done")
    assert followed.result["steps"] == 150
    assert [step for step, _, _ in followed.curve] == list(range(0, 150, 10))
    assert refreshed == [followed], "the lists show what it did"


def test_followed_job_can_be_cancelled(queue, settings, project):
    settings.on_close = "continue"
    queue.submit(count(queue, project, steps=100_000))
    tick_until(queue, lambda: queue.running.fraction)
    queue.stop_engine(detach=True)
    other = Queue()
    reattach(other, project)
    followed = other.followed
    begin = time.monotonic()
    other.cancel()
    tick_until(other, lambda: followed.state == "cancelled")
    assert time.monotonic() - begin < 3.0


def test_reattach_tells_of_a_job_whose_engine_died(queue, project):
    queue.submit(count(queue, project, steps=100_000))
    tick_until(queue, lambda: queue.running.fraction)
    time.sleep(0.7)
    queue.link.process.kill()
    queue.link.process.wait()
    other = Queue()
    reattach(other, project)
    assert other.last.state == "failed"
    assert "unexpectedly" in other.last.error.message
    reattach(other, project)
    assert len(other.finished) == 1, "it is told once"


def test_an_edit_is_taken_while_a_job_runs(queue, tmp_path):
    project = make_project(tmp_path / "edited")
    edits.clear()
    job = count(queue, project, steps=100_000)
    queue.submit(job)
    tick_until(queue, lambda: job.fraction)
    classes._put(project, {(1, "priority"): 4.0})
    tick_until(queue, lambda: not edits.waiting())
    assert job.state == "running"
    assert snapshot.project(project)["classes"][0]["priority"] == 4.0
    assert snapshot.project(project)["classes"][1]["name"] == "gold"
    queue.cancel()
    tick_until(queue, lambda: job.state == "cancelled")


def test_an_edit_of_the_last_moment_is_taken_after_blender_is_gone(queue, tmp_path):
    project = make_project(tmp_path / "edited")
    edits.clear()
    classes._put(project, {(1, "priority"): 4.0})
    edits.send(queue.ask, at_once=True)
    process = queue.link.process
    edits.clear()
    queue.stop_engine()
    process.wait(timeout=60)
    assert snapshot.project(project)["classes"][0]["priority"] == 4.0


def test_what_is_known_of_this_machine_needs_no_room_on_the_disk(settings, tmp_path, project):
    computer.remember({"device": "cpu"})
    assert computer.known() == {"device": "cpu"}
    recent.remember(project)
    assert recent.recent() == [project]
    (tmp_path / "user" / recent.FILE).unlink()
    (tmp_path / "user" / computer.FILE).unlink()
    (tmp_path / "user").rmdir()
    (tmp_path / "user").touch()  # no file can be written in it
    computer.remember({"device": "cpu"})
    recent.remember(project)
    runs.remember_time("draft", 1.0)


def test_idle_engine_is_released(queue, settings, project):
    queue.submit(count(queue, project, steps=1))
    tick_until(queue, lambda: queue.last is not None)
    process = queue.link.process
    queue.link.last_used -= 60 * settings.idle_minutes + 1
    tick(queue)
    assert queue.link is None
    assert process.wait(timeout=10) == 0


def test_curve_stays_bounded_and_keeps_its_ends(queue, project):
    job = count(queue, project)
    for step in range(5 * CURVE_POINTS):
        job.take("event", {"kind": "train", "step": step, "loss": 1.0, "psnr": None})
    assert len(job.curve) <= CURVE_POINTS
    assert (job.curve[0][0], job.curve[-1][0]) == (0, 5 * CURVE_POINTS - 1)
    steps = [step for step, _, _ in job.curve]
    assert steps == sorted(steps)


def test_job_file_of_another_project_is_left_alone(queue, project, tmp_path):
    st.write_job(project, st.JobStatus("x", "count", {}, state="done"))
    reattach(queue, project)
    assert queue.current is None
    assert queue.last is None


@pytest.mark.parametrize(("choice", "state"), [("continue", "done"), ("stop", "cancelled")])
def test_what_becomes_of_a_job_when_blender_crashes_is_the_users_choice(queue, settings, project, choice, state):
    settings.on_close = choice
    job = count(queue, project, steps=100)
    queue.submit(job)
    tick_until(queue, lambda: job.fraction)
    # What the operating system does with the pipes of a process that is gone.
    queue.link.process.stdin.close()
    queue.link.process.wait(timeout=20)
    assert st.read_job(st.job_path(project, job.id)).state == state


def test_what_waits_goes_on_without_blender_too(queue, project):
    queue.submit(count(queue, project, steps=60))
    waiting = [count(queue, project, steps=4), count(queue, project, steps=5)]
    for job in waiting:
        queue.submit(job)
    tick_until(queue, lambda: queue.running.fraction)
    queue.stop_engine(detach=True)
    assert queue.waiting == []
    other = Queue()
    reattach(other, project)
    tick_until(other, lambda: len(other.finished) == 3 or (other.followed is None and other.finished))
    end = time.monotonic() + 20
    while (
        st.read_job(st.job_path(project, waiting[-1].id)) is None
        or not st.read_job(st.job_path(project, waiting[-1].id)).finished
    ):
        assert time.monotonic() < end, "the last job did not run"
        time.sleep(0.1)
    last = st.read_job(st.job_path(project, waiting[-1].id))
    assert (last.state, last.result["steps"]) == ("done", 5)


def test_jobs_that_follow_each_other_elsewhere_are_followed_to_the_last(queue, project, refreshed):
    def write(name, state, **more):
        job = st.JobStatus(name, "count", {}, state=state, pid=os.getpid(), **more)
        st.write_job(project, job)

    def look():
        if queue.followed:
            queue.followed.looked = 0.0
        follow(queue)

    write("a", "running", created=1.0)
    write("b", "queued", created=2.0)
    write("c", "queued", created=3.0)
    reattach(queue, project)
    assert queue.followed.id == "a"
    write("a", "failed", created=1.0, error={"code": "input", "message": "No photos."})
    look()
    assert (queue.followed.id, queue.followed.state) == ("b", "queued")
    write("b", "running", created=2.0)
    look()
    assert queue.followed.state == "running"
    st.job_path(project, "b").unlink()  # it has ended, and the next one of its kind begins
    look()
    assert queue.followed.id == "c"
    write("c", "done", created=3.0)
    look()
    assert queue.followed is None
    assert [(job.id, job.state) for job in queue.finished] == [("a", "failed"), ("c", "done")]


def test_messages_stay_until_read_or_made_good(queue, project, tmp_path):
    def ended(verb, state, folder=project, warnings=()):
        job = queue.make(verb, {"project": str(folder)})
        job.state, job.warnings = state, list(warnings)
        queue.remember(job)
        return job

    assert queue.outcome is None
    failed = ended("poses", "failed")
    ended("mesh", "done")
    assert queue.outcome is failed, "another job does not hide it"
    ended("poses", "done", tmp_path / "other")
    assert queue.outcome is failed
    ended("poses", "done")
    assert queue.outcome is None, "it went well the second time"
    warned = ended("new", "done", warnings=["2 photos are blurred."])
    assert queue.outcome is warned
    warned.dismissed = True
    assert queue.outcome is None
    ended("new", "cancelled")
    assert queue.outcome is None


def test_what_a_job_needs_of_the_scene_is_done_in_slices_and_at_once(queue, project):
    """Before its turn: the scene may look otherwise by then."""
    done = []

    def steps():
        for number in range(30):
            end = time.perf_counter() + 0.005
            while time.perf_counter() < end:
                pass
            done.append(number)
            yield number / 30, "frame"

    first, second = count(queue, project, steps=100_000), queue.make("count", {"project": str(project)}, before=steps())
    queue.submit(first)
    queue.submit(second)
    assert done == []
    tick_until(queue, lambda: second.before is None)
    assert len(done) == 30
    assert (first.state, second.state) == ("running", "queued")
    assert queue.slowest_cpu < 0.1
    queue.cancel()
    tick_until(queue, lambda: second.state == "done")

    def fails():
        yield 0.0, ""
        raise ReferenceError("the scene is gone")

    third = queue.make("count", {"project": str(project)}, before=fails())
    queue.submit(third)
    tick_until(queue, lambda: third.state == "failed")
    assert "the scene is gone" in third.error.message


def test_why_a_scene_cannot_be_read_is_told_as_it_is(queue, project):
    def fails(error):
        yield 0.0, ""
        raise error

    reasons = {
        "The lens is dirty.": SceneError("The lens is dirty."),
        "No room. Make some.": DiskError("No room.", "Make some."),
    }
    for text, error in reasons.items():
        job = queue.make("count", {"project": str(project)}, before=fails(error))
        queue.submit(job)
        tick_until(queue, lambda job=job: job.state == "failed")
        assert str(job.error) == text
        blocking = queue.make("count", {"project": str(project)}, before=fails(error))
        with pytest.raises(EngineError, match=text):
            queue.run(blocking)
        assert (blocking.state, queue.running) == ("failed", None)


def test_what_fails_in_blender_reaches_the_panel_and_stops_nothing_else(queue, project, monkeypatch):
    def broken(ask):
        raise ZeroDivisionError("the edits are broken")

    monkeypatch.setattr(edits, "send", broken)
    job = count(queue, project, steps=2)
    queue.submit(job)
    tick_until(queue, lambda: job.state == "done")
    told = queue.outcome
    assert told is not None
    assert "the edits are broken" in told.error.message
    assert "test_jobs.py" in told.report(), "the report holds the place"
    assert sum(other.verb == "timer" for other in queue.finished) == 1, "once, not at every tick"


def test_a_job_whose_result_cannot_be_taken_fails_and_is_not_lost(queue, project):
    def broken(job):
        raise KeyError("files")

    job, after = queue.make("count", {"project": str(project), "steps": 2}, broken), count(queue, project, steps=2)
    queue.submit(job)
    queue.submit(after)
    tick_until(queue, lambda: after.state == "done")
    assert job.state == "failed"
    assert "files" in job.error.message
    assert "test_jobs.py" in job.report()
    assert [job, after] == queue.finished


def test_results_come_into_the_scene_one_after_the_other(queue, project):
    order = []

    def slowly(job):
        for _ in range(3):
            order.append(job.id)
            time.sleep(0.02)
            yield 0.5, ""

    jobs = [queue.make("count", {"project": str(project)}, slowly) for _ in range(3)]
    for job in jobs:
        queue.finish(job, {}, None)
    tick_until(queue, lambda: queue.current is None)
    assert order == [job.id for job in jobs for _ in range(3)]
    assert [job.state for job in jobs] == ["done"] * 3


def test_what_a_job_needs_of_the_scene_waits_until_it_may_be_read(queue, project, monkeypatch):
    closed = ["Waits for Object Mode"]
    monkeypatch.setattr(gate, "closed", lambda: closed[0] if closed else None)
    done = []

    def steps():
        done.append("read")
        yield 0.5, "frame"

    job = queue.make("count", {"project": str(project), "steps": 1}, before=steps())
    queue.submit(job)
    for _ in range(3):
        tick(queue)
    assert done == []
    assert (job.state, job.message) == ("queued", "Waits for Object Mode")
    closed.clear()
    tick_until(queue, lambda: job.state == "done")
    assert done == ["read"]


def test_the_region_is_followed_only_when_nobody_works_on_the_scene(monkeypatch):
    closed, followed = ["Waits for Object Mode"], []
    stub = SimpleNamespace(app=SimpleNamespace(background=False), context=SimpleNamespace(scene="scene"))
    monkeypatch.setattr(timer, "bpy", stub)
    monkeypatch.setattr(timer.region, "follow", followed.append)
    monkeypatch.setattr(gate, "closed", lambda: closed[0] if closed else None)
    timer._follow_region()
    assert followed == []
    closed.clear()
    timer._follow_region()
    assert followed == ["scene"]


def test_what_fails_after_an_undo_reaches_the_panel(queue, monkeypatch):
    """Of what handlers raise only a terminal would hear."""

    def broken(settings):
        raise ZeroDivisionError("the lists are broken")

    scenes = [SimpleNamespace(fieldwork=None)]
    monkeypatch.setattr(timer, "bpy", SimpleNamespace(data=SimpleNamespace(scenes=scenes)))
    monkeypatch.setattr(timer, "queue", queue)
    monkeypatch.setattr(timer.lists, "undone", broken)
    timer._undone()
    assert "the lists are broken" in queue.outcome.error.message
