"""Edits on their way to the engine: kept until it has taken them, whatever happens to it."""

from __future__ import annotations

import json
import os
from types import SimpleNamespace

import pytest

pytest.importorskip("bpy")

from fieldwork.addon.errors import EngineError
from fieldwork.addon.project import classes, edits, snapshot
from fieldwork.tests.addon.support import make_project


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    """A clock that the test turns."""
    now = SimpleNamespace(seconds=1000.0)
    monkeypatch.setattr(edits.time, "monotonic", lambda: now.seconds)
    edits.clear()
    yield now
    edits.clear()


@pytest.fixture
def project(tmp_path):
    return make_project(tmp_path / "capture")


class Engine:
    """Takes requests, and answers when it is told to."""

    def __init__(self):
        self.requests = []

    def ask(self, verb, params, on_done):
        self.requests.append((verb, params, on_done))

    def answer(self, error=None, number=-1):
        _, params, on_done = self.requests[number]
        if error is None:
            path = edits.Path(params["project"]) / "project.json"
            value = {**json.loads(path.read_text()), "classes": params["classes"]}
            path.with_name("part").write_text(json.dumps(value))
            os.replace(path.with_name("part"), path)
        on_done(None if error else {}, error)


def put(project, priority):
    classes._put(project, {(1, "priority"): priority})


def priorities(project):
    return [value["priority"] for value in classes.shown(project)]


def test_many_changes_are_one_edit_and_stand_over_the_file_until_answered(project):
    engine = Engine()
    for priority in (2.0, 3.0, 4.0):
        put(project, priority)
    edits.send(engine.ask)
    edits.send(engine.ask)
    assert len(engine.requests) == 1
    verb, params, _ = engine.requests[0]
    assert verb == "classes"
    assert params["project"] == str(project)
    assert [value["priority"] for value in params["classes"]] == [4.0, 2.0]
    assert priorities(project) == [4.0, 2.0]
    assert snapshot.project(project)["classes"][0]["priority"] == 1.0
    engine.answer()
    assert not edits.waiting()
    assert priorities(project) == [4.0, 2.0]


def test_an_edit_made_while_one_is_under_way_follows_it(project):
    engine = Engine()
    put(project, 2.0)
    edits.send(engine.ask)
    put(project, 5.0)
    edits.send(engine.ask)
    assert len(engine.requests) == 1, "one after the other"
    engine.answer()
    assert priorities(project) == [5.0, 2.0], "the panel does not jump back"
    edits.send(engine.ask)
    engine.answer()
    assert not edits.waiting()
    assert snapshot.project(project)["classes"][0]["priority"] == 5.0


def test_what_cannot_be_taken_is_told_kept_and_sent_again(project, clock):
    def missing(verb, params, on_done):
        raise EngineError("missing", "The engine is not installed.")

    put(project, 2.0)
    edits.send(missing)
    assert "not installed" in str(edits.failed()[0].error)
    assert priorities(project) == [2.0, 2.0]
    engine = Engine()
    edits.send(engine.ask)
    assert engine.requests == [], "not at every tick"
    clock.seconds += edits.RETRY
    edits.send(engine.ask)
    engine.answer(EngineError("died", "The engine stopped unexpectedly."))
    assert "unexpectedly" in str(edits.failed()[0].error)
    edits.send(engine.ask, at_once=True)
    engine.answer()
    assert not edits.waiting()
    assert edits.failed() == []
    assert snapshot.project(project)["classes"][0]["priority"] == 2.0


def test_what_the_engine_refuses_waits_for_the_user(project, clock):
    engine = Engine()
    put(project, 2.0)
    edits.send(engine.ask)
    engine.answer(EngineError("setting", "Two classes are called “gold”."))
    clock.seconds += 100 * edits.RETRY
    edits.send(engine.ask)
    assert len(engine.requests) == 1
    assert edits.failed()
    put(project, 3.0)
    edits.send(engine.ask)
    engine.answer()
    assert not edits.waiting()


def test_an_edit_that_is_never_answered_is_sent_again(project, clock):
    """The engine was stopped with the request in its pipe."""
    engine = Engine()
    put(project, 2.0)
    edits.send(engine.ask)
    clock.seconds += edits.RETRY
    edits.send(engine.ask)
    assert len(engine.requests) == 2
    engine.answer()
    assert not edits.waiting()


def test_an_unplugged_project_keeps_its_edit(project, clock):
    engine = Engine()
    put(project, 2.0)
    away = project.with_name("away")
    project.rename(away)
    edits.send(engine.ask)
    assert engine.requests == []
    assert str(project) in str(edits.failed()[0].error)
    edits.move(project, away)
    edits.send(engine.ask)
    engine.answer()
    assert snapshot.project(away)["classes"][0]["priority"] == 2.0


def test_a_class_that_a_job_adds_meanwhile_stays(project):
    engine = Engine()
    put(project, 2.0)
    value = json.loads((project / "project.json").read_text())
    value["classes"].append({"id": 3, "name": "wood", "color": [0.4, 0.2, 0.1], "priority": 1.0})
    (project / "project.json").write_text(json.dumps(value))
    edits.send(engine.ask)
    assert [value["name"] for value in engine.requests[0][1]["classes"]] == ["stone", "gold", "wood"]


def test_discarded_edits_are_forgotten_but_not_those_under_way(project):
    engine = Engine()
    put(project, 2.0)
    edits.send(engine.ask)
    edits.discard()
    assert edits.waiting()
    engine.answer(EngineError("input", "A class needs a name."))
    edits.discard()
    assert not edits.waiting()
    assert priorities(project) == [1.0, 2.0]
