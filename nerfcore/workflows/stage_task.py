"""What a worker of a cluster is asked for: one stage of one capture."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from ..cluster.worker import require_inside
from ..errors import ProjectError
from ..params import ReconstructParams
from ..progress import Reporter
from ..project.lock import lockable, project_lock
from .reconstruct import run_stages

WRITTEN = ("out", "blend", "report", "renders")
LOCK_PATIENCE = 20.0  # seconds: a worker that was given up may hold the project for a moment longer


def run_stage(values: dict[str, Any], report: Reporter) -> dict[str, Any]:
    """Do one stage of a capture, unless what is there is still good.

    Args:
        values: "capture": settings of reconstruct; "stage"; "folder": the only one that is written in.
    Returns:
        {"result": what the verb returned, None where it had nothing to do, "seconds", "reused", "redone": why or None}
    Raises:
        the verb's errors. Refusal: a path leads out of the folder. ProjectError: another program holds the project.
    """
    params = ReconstructParams.model_validate(values["capture"])
    for path in written_paths(params):
        require_inside(path, Path(values["folder"]))
    verb = values["stage"]
    with _project(params, report):
        made = run_stages(params, [verb], report)
    return {
        "result": made.results.get(verb),
        "seconds": made.seconds.get(verb, 0.0),
        "reused": verb in made.reused,
        "redone": made.redone.get(verb),
    }


def written_paths(params: ReconstructParams) -> list[Path]:
    """The files and folders that a capture writes."""
    return [path for path in (getattr(params, name) for name in WRITTEN) if path is not None]


@contextmanager
def _project(params: ReconstructParams, report: Reporter) -> Iterator[None]:
    """Hold the project; one that is still held is waited for a little."""
    deadline = time.monotonic() + LOCK_PATIENCE
    with ExitStack() as stack:
        while True:
            report.check()
            try:
                stack.enter_context(project_lock(lockable(params), "batch"))
                break
            except ProjectError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.5)
        yield
