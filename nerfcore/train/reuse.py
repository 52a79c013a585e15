"""Whether a run that is there may be used again, and what of it follows settings without training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..config import make_config, with_rendering_of
from ..data.load import load_scene
from ..errors import ProjectError
from ..params import TrainParams
from ..progress import Reporter
from ..project.fingerprints import Earlier, compare
from ..project.runs import (
    CHECKPOINT,
    TrainingFolder,
    checkpoint_state,
    has_checkpoint,
    read_metrics,
    run_folder,
    settle,
)
from ..project.schema import step
from ..project.store import load_project, record_step
from ..render.run import RunInfo, load_info, read_info, save_info
from .closed_picture import closed_picture
from .inputs import wanted_inputs
from .verb import train


def finished(params: TrainParams) -> Earlier:
    """Whether a run of just these settings and inputs was trained to its end; see also `unfinished`."""
    earlier = _trained(params)
    if earlier.result is not None and _other_rendering(params) is not None:
        return Earlier(reason="changed: settings of rendering; the trained field is kept")
    return earlier


def train_or_keep(params: TrainParams, report: Reporter) -> dict[str, Any]:
    """Train a run; where only settings of rendering are other ones, its field stays and config.json takes them over.

    Returns:
        what `train` returns, of the training the field comes from.
    Raises:
        as `train`.
    """
    earlier = Earlier() if params.resume else _trained(params)
    result = train(params, report) if earlier.result is None else earlier.result
    info = _other_rendering(params)
    if info is not None:
        folder = Path(params.project)
        save_info(run_folder(folder, params.run), info)
        done = {"preset": info.preset, "holdout": info.holdout, "config": info.config.model_dump(mode="json")}
        record_step(folder, "train", params.model_dump(mode="json") | done, result, info.origin.inputs)
    return result


def _other_rendering(params: TrainParams) -> RunInfo | None:
    """The run with the settings of rendering asked for; None where it has them."""
    info = load_info(Path(params.project), params.run)
    config = with_rendering_of(info.config, make_config(params.preset, params.set))
    return None if config == info.config else info.model_copy(update={"config": config})


def _trained(params: TrainParams) -> Earlier:
    """Whether a field was trained to its end with just these settings and inputs, however it was to be rendered."""
    folder = Path(params.project)
    settle(folder, params.run)
    place = run_folder(folder, params.run)
    if not has_checkpoint(place):
        return Earlier()
    try:
        info = read_info(place)
    except ProjectError as error:
        return Earlier(reason=error.message)
    project = load_project(folder)
    result = read_metrics(place).get("train") or {}
    if result and "checkpoint" not in result:  # earlier versions of `evaluate --split train` wrote there
        steps = [s for s in project.provenance if s.verb == "train" and s.result.get("run") == params.run]
        result = steps[-1].result if steps else {}
    done = step("train", {}, result, info.origin.inputs)
    earlier = compare(done, wanted_inputs(folder, params, info))
    if earlier.result is not None and info.origin.project != project.uuid:
        return Earlier(reason="trained in another project")
    if earlier.result is None:
        return earlier
    if "checkpoint" not in earlier.result:
        return Earlier(reason="not finished")
    state = checkpoint_state(place / CHECKPOINT) or {}
    behind = state.get("steps", -1) < earlier.result.get("steps", 0)  # one that went on and was stopped is ahead
    if behind or state.get("training", "") != info.origin.training:
        return Earlier(reason=f"{CHECKPOINT} is not what the training ended with")
    paths = {"checkpoint": str(place / CHECKPOINT), "closed_picture": closed_picture(place)}
    return Earlier({**earlier.result, **paths})


def unfinished(params: TrainParams) -> bool:
    """Whether a training of just these settings and inputs was stopped, so that it can go on."""
    folder = Path(params.project)
    place = TrainingFolder.to_resume(folder, params.run)
    if place is None or "train" in read_metrics(place.folder):
        return False
    try:
        info = read_info(place.folder)
    except ProjectError:
        return False
    wanted = wanted_inputs(folder, params, info)
    return info.origin.inputs == wanted and info.origin.project == load_project(folder).uuid


def held_out(project: Path, run: str) -> int:
    """How many photos a run holds out. Raises ProjectError when there is no such run."""
    info = load_info(project, run)
    return len(load_scene(project, info.holdout).unseen_by(info.images).test)
