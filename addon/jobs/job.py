"""One piece of work of the engine, as Blender sees it."""

from __future__ import annotations

from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import bpy

from .. import machine
from ..engine.place import tail
from ..errors import EngineError
from ..text import t

CURVE_POINTS = 2000
Steps = Generator[tuple[float, str], None, None]  # yields the share that is done and what is next
Done = Callable[["Job"], Steps | None]

TITLES = {
    "new": "Reading Photos",
    "import": "Importing Data Set",
    "poses": "Estimating Poses",
    "align": "Aligning",
    "train": "Training",
    "evaluate": "Measuring",
    "bake": "Baking",
    "render": "Rendering",
    "mesh": "Extracting Mesh",
    "turntable": "Looking at the Mesh",
    "measure": "Measuring the Mesh",
    "plan": "Drawing",
    "section": "Drawing a Section",
    "compare": "Comparing Epochs",
    "report": "Writing the Report",
    "label prepare": "Preparing for Labels",
    "label propagate": "Propagating",
    "label overlay": "Drawing Labels",
    "label next": "Finding the Next Photo",
    "label import": "Importing Labels",
    "label export": "Exporting Labels",
    "label accept": "Accepting Labels",
    "assist embed": "Encoding Photos",
    "assist segment": "Cutting Out",
    "assist suggest": "Guessing Classes",
    "blend": "Writing .blend",
    "export": "Exporting",
    "batch": "Reconstructing Many",
    "blocks": "Reconstructing in Blocks",
    "bench": "Benchmarking",
    "simulate": "Simulating a Capture",
    "reconstruct": "Reconstructing",
    "dataset": "Photographing the Scene",
    "package": "Preparing the Scene",
    "doctor": "Checking the Engine",
    "classes": "Reading Classes",
    "timer": "Watching",
    "frame": "Rendering with Objects",
}


class Job:
    """One piece of work. `state`: queued, running, cancelling, done, failed, cancelled."""

    def __init__(
        self,
        verb: str,
        params: dict[str, Any],
        id: str,
        project: Path | None = None,
        on_done: Done | None = None,
        before: Steps | None = None,
        state: str = "queued",
        stage: str = "",
        started: float | None = None,
        result: dict[str, Any] | None = None,
        error: EngineError | None = None,
        followed: bool = False,
    ) -> None:
        self.verb, self.params, self.id, self.project = verb, params, id, project
        self.on_done = on_done
        self.before = before  # work in Blender before the job can start
        self.state, self.stage, self.message = state, stage, ""
        self.fraction: float | None = None
        self.eta: float | None = None
        self.started, self.seconds = started, 0.0  # when, by the monotonic clock; how long it runs
        self.result, self.error = result, error
        self.warnings: list[str] = []
        self.curve: list[tuple[int, float, float]] = []  # step, loss, PSNR in dB
        self.latest: dict[str, Any] = {}  # last "train" event
        self.preview = ""  # picture of a held-out photo
        self.preview_count = 0
        self.dismissed = False  # its message was put away
        self.followed = followed  # runs in an engine that another Blender started
        self.events_read = 0
        self.looked = 0.0  # when its files were read last, by the monotonic clock

    @property
    def title(self) -> str:
        return t(TITLES.get(self.verb, self.verb.capitalize()))

    @property
    def active(self) -> bool:
        return self.state in ("queued", "running", "cancelling")

    def take(self, method: str, data: dict[str, Any]) -> None:
        """A notification of the engine."""
        if method == "progress":
            self.stage, self.fraction = data.get("stage") or "", data.get("fraction")
            self.message, self.eta = data.get("message") or "", data.get("eta_s")
        elif method == "event":
            self.take_event(data)
        elif method == "log" and data.get("level") == "warning":
            self.warnings.append(str(data.get("text")))

    def take_event(self, data: dict[str, Any]) -> None:
        if data.get("kind") == "train":
            self.latest = data
            loss, psnr = data.get("loss"), data.get("psnr")
            nan = float("nan")
            self.curve.append((data.get("step", 0), nan if loss is None else loss, nan if psnr is None else psnr))
            if len(self.curve) > CURVE_POINTS:
                # Every other one of the older half: the shape stays, the length is bounded.
                half = CURVE_POINTS // 2
                self.curve[:half] = self.curve[:half:2]
        elif data.get("kind") == "preview" and data.get("path"):
            self.preview = str(data["path"])
            self.preview_count += 1

    def report(self) -> str:
        """Text for a bug report."""
        lines = [f"Fieldwork job {self.id}: {self.state}", f"verb: {self.verb}", f"parameters: {self.params}"]
        lines.append(f"Blender {bpy.app.version_string}, stage “{self.stage}”, {self.seconds:.0f} s")
        if self.error:
            lines += [f"error: {self.error.message}", f"advice: {self.error.hint}", self.error.detail]
        lines += [f"warning: {text}" for text in self.warnings]
        if self.project:
            from ...nerfcore.engine import status

            lines += ["--- log of the job", *tail(self.project / status.FOLDER / f"{self.verb}.log", 40)]
        lines += ["--- log of the engine", *tail(machine.engine_log(), 40)]
        return "\n".join(line for line in lines if line)
