"""Full disks, files that may only be small, memory that may only be little."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from .draw import drawn
from .engine import command
from .outcome import Case, Outcome, Reply, outcome
from .scene import Scene, content, held, lost
from .stops import STAGES, options

FULL, FILES, MEMORY = "full disk", "file sizes (RLIMIT_FSIZE)", "memory (RLIMIT_AS)"
TOLD = {FULL: {"disk"}, FILES: {"disk"}, MEMORY: {"memory", "poses", "disk"}}

ROOM = st.tuples(st.sampled_from(sorted(STAGES)), st.integers(0, 900))  # kB left on the disk
SMALL_FILES = st.tuples(st.sampled_from(sorted(STAGES)), st.sampled_from([0, 1, 2, 4, 16, 64, 200, 600]))  # kB
LITTLE = st.tuples(st.sampled_from(sorted(STAGES)), st.integers(500, 9000))  # MB of addresses


class NoMount(Exception):
    """Only the superuser mounts, and not in every container."""


@contextmanager
def disk(folder: Path, kilobytes: int) -> Iterator[None]:
    """A file system of its own over a folder, which keeps its content."""
    kept = folder.with_name(folder.name + " kept")
    folder.rename(kept)
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", folder], capture_output=True, check=False
    )
    if mounted.returncode:
        raise NoMount
    try:
        shutil.copytree(kept, folder, dirs_exist_ok=True)
        yield
    finally:
        subprocess.run(["umount", "-l", folder], check=True)
        shutil.rmtree(kept)


def used(folder: Path) -> int:
    """kB that a folder takes on a file system of pages of 4 kB."""
    return sum(4 * (1 + (path.stat().st_size + 4095) // 4096) for path in folder.rglob("*")) + 8


def full(scene: Scene, drawn_case: tuple[str, int]) -> Outcome:
    name, room = drawn_case
    stage = STAGES[name]
    values = stage.made(scene)
    project = Path(values["project"])
    project.mkdir(exist_ok=True)
    before = content(project)
    if "out" in values:
        values["out"] = project / "renders"
    try:
        with disk(project, used(project) + room):
            reply = scene.engine.ask(stage.verb, **values)
            return judged(FULL, reply, lost(project, before) if before else "" or held(project))
    except NoMount:
        return Outcome("skipped", "no file system can be mounted here")


def limited(scene: Scene, area: str, drawn_case: tuple[str, int]) -> Outcome:
    name, limit = drawn_case
    stage = STAGES[name]
    values = stage.made(scene)
    project = Path(values["project"])
    before = content(project) if project.is_dir() else {}
    rule = f"ulimit -f {limit}" if area == FILES else f"ulimit -v {limit * 1000}"
    reply = command(stage.verb, *options(values), shell=rule)
    return judged(area, reply, lost(project, before) if before else "")


def judged(area: str, reply: Reply, wrong: str) -> Outcome:
    found: Any = outcome(reply, wrong)
    if found.kind == "error" and reply.code not in TOLD[area]:
        return outcome(reply, f"another reason is told: {reply.code}: {reply.message}")
    return found


def cases(scene: Scene, count: int, seed: int) -> list[Case]:
    each = count // 3
    return [
        *(
            Case(FULL, f"{c[0]}, {c[1]} kB left", lambda c=c: full(scene, c))
            for c in drawn(ROOM, count - 2 * each, seed)
        ),
        *(
            Case(FILES, f"{c[0]}, {c[1]} kB", lambda c=c: limited(scene, FILES, c))
            for c in drawn(SMALL_FILES, each, seed)
        ),
        *(Case(MEMORY, f"{c[0]}, {c[1]} MB", lambda c=c: limited(scene, MEMORY, c)) for c in drawn(LITTLE, each, seed)),
    ]


def quick_cases(scene: Scene, count: int, seed: int) -> list[Case]:
    return [Case(FULL, f"{c[0]}, {c[1]} kB left", lambda c=c: full(scene, c)) for c in drawn(ROOM, count, seed)]
