"""A field while it is trained, for those who look at it between two steps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..data.scene import Scene
from .model import Model
from .run import RunInfo


@dataclass(frozen=True)
class Unfinished:
    """A run in training: its model changes with every step."""

    project: Path
    run: str
    info: RunInfo
    scene: Scene
    model: Model
