"""What a worker of a cluster is asked for: one stage of one capture."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any

from ..capture.find import classes_beside, subfolder
from ..cluster.storage import Storage, work_folder
from ..cluster.worker import require_inside
from ..cluster.working_copy import Copy, Saving, placed
from ..params import PosesParams, ReconstructParams, RenderParams
from ..poses.spread import find_features, match_part
from ..progress import Reporter
from ..project.fingerprints import digest
from ..project.lock import awaited_lock, lockable
from .reconstruct import run_stages, stage_params
from .stages import STAGES

READ = ("photos", "labels", "masks", "classes")
WRITTEN = ("out", "blend", "report", "renders")
# Of a project, what a stage does not fetch: COLMAP's files only where poses are estimated.
NOT_READ = {"new": ("poses/sfm/", "runs/", "exports/"), "poses": ("runs/", "exports/", "labels/")}
SAVE_EVERY = 30.0  # seconds, as often as training writes a checkpoint


def run_stage(values: dict[str, Any], report: Reporter) -> dict[str, Any]:
    """Do one stage of a capture, unless what is there is still good.

    Args:
        values: "capture": settings of reconstruct; "stage"; "frame_range": of a part of the stage render; "matching": of poses only “features”,
            or one of so many parts of the pairs, as [number, parts]; "folder": of the campaign, the only one that is written in;
            "storage": None, or the URL from which files are fetched into a folder of this machine, and left; then "campaign" and
            "attempt", see `Copy.take`.
    Returns:
        {"result": what the verb returned, None where it had nothing to do, "seconds", "reused", "redone": why or None}
    Raises:
        the verb's errors. Refusal: a path leads out of the folder. ProjectError: another program holds the project.
        StorageError.
    """
    if not values.get("storage"):
        return do_stage(values, report)
    storage, there = Storage(values["storage"]), values["folder"]
    here = work_folder(values["storage"])
    local = placed({**values, "folder": there}, there, str(here))
    params = ReconstructParams.model_validate(local["capture"])
    copy = Copy(storage, here, capture_name(params, here), tracked_paths(params))
    report.stage("Fetching files")

    def reads(name: str) -> bool:
        return needed(name, values["stage"], params, here)

    copy.take(values.get("campaign", ""), values.get("attempt", 0))
    copy.fetch(reads, report.check)
    copy.begin(reads)
    with Saving(copy, SAVE_EVERY):
        made = do_stage(local, report)
    return placed(made, str(here), there)


def do_stage(values: dict[str, Any], report: Reporter) -> dict[str, Any]:
    """`run_stage` with all files at hand."""
    params = ReconstructParams.model_validate(values["capture"])
    for path in written_paths(params):
        require_inside(path, Path(values["folder"]))
    verb = values["stage"]
    if values.get("frame_range"):
        return _render_part(params, tuple(values["frame_range"]), report)
    if values.get("matching"):
        return _matching(params, values["matching"], report)
    with awaited_lock(lockable(params), "batch", report.check):
        made = run_stages(params, [verb], report)
    return {
        "result": made.results.get(verb),
        "seconds": made.seconds.get(verb, 0.0),
        "reused": verb in made.reused,
        "redone": made.redone.get(verb),
    }


def _render_part(params: ReconstructParams, frames: tuple[int, int], report: Reporter) -> dict[str, Any]:
    """Render some frames of a capture while others render the rest; the project is only read."""
    begin = time.perf_counter()
    values = stage_params(params, "render")
    assert isinstance(values, RenderParams)
    part = values.model_copy(update={"frame_range": frames})
    stage = STAGES["render"]()
    earlier = stage.earlier(part)
    result = stage.run(part, report) if earlier.result is None else earlier.result
    seconds = round(time.perf_counter() - begin, 1)
    return {"result": result, "seconds": seconds, "reused": earlier.result is not None, "redone": None}


def _matching(params: ReconstructParams, what: str | list[int], report: Reporter) -> dict[str, Any]:
    """The features of a large capture, or a part of its pairs while others match the rest."""
    begin, values = time.perf_counter(), PosesParams(project=Path(params.out), keep_exposure=params.keep_exposure)
    if isinstance(what, str):
        with awaited_lock(lockable(params), "batch", report.check):
            result = find_features(values, report)
    else:
        result = match_part(values, what[0], what[1], report)
    return {"result": result, "seconds": round(time.perf_counter() - begin, 1), "reused": False, "redone": None}


def capture_name(params: ReconstructParams, folder: Path) -> str:
    """What a capture is called in the storage, by its project's place below the campaign's folder."""
    relative = Path(params.out).relative_to(folder).as_posix()
    return f"{re.sub(r'[^A-Za-z0-9_.-]', '_', Path(params.out).name)[:60]}-{digest(relative)[:12]}"


def tracked_paths(params: ReconstructParams) -> list[Path]:
    """The files and folders of a capture, given and made."""
    given = [getattr(params, name) for name in READ]
    labels = [subfolder(params.photos, name) for name in ("labels", "masks")]
    beside = [classes_beside(params.labels or labels[0])]
    found = {path: None for path in (*given, *labels, *beside, *written_paths(params)) if path is not None}
    return list(found)


def needed(name: str, stage: str, params: ReconstructParams, folder: Path) -> bool:
    """Whether a stage reads a file, by its place below the campaign's folder."""
    project = Path(params.out).relative_to(folder).as_posix()
    if not name.startswith(f"{project}/"):
        return stage in ("new", "blend") or not any(name.startswith(f"{place}") for place in _given(params, folder))
    return not name[len(project) + 1 :].startswith(NOT_READ.get(stage, ("poses/sfm/",)))


def _given(params: ReconstructParams, folder: Path) -> list[str]:
    places = [getattr(params, name) for name in READ]
    return [path.relative_to(folder).as_posix() for path in places if path is not None and path.is_relative_to(folder)]


def written_paths(params: ReconstructParams) -> list[Path]:
    """The files and folders that a capture writes."""
    return [path for path in (getattr(params, name) for name in WRITTEN) if path is not None]
