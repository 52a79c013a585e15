"""The costly half of pose estimation in pieces that several machines do at the same time: features, then parts of the pairs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..params import PosesParams
from ..progress import Reporter
from ..project.store import load_project
from .estimate import pose_job
from .inputs import posed
from .process import run_worker


def find_features(params: PosesParams, report: Reporter) -> dict[str, Any]:
    """Find the features and choose the pairs to match. Nothing is done where the poses are there.

    Returns:
        {"pairs": how many}
    Raises:
        as `estimate_poses`; the project has to be held.
    """
    return _piece(params, report, {"only": "features"})


def match_part(params: PosesParams, part: int, parts: int, report: Reporter) -> dict[str, Any]:
    """Match every `parts`th pair from number `part` on, beside others that match the rest; the project is only read.

    Returns:
        {"pairs": how many}
    Raises:
        as `estimate_poses`.
    """
    return _piece(params, report, {"only": "match", "part": [part, parts]})


def _piece(params: PosesParams, report: Reporter, piece: dict[str, Any]) -> dict[str, Any]:
    if posed(params).result is not None:
        return {"pairs": 0}
    folder = Path(params.project)
    job = pose_job(folder, load_project(folder), params, report)
    if job["start"] is not None:  # photos were added to poses: few pairs, matched by `estimate_poses` itself
        return {"pairs": 0}
    return run_worker({**job, **piece}, Path(job["work"]), report)
