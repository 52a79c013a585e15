"""What a training that goes on finds of the one that was stopped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from ..config import make_config, with_rendering_of
from ..data.load import load_scene
from ..data.scene import Scene
from ..errors import ProjectError
from ..params import TrainParams
from ..progress import Reporter
from ..project.fingerprints import difference, digest
from ..project.runs import CHECKPOINT, INFO, TrainingFolder, is_begun, known_runs, no_such_run
from ..project.store import load_project
from ..render.run import RunInfo, read_checkpoint, read_info, settled_as
from .inputs import as_noted, data_inputs, settings_kept, training_length


def place_to_resume(project: Path, run: str, report: Reporter) -> TrainingFolder | None:
    """Where the training of a run goes on; None where it was stopped before its first checkpoint, or is the project's first.

    Raises:
        ProjectError: there is no such run, but there are others.
    """
    place = TrainingFolder.to_resume(project, run)
    if place is None:
        if not is_begun(project, run) and known_runs(project):
            raise no_such_run(project, run)
        report.note(f"The run “{run}” has no checkpoint to go on from: training begins.")
    return place


def saved_state(
    place: TrainingFolder, info: RunInfo, device: torch.device
) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Tensors and state of the checkpoint to go on from.

    Raises:
        ProjectError: it is damaged, or of another training than config.json beside it.
    """
    saved = read_checkpoint(place.folder / CHECKPOINT, device)
    if saved[1].get("training", "") != info.origin.training:
        raise ProjectError(
            f"{place.folder / CHECKPOINT} is not of the training that {INFO} beside it describes.",
            "Train the run anew, without --resume.",
        )
    return saved


def resumable(place: TrainingFolder, params: TrainParams, report: Reporter) -> tuple[RunInfo, Scene]:
    """The run to go on with, and its scene.

    Raises:
        ProjectError: it is of another project, or what it was trained on is no longer the same.
    """
    info = read_info(place.folder)
    if info.origin.project and info.origin.project != load_project(place.project).uuid:
        raise ProjectError(
            f"The run “{place.run}” in {place.folder} was trained in another project.",
            "Train it anew, without --resume.",
        )
    if info.origin.inputs:
        now = as_noted(data_inputs(place.project, info.holdout, info.config), info)
        changed = difference({name: info.origin.inputs.get(name, "") for name in now}, now)
        if changed:
            raise ProjectError(
                f"The run “{place.run}” cannot go on: since it began, these have {changed}.",
                "Train it anew, without --resume.",
            )
        length = training_length(params.steps, params.time_limit, info.config)
        info.origin.inputs["length of training"] = digest(length)
    asked = make_config(info.preset, params.set) if params.set else info.config
    info.config = with_rendering_of(info.config, asked, params.set)
    kept = settings_kept(info, params, settled_as(asked, info.config))
    if kept:
        what = ", ".join(kept)
        report.warn(f"The run “{place.run}” goes on with the settings it began with, not with those given now: {what}.")
    return info, load_scene(place.project, info.holdout)
