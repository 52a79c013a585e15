"""Clocks that jump, and files from the future: what is done again and how long it took does not hang on them."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from hypothesis import strategies as st

from .draw import drawn
from .engine import Engine
from .outcome import Case, Outcome, outcome
from .scene import Scene, content, held, lost
from .stops import STAGES

AREA = "clock"
JUMPS = st.tuples(
    st.sampled_from([-(10**9), -86400, -3600, -1, 1, 3600, 86400, 10**10]), st.sampled_from([1, 7, 40]),
    st.sampled_from(["new", "train", "train again", "mesh", "render"]),
)  # fmt: skip
STAMPS = st.tuples(
    st.sampled_from([0, 1, -(10**6), 2**31 + 5, 10**10]), st.sampled_from(["new", "train again", "mesh"])
)


def attempt(scene: Scene, jump: tuple) -> Outcome:
    by, every, name = jump
    engine = Engine(
        scene.folder, [sys.executable, str(Path(__file__).with_name("jumping_engine.py")), str(by), str(every)]
    )
    try:
        return work(scene, engine, name, None)
    finally:
        engine.kill()


def work(scene: Scene, engine: Engine, name: str, stamp: float | None) -> Outcome:
    stage = STAGES[name]
    values = stage.made(scene)
    project = Path(values["project"])
    if stamp is not None:
        for folder in (project, Path(values.get("photos", project))):
            for path in folder.rglob("*"):
                os.utime(path, (stamp, stamp))
    before = content(project) if project.is_dir() else {}
    reply = engine.ask(stage.verb, **values)
    wrong = (lost(project, before) if before else "") or held(project)
    seconds = (reply.result or {}).get("seconds", 0)
    if not wrong and not 0 <= seconds < 300:
        wrong = f"it took {seconds} s, says the result"
    if not wrong and reply.code:
        wrong = f"{stage.verb} fails: {reply.message}"
    return outcome(reply, wrong)


def cases(scene: Scene, count: int, seed: int) -> list[Case]:
    half = count // 2
    return [
        *(Case(AREA, f"jumps {j}", lambda j=j: attempt(scene, j)) for j in drawn(JUMPS, half, seed)),
        *quick_cases(scene, count - half, seed),
    ]


def quick_cases(scene: Scene, count: int, seed: int) -> list[Case]:
    return [
        Case(AREA, f"files of {s[0]}, {s[1]}", lambda s=s: work(scene, scene.engine, s[1], s[0]))
        for s in drawn(STAMPS, count, seed)
    ]
