"""What workers of a test cluster do instead of reconstructing: stages that take a while and leave a trace on disk."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path
from typing import Any

from fieldwork.nerfcore.errors import DiskError, InputError, PosesError
from fieldwork.nerfcore.files import atomic_path, write_json
from fieldwork.nerfcore.params import ReconstructParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.lock import lockable, project_lock
from fieldwork.nerfcore.project.schema import Project
from fieldwork.nerfcore.project.store import is_project, save_project

NAME = f"{__name__}:run_stage"
STEPS = 20  # a stage is done in so many, each kept on disk like a checkpoint


def run_stage(values: dict[str, Any], report: Reporter) -> dict[str, Any]:
    """Burns `time_limit` seconds of a core in steps; the name of the capture says what goes wrong with it."""
    params, stage = ReconstructParams.model_validate(values["capture"]), values["stage"]
    project = Path(params.out)
    with project_lock(lockable(params), "batch"):
        if not is_project(project):
            save_project(project, Project())
        report.stage(stage)
        if "poisoned" in project.name and stage == "poses":
            raise PosesError("The photos do not overlap.", "Take more.")
        if "empty" in project.name:
            raise InputError("There are no photos.", "Take some.")
        if "deadly" in project.name and stage == "train":
            os.kill(os.getpid(), signal.SIGKILL)
        if "full" in project.name and not (project / "was_full").exists():
            (project / "was_full").touch()
            raise DiskError(f"No space left on the disk while writing {project}.", "Free some space.")
        done, place = 0, project / f"{stage}.json"
        if place.is_file():
            done = json.loads(place.read_text())["done"]
        with open(project / "steps.log", "a", encoding="utf-8") as log:
            for step in range(done, STEPS):
                report.progress(step / STEPS)
                work((params.time_limit or 0.1) / STEPS)
                _use_disk()
                log.write(f"{stage} {step}\n")
                log.flush()
                write_json(place, {"done": step + 1})
    return {
        "result": {"images": 7, "psnr": 20.0, "code": __file__, "worker": os.environ.get("FIELDWORK_TEST_WORKER", "")},
        "seconds": params.time_limit or 0.1,
        "reused": False,
        "redone": None,
    }


def _use_disk() -> None:
    """Write to the disk that a worker was given, if it was: 100 kB that stay."""
    place = os.environ.get("FIELDWORK_TEST_DISK")
    if place:
        with atomic_path(Path(place) / f"{os.getpid()}-{time.monotonic_ns()}.bin") as temporary:
            temporary.write_bytes(b"." * 100_000)


def work(seconds: float) -> None:
    """Compute for so many seconds of this process, however busy the machine is."""
    end = time.process_time() + seconds
    while time.process_time() < end:
        sum(range(2000))
