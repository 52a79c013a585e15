"""Which vertices of a baked field belong to which thing of its mesh, for the viewport.

The engine of frames finds that (nerfcore/film/thing_texture.py), once for each bake and mesh; a timer asks it.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, NamedTuple

import bpy
from mathutils import Matrix

from ..errors import EngineError
from .redraw import redraw_views
from .voxels import Baked

PERIOD = 0.1  # seconds between two looks for an answer
RETRY = 30.0  # seconds after which what went wrong is tried again


class Told(NamedTuple):
    """Things that have class indices of their own, those after the field's classes: their names, the indices of their classes, the
    parts of the world in which they lie (from the cube [−1, 1]³), the texture T1 (Z, Y, X, 4) uint8 with these indices, and which of
    the S blocks have something of which index, (S, indices) bool."""

    names: list[str]
    of_class: list[int]
    cubes: list[Matrix]
    texels: Any
    marks: Any


class Answer:
    """What is known of the things of a baked field."""

    def __init__(self, key: Any, project: Path, run: str) -> None:
        self.key, self.project, self.run = key, project, run
        self.told: Told | None = None
        self.error = ""
        self.ended = 0.0  # when it was answered
        self.process: Any = None  # that was asked
        self.outcome: list[tuple[dict[str, Any] | None, EngineError | None]] = []

    @property
    def waits(self) -> bool:
        return self.ended == 0.0


class Answers:
    """Those of all baked fields; one for Blender."""

    def __init__(self) -> None:
        self._known: dict[str, Answer] = {}  # by folder

    def of(self, found: Baked, project: Path, run: str) -> Answer:
        """What is known of a field's things; it is asked for where that was not done yet, or something changed."""
        key = found.key, _changed(project, run)
        known = self._known.get(found.key[0])
        failed = known is not None and known.error and time.monotonic() - known.ended > RETRY
        if known is None or known.key != key or failed:
            fresh = Answer(key, project, run)
            # What was told before is shown until there is something newer.
            fresh.told = known.told if known is not None and known.key[0] == found.key else None
            known = self._known[found.key[0]] = fresh
            if not bpy.app.timers.is_registered(attend):
                bpy.app.timers.register(attend, first_interval=0.0)
        return known

    @property
    def waiting(self) -> list[Answer]:
        return [known for known in self._known.values() if known.waits]


def _changed(project: Path, run: str) -> tuple[int, ...]:
    """What is another number when the mesh or its things are others."""
    folder = project / "exports" / run
    return tuple(
        path.stat().st_mtime_ns if path.is_file() else 0 for path in (folder / "mesh.npz", folder / "instances.json")
    )


answers = Answers()


def attend() -> float | None:
    """What the timer does: send what was not sent yet, and take what was answered."""
    for known in answers.waiting:
        try:
            _attend(known)
        except (EngineError, OSError, ValueError) as error:
            known.error, known.ended = str(error), time.monotonic()
        if not known.waits:
            redraw_views()
    return PERIOD if answers.waiting else None


def _attend(known: Answer) -> None:
    import numpy as np

    from .engine import frames

    engine = frames()
    engine.pump()
    file = engine.folder() / f"things-{id(known)}.npz"
    if known.outcome:
        result, error = known.outcome.pop()
        if error is not None:
            raise error
        assert result is not None
        with np.load(file) as found:
            texels, marks = found["texels"], found["marks"]
        file.unlink()
        cubes = [Matrix(cube) for cube in result["cubes"]]
        known.told = Told(result["names"], result["of_class"], cubes, texels, marks)
        known.ended = time.monotonic()
    elif known.process is None or known.process is not engine.process:
        params = {"project": str(known.project), "run": known.run, "file": str(file)}
        if engine.ask("field_things", params, lambda *outcome: known.outcome.append(outcome)):
            known.process = engine.process


def unregister() -> None:
    if bpy.app.timers.is_registered(attend):
        bpy.app.timers.unregister(attend)
    answers.__init__()
