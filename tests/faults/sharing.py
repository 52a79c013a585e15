"""Two engines, or an engine and a reader, on one project: one writes, edits of both are kept, a reader sees whole files."""

from __future__ import annotations

import threading
import time
from pathlib import Path

from fieldwork.nerfcore.errors import FieldworkError
from fieldwork.nerfcore.project.store import is_project, load_poses, load_project
from fieldwork.tests.nerfcore.support.ball import SMALL
from hypothesis import strategies as st

from .draw import drawn
from .engine import Engine
from .outcome import Case, Outcome, Reply, outcome
from .scene import Scene, content, lost

AREA = "two on one project"
WORK = {
    "train": {"preset": "draft", "steps": 60, "set": SMALL},
    "mesh": {"resolution": 24},
    "align": {"up": "z"},
    "evaluate": {},
    "export": {"to": "ply"},
    "package": {},
}
TOGETHER = st.one_of(
    st.tuples(
        st.just("work"), st.tuples(st.sampled_from(sorted(WORK)), st.sampled_from(sorted(WORK)), st.floats(0, 1))
    ),
    st.tuples(
        st.just("work"), st.tuples(st.sampled_from(sorted(WORK)), st.sampled_from(sorted(WORK)), st.floats(0, 1))
    ),
    st.tuples(st.just("edits"), st.integers(3, 12)),
    st.tuples(st.just("new"), st.floats(0, 0.3)),
    st.tuples(st.just("reader"), st.sampled_from(sorted(WORK))),
)


def attempt(scene: Scene, other: Engine, together: tuple) -> Outcome:
    kind, value = together
    if kind == "new":
        return both_make(scene, other, value)
    project = scene.copy(scene.trained)
    before = content(project)
    if kind == "edits":
        found = edits(scene, other, project, value)
    elif kind == "reader":
        found = read(scene, project, value)
    else:
        first, second, moment = value
        replies: list[Reply] = []
        scene.engine.ask(
            first,
            project=project,
            meanwhile=lambda: replies.append(other.ask(second, project=project, **WORK[second])),
            moment=moment,
            **WORK[first],
        )
        found = outcome(replies[0] if replies else Reply())
        if found.kind == "error" and replies[0].code != "project":
            found = outcome(replies[0], f"another reason is told: {found.told}")
    wrong = lost(project, before)
    return outcome(Reply(), wrong) if wrong else found


def edits(scene: Scene, other: Engine, project: Path, count: int) -> Outcome:
    """Regions by one engine and classes by another, at once: the last of each is there."""
    for i in range(count):
        scene.engine.send("region", project=project, bounds=[[-1, -1, -1], [1, 1, 1 + i]])
        other.send("classes", project=project, classes=[{"id": 1, "name": f"stone {i}"}, {"id": 2, "name": "wood"}])
    replies = [engine.ask("region", project=project) for engine in (scene.engine, other)]
    wrong = [reply for reply in replies if reply.code]
    if wrong:
        return outcome(wrong[0])
    now = load_project(project)
    names = {c.name for c in now.classes}
    if f"stone {count - 1}" not in names:
        return outcome(Reply(), f"an edit of the classes is lost: {names}")
    region = replies[0].result
    return outcome(Reply(), "" if str(float(count)) in str(region) else f"an edit of the region is lost: {region}")


def both_make(scene: Scene, other: Engine, pause: float) -> Outcome:
    """Two engines make one project at the same time."""
    project, replies = scene.empty("both"), []
    values = {"project": project, "photos": scene.photos}
    thread = threading.Thread(target=lambda: replies.append(other.ask("new", **values)))
    thread.start()
    time.sleep(pause)
    replies.append(scene.engine.ask("new", **values))
    thread.join()
    refused = [reply for reply in replies if reply.code]
    if len(refused) == 2 or not is_project(project):
        return outcome(Reply(), f"no project came of two: {[reply.message for reply in replies]}")
    if len(load_project(project).images) != 4:
        return outcome(Reply(), "photos are missing")
    return outcome(refused[0] if refused else Reply())


def read(scene: Scene, project: Path, verb: str) -> Outcome:
    """Somebody reads all the time, as Blender's panels do."""
    stop, wrong = threading.Event(), []

    def watch() -> None:
        while not stop.is_set():
            try:
                load_project(project)
                load_poses(project)
            except FieldworkError as error:
                wrong.append(error.message)
            time.sleep(0.002)

    thread = threading.Thread(target=watch)
    thread.start()
    reply = scene.engine.ask(verb, project=project, **WORK[verb])
    stop.set()
    thread.join()
    return outcome(reply, f"a reader saw: {wrong[0]}" if wrong else "")


def cases(scene: Scene, count: int, seed: int) -> list[Case]:
    other = Engine(scene.folder)
    return [Case(AREA, repr(t), lambda t=t: attempt(scene, other, t)) for t in drawn(TOGETHER, count, seed)]
