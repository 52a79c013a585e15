"""Folders that may only be read, and projects that vanish or move away while they are worked on."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hypothesis import strategies as st

from .draw import drawn
from .outcome import Case, Outcome, outcome
from .scene import Scene, content, held, lost
from .stops import STAGES

AREA = "folders"
PLACES = ["", "runs", "runs/main", "exports", "images", "poses", "jobs"]
CHANGES = st.one_of(
    st.tuples(st.sampled_from(["read-only"]), st.sampled_from(PLACES), st.sampled_from(sorted(STAGES)), st.just(0.0)),
    st.tuples(
        st.sampled_from(["deleted", "moved", "a file"]),
        st.sampled_from(PLACES),
        st.sampled_from(sorted(STAGES)),
        st.floats(0, 2),
    ),
)


class NoMount(Exception):
    """Permissions do not hold for the superuser, and a read-only mount is not allowed."""


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Nobody writes into a folder; by a mount, where permissions say nothing."""
    if os.geteuid() != 0:
        folder.chmod(0o555)
        try:
            yield
        finally:
            folder.chmod(0o755)
        return
    mounted = subprocess.run(["mount", "--bind", folder, folder], capture_output=True, check=False).returncode == 0
    if not mounted:
        raise NoMount
    try:
        subprocess.run(["mount", "-o", "remount,ro,bind", folder], check=True, capture_output=True)
        yield
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def attempt(scene: Scene, change: tuple) -> Outcome:
    kind, place, name, moment = change
    stage = STAGES[name]
    values = stage.made(scene)
    project = Path(values["project"])
    target = project / place
    if not target.is_dir():
        target.mkdir(parents=True)
    before = content(project)
    if "out" in values:
        values["out"] = project / "renders"
    if kind == "read-only":
        try:
            with read_only(target):
                reply = scene.engine.ask(stage.verb, **values)
        except NoMount:
            return Outcome("skipped", "no folder can be made read-only here")
        return outcome(reply, (lost(project, before) if "project.json" in before else "") or held(project))

    def meanwhile() -> None:
        if kind == "moved":
            target.rename(scene.empty("moved"))
        else:
            shutil.rmtree(target, ignore_errors=True)
            if kind == "a file" and not target.exists():
                target.write_text("mine")

    reply = scene.engine.ask(stage.verb, meanwhile=meanwhile, moment=moment, **values)
    wrong = ""
    moved = scene.folder / "case" / "moved"
    if kind == "moved" and moved.is_dir() and place == "" and "project.json" in before:
        wrong = lost(moved, before)
    if not wrong and reply.code in ("", "cancelled") and place == "" and not (project / "project.json").exists():
        wrong = "" if moment and reply.code == "cancelled" else vanished_unnoticed(reply, stage.verb)
    return outcome(reply, wrong)


def vanished_unnoticed(reply, verb: str) -> str:
    """A result that was there before its project went is right; one whose files nobody finds is not."""
    files = [value for key, value in (reply.result or {}).items() if key in ("checkpoint", "file")]
    gone = [file for file in files if not Path(str(file)).exists()]
    return f"{verb} tells of {gone[0]}, which is not there" if gone and reply.warnings == () else ""


def cases(scene: Scene, count: int, seed: int) -> list[Case]:
    return [Case(AREA, repr(c), lambda c=c: attempt(scene, c)) for c in drawn(CHANGES, count, seed)]
