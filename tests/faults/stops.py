"""SIGKILL, SIGINT and cancels at random moments of every stage: nothing is lost, the lock is free, cancels are prompt."""

from __future__ import annotations

import random
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from fieldwork.nerfcore.project.store import is_project
from fieldwork.tests.nerfcore.support.ball import SMALL
from hypothesis import strategies as st

from .draw import drawn
from .engine import command
from .outcome import Case, Outcome, outcome
from .scene import STEPS, Scene, content, held, lost

# Seconds that a command takes where nothing else runs, until Python itself is there, and until libraries are loaded.
PYTHON, LIBRARIES = 0.15, 3.3
MORE = 60  # steps of training
KILLS, CANCELS = "killed (SIGKILL)", "cancelled (SIGINT, requests)"


class Stage(NamedTuple):
    """A verb at work on `made`, a fresh copy of what it needs. `seconds` it takes, the start of a process not counted."""

    verb: str
    seconds: float
    made: Callable[[Scene], dict[str, Any]]


def _new(scene: Scene) -> dict[str, Any]:
    return {"project": scene.empty("new"), "photos": scene.copy(scene.photos)}


def _posing(scene: Scene) -> dict[str, Any]:
    project = scene.empty("walls")
    reply = scene.engine.ask("new", project=project, photos=scene.wall)
    assert not reply.code, reply.message
    return {"project": project, "preset": "fast"}


def _training(scene: Scene, resume: bool = False) -> dict[str, Any]:
    project = scene.copy(scene.trained)
    return {
        "project": project,
        "preset": "draft",
        "steps": STEPS + MORE if resume else MORE,
        "set": SMALL,
        "resume": resume,
    }


STAGES = {
    "new": Stage("new", 0.6, _new),
    "poses": Stage("poses", 6.0, _posing),
    "train": Stage("train", 4.0, _training),
    "train again": Stage("train", 4.0, lambda scene: _training(scene, resume=True)),
    "mesh": Stage("mesh", 3.0, lambda scene: {"project": scene.copy(scene.trained), "resolution": 48}),
    "render": Stage(
        "render",
        3.0,
        lambda s: {"project": s.copy(s.trained), "orbit": 40, "size": (64, 48), "out": s.empty("renders")},
    ),
}
STOPPED = st.tuples(st.sampled_from(sorted(STAGES)), st.floats(0, 1.15))


def options(values: dict[str, Any]) -> list[str]:
    """Parameters of a verb as the command line takes them."""
    words = [str(values["project"])]
    for name, value in values.items():
        if name == "set":
            words += [word for pair in value.items() for word in ("--set", "=".join(pair))]
        elif name == "size":
            words += ["--size", f"{value[0]}x{value[1]}"]
        elif value is True:
            words.append(f"--{name}")
        elif name != "project" and value is not False:
            words += [f"--{name.replace('_', '-')}", str(value)]
    return words


def signalled(scene: Scene, number: int, stopped: tuple[str, float]) -> Outcome:
    """A command that gets a signal: at a moment from the start of its process to a little beyond its end."""
    stage = STAGES[stopped[0]]
    values = stage.made(scene)
    project = Path(values["project"])
    before = content(project) if project.is_dir() else {}
    moment = PYTHON + stopped[1] * (LIBRARIES + stage.seconds)
    reply = command(stage.verb, *options(values), stop=(number, lambda passed: passed >= moment))
    return checked(scene, stage, values, before, reply)


def asked(scene: Scene, stopped: tuple[str, float]) -> Outcome:
    """A job of the engine that is cancelled by a request."""
    stage = STAGES[stopped[0]]
    values = stage.made(scene)
    project = Path(values["project"])
    before = content(project) if project.is_dir() else {}
    reply = scene.engine.ask(stage.verb, cancel_after=stopped[1] * stage.seconds, **values)
    return checked(scene, stage, values, before, reply)


def checked(scene: Scene, stage: Stage, values: dict[str, Any], before: dict[str, str], reply) -> Outcome:
    project = Path(values["project"])
    wrong = lost(project, before) if before else ""
    wrong = wrong or (held(project) if project.is_dir() else "")
    if reply.code == "killed":
        reply.code = ""
        wrong = wrong or goes_on(scene, stage, values)
    return outcome(reply, wrong)


def goes_on(scene: Scene, stage: Stage, values: dict[str, Any]) -> str:
    """Whether the same verb does it all after a kill. What takes long is left to the tests of the stages."""
    if stage.verb in ("train", "mesh"):
        return ""
    reply = scene.engine.ask(stage.verb, **values)
    if reply.code:
        return f"after the kill {stage.verb} fails: {reply.message}"
    return "" if is_project(Path(values["project"])) else "no project came of it"


def cases(scene: Scene, count: int, seed: int) -> list[Case]:
    """A third each of kills, interrupts and requests, in an order of their own."""
    third = count // 3
    kills = drawn(STOPPED, third, seed)
    interrupts = drawn(STOPPED, third, seed + 1)
    requests = drawn(STOPPED, count - 2 * third, seed + 2)
    made = [
        *(Case(KILLS, f"SIGKILL {s}", lambda s=s: signalled(scene, signal.SIGKILL, s)) for s in kills),
        *(Case(CANCELS, f"SIGINT {s}", lambda s=s: signalled(scene, signal.SIGINT, s)) for s in interrupts),
        *(Case(CANCELS, f"cancel {s}", lambda s=s: asked(scene, s)) for s in requests),
    ]
    random.Random(seed).shuffle(made)
    return made


def quick_cases(scene: Scene, count: int, seed: int) -> list[Case]:
    """Cancels by request alone: no process has to start."""
    return [Case(CANCELS, f"cancel {s}", lambda s=s: asked(scene, s)) for s in drawn(STOPPED, count, seed)]
