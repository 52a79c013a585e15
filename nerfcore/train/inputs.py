"""What a training depends on, as a fingerprint, and what a run remembers of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..config import ONLY_RENDERING, RENAMED, RunConfig, make_config
from ..data.load import load_scene
from ..params import TrainParams
from ..project.fingerprints import Fingerprint, array_digest, digest, files_digest, rounded
from ..project.schema import Project
from ..project.store import load_points, load_poses, load_project, load_visibility, world_from_sfm
from ..render.run import RunInfo, settled_as
from .prepare import training_views

# Settings of `train` that decide when something is written, not what is learned.
WITHOUT_EFFECT = {"steps", "checkpoint_every", "preview_every"}
EXPOSURE = "exposure"  # by how much the colours of photos are changed; earlier versions did not note it
NOT_LEARNED = {"train": WITHOUT_EFFECT, "render": set(ONLY_RENDERING)}


def training_inputs(folder: Path, params: TrainParams, config: RunConfig) -> Fingerprint:
    """The fingerprint of the training that `params` with the settings `config` (as asked, not settled) asks for.

    Raises:
        ProjectError: the project has no poses.
    """
    learned = config.model_dump(mode="json", exclude=NOT_LEARNED, exclude_defaults=True)
    return {
        **data_inputs(folder, params.holdout, config),
        # Without defaults, so that a setting which is new in a version is no change.
        "settings": digest({stage: values for stage, values in learned.items() if values}),
        "length of training": digest(training_length(params.steps, params.time_limit, config)),
    }


def wanted_inputs(folder: Path, params: TrainParams, info: RunInfo) -> Fingerprint:
    """What `training_inputs` asks for, to be compared with the fingerprint of the run that `info` describes."""
    asked = make_config(params.preset, params.set)
    inputs, made = training_inputs(folder, params, asked), info.origin.inputs.get("settings")
    # Defaults of this version may be others than those that the run was made with.
    settled = settled_as(asked, info.config).model_dump(mode="json", exclude=NOT_LEARNED)
    if made == inputs["settings"] and settled != info.config.model_dump(mode="json", exclude=NOT_LEARNED):
        inputs["settings"] = digest(settled)
    return as_noted(inputs, info)


def as_noted(inputs: Fingerprint, info: RunInfo) -> Fingerprint:
    """Inputs without those that a run of an earlier version did not note."""
    return {name: value for name, value in inputs.items() if name != EXPOSURE or name in info.origin.inputs}


def settings_kept(info: RunInfo, params: TrainParams, asked: RunConfig) -> list[str]:
    """Which of the settings given now, in `asked`, a run that goes on does not take, as it began with others. A preset and a
    hold-out that are the default were not given."""
    began, now = info.config.model_dump(), asked.model_dump()
    named = [RENAMED.get(name, name).split(".") for name in params.set]
    kept = [f"{stage}.{key}" for stage, key in named if now[stage][key] != began[stage][key]]
    for name, own in (("preset", info.preset), ("holdout", info.holdout)):
        kept += [name] if getattr(params, name) not in (own, TrainParams.model_fields[name].default) else []
    return kept


def training_length(steps: int | None, seconds: float | None, config: RunConfig) -> dict[str, Any]:
    """Where a training ends: {"steps", "seconds"}, None where that is no limit."""
    return {"steps": steps or (None if seconds else config.train.steps), "seconds": seconds}


def data_inputs(folder: Path, holdout: int, config: RunConfig) -> Fingerprint:
    """The part of the fingerprint that is the capture's: what a resumed training must find as it was.

    Lies in the SfM frame: turning, scaling and moving the world changes nothing here, a region of other extent does.
    """
    project, scene = load_project(folder), load_scene(folder, holdout)
    views = [scene.views[i] for i in training_views(scene, config)]
    names = [view.name for view in views]
    labelled = config.loss.semantic_weight > 0
    labels = [(v.name, path) for v in views for path in (v.label, v.confidence)] if labelled else []
    depth = config.loss.depth_weight > 0
    gains = [view.gain for view in views]
    return {
        "training photos": digest(names),
        "photos": files_digest((view.name, view.image) for view in views),
        EXPOSURE: digest(gains if any(gains) else []),
        "labels": files_digest(labels),
        "masks": digest([project.mask_mode, files_digest((view.name, view.mask) for view in views)]),
        "depth maps": files_digest([(view.name, view.depth) for view in views] if depth else []),
        "camera poses": _poses(folder, set(names)),
        "sparse points": _points(folder, names, depth),
        "classes": digest([project.ignore_id, sorted((c.id, c.priority) for c in project.classes)] if labelled else []),
        "region": region_digest(project),
    }


def region_digest(project: Project) -> str:
    """The region of interest by its corners in the SfM frame, to six digits."""
    if project.frame.bounds is None:
        return digest(None)
    corners = np.stack(np.meshgrid(*np.array(project.frame.bounds, np.float64).T, indexing="ij"), -1).reshape(-1, 3)
    sfm_from_world = np.linalg.inv(world_from_sfm(project))
    return digest(rounded(corners @ sfm_from_world[:3, :3].T + sfm_from_world[:3, 3]))


def _points(folder: Path, names: list[str], seen: bool) -> str:
    """The sparse points, and where depth is learned from them, which photo saw which."""
    points = load_points(folder)
    visibility = load_visibility(folder) if seen else {}
    sights = [visibility[name] for name in names if name in visibility]
    return array_digest(points.xyz, points.error, *sights)


def _poses(folder: Path, names: set[str]) -> str:
    poses = load_poses(folder)
    return digest(
        [
            [image.name, image.camera_to_world, poses.cameras[image.camera].model_dump(mode="json")]
            for image in sorted(poses.images, key=lambda image: image.name)
            if image.name in names
        ]
    )
