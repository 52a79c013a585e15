"""A training run on disk: `runs/<name>/config.json`, its checkpoint, and the model they describe."""

from __future__ import annotations

import copy
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, ValidationError, field_validator
from safetensors import SafetensorError, safe_open

from ..config import RunConfig
from ..data.box import Box
from ..data.load import load_scene
from ..data.scene import Scene
from ..errors import InputError, ProjectError
from ..files import write_json
from ..geometry.similarity import transform_pose
from ..kernels.device import use_device
from ..progress import Reporter, shortened
from ..project.runs import CHECKPOINT, HOLDOUT, INFO, no_such_run, run_folder, settle, state_id
from ..project.schema import Poses, Project
from ..project.store import load_project, world_from_sfm
from .kept_grid import KeptGrid, read_tensor
from .migration import migrate_info, migrate_tensors
from .model import Model

CPU_IMAGE_SIZE, GPU_IMAGE_SIZE = 800, 1600  # longest side of the photos in training; see `train.image_size`
REFINED_POSES = "poses.json"  # of a run with train.refine_poses
LIMITS = {"greater_than", "greater_than_equal", "less_than", "less_than_equal"}  # as pydantic names what is beyond them
RENDER_GRID = "render_grid.safetensors"  # the finer grid of a finished field
PIXEL_FEATURES = "voxel_init.safetensors"  # of a run with field.voxel_init=cnn


class Origin(BaseModel):
    """What a run comes from; empty for runs of versions that did not note it."""

    model_config = ConfigDict(extra="forbid")

    project: str = ""  # uuid
    training: str = ""  # another one for each training from the start
    inputs: dict[str, str] = {}  # fingerprint, with the settings as asked for


class AcceptedLabels(BaseModel):
    """Which revision of the project's marks a run has its classes from, and since when."""

    model_config = ConfigDict(extra="forbid")

    revision: int
    time: str


class RunInfo(BaseModel):
    """What a run was trained on and with. `sfm_from_box` (4, 4) carries the cube [−1, 1]³ into the SfM frame."""

    model_config = ConfigDict(extra="forbid")

    version: Literal[3] = 3
    preset: str
    config: RunConfig
    class_ids: list[int]
    priorities: list[float]
    images: list[str]
    sfm_from_box: list[list[float]]
    contracted: bool
    transparent: bool
    holdout: int = HOLDOUT  # every so many photos one was held out, where the project does not say which
    origin: Origin = Origin()
    accepted: AcceptedLabels | None = None  # None: its classes are those of the label maps it was trained on
    map_revision: int | None = None  # of the marks that these maps were made from, if they were

    @property
    def label_revision(self) -> int | None:
        """The revision of the marks that the classes are from, if they are from any."""
        return self.map_revision if self.accepted is None else self.accepted.revision

    @field_validator("config")
    @classmethod
    def _settled(cls, config: RunConfig) -> RunConfig:
        if config.scene.image_size is None:
            raise ValueError("scene.image_size is not settled")
        return config

    @property
    def image_size(self) -> int:
        """Longest side of the training images in pixels."""
        assert self.config.scene.image_size is not None
        return self.config.scene.image_size

    def box(self, project: Project) -> Box:
        """The cube in the project's present world frame."""
        return Box(world_from_sfm(project) @ np.array(self.sfm_from_box), self.contracted)


def settled_as(asked: RunConfig, settled: RunConfig) -> RunConfig:
    """The settings asked for, with those that were left to the photos and the device as in a run that settled them."""
    config = asked.model_copy(deep=True)
    if config.scene.image_size is None:
        config.scene.image_size = settled.scene.image_size
    if config.scene.background == "auto":
        config.scene.background = settled.scene.background
    if config.field.finest is None:
        config.field.finest = settled.field.finest
    return config


def save_info(folder: Path, info: RunInfo) -> None:
    """Write config.json into the folder of a run."""
    write_json(folder / INFO, info.model_dump(mode="json"))


def load_info(project: Path, run: str) -> RunInfo:
    """Raises ProjectError when there is no such run or its config.json is damaged."""
    settle(project, run)
    if not (run_folder(project, run) / INFO).is_file():
        raise no_such_run(project, run)
    return read_info(run_folder(project, run))


def read_info(folder: Path) -> RunInfo:
    """config.json of the folder of a run. Raises ProjectError when it is missing or damaged."""
    path = folder / INFO
    try:
        return _as_trained(migrate_info(json.loads(path.read_text(encoding="utf-8"))))
    except (OSError, json.JSONDecodeError, ValidationError) as error:
        raise ProjectError(f"{path} is damaged or from another version.", "Train the run again.") from error


def _as_trained(value: Any) -> RunInfo:
    """A run with its settings as they were when it was trained, also where they are beyond today's limits.

    Raises:
        ValidationError: it is damaged.
    """
    try:
        return RunInfo.model_validate(value)
    except ValidationError as error:
        details = error.errors()
        if any(
            detail["type"] not in LIMITS or detail["loc"][0] != "config" or len(detail["loc"]) != 3
            for detail in details
        ):
            raise
    allowed = copy.deepcopy(value)
    for detail in details:
        del allowed["config"][detail["loc"][1]][detail["loc"][2]]
    info = RunInfo.model_validate(allowed)
    for detail in details:
        stage = getattr(info.config, str(detail["loc"][1]))
        vars(stage)[str(detail["loc"][2])] = detail["input"]  # not checked again
    return info


def without_seen(scene: Scene, info: RunInfo, report: Reporter) -> Scene:
    """The scene without held-out views that the run was trained on, of which a warning tells.

    Raises:
        InputError: it was trained on all of them.
    """
    unseen = scene.unseen_by(info.images)
    seen = [scene.views[i].name for i in scene.test if i not in unseen.test]
    if seen and not unseen.test:
        raise InputError(
            f"The run was trained on all {len(seen)} photos that are held out now, since photos were added or left out.",
            "Train it again.",
        )
    if seen:
        report.warn(
            shortened(f"{len(seen)} photos that are held out now were trained on by this run and do not count", seen)
            + " Train it again to hold them out."
        )
    return unseen


def refined_poses(project: Path, run: str, info: RunInfo) -> dict[str, np.ndarray]:
    """Camera-to-box poses (4, 4) by image of a run that refined them; empty otherwise.

    Raises:
        ProjectError: the run's poses.json is damaged.
    """
    path = run_folder(project, run) / REFINED_POSES
    if not (info.config.train.refine_poses and path.is_file()):
        return {}
    try:
        poses = Poses.model_validate_json(path.read_text(encoding="utf-8"))
    except (OSError, ValidationError) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Train the run again.") from error
    box_from_sfm = np.linalg.inv(np.array(info.sfm_from_box))
    return {image.name: transform_pose(box_from_sfm, np.array(image.camera_to_world)) for image in poses.images}


def scene_as_trained(project: Path, run: str, info: RunInfo) -> Scene:
    """The scene of a run, its cameras where the run found them to be if it refined their poses.

    Raises:
        as `load_scene` and `refined_poses`.
    """
    scene, world_from_box = load_scene(project, info.holdout), info.box(load_project(project)).world_from_box
    poses = {name: transform_pose(world_from_box, pose) for name, pose in refined_poses(project, run, info).items()}
    return replace(scene, views=[replace(v, camera_to_world=poses.get(v.name, v.camera_to_world)) for v in scene.views])


def new_model(
    info: RunInfo, device: torch.device, seen: torch.Tensor | None = None, unknown: torch.Tensor | None = None
) -> Model:
    """An untrained model of the run's shape; `seen` and `unknown` cells as `OccupancyGrid` takes them."""
    torch.manual_seed(info.config.train.seed)
    classes = len(info.class_ids) if info.config.loss.semantic_weight > 0 else 0
    priorities = torch.tensor(info.priorities) if classes else None
    return Model(info.config, classes, len(info.images), info.contracted, seen, priorities, unknown).to(device)


@dataclass(frozen=True)
class Trained:
    """A trained model, ready to be read."""

    model: Model
    info: RunInfo
    state: dict[str, Any]
    device: torch.device


def load_trained(project: Path, run: str) -> Trained:
    """Raises ProjectError when the run has no usable checkpoint."""
    info, device = load_info(project, run), use_device()
    path = run_folder(project, run) / CHECKPOINT
    tensors, state = read_checkpoint(path, device)
    model = new_model(info, device)
    own = {name.removeprefix("model."): t for name, t in tensors.items() if name.startswith("model.")}
    try:
        model.load_state_dict(own)
    except RuntimeError as error:
        raise ProjectError(
            f"{path} holds a field of another shape than {INFO} beside it describes.", "Train the run again."
        ) from error
    model.field.set_progress(state["progress"], info.config.train.fade, state["steps"])
    model.kept_grid = KeptGrid(path.with_name(RENDER_GRID), state_id(state))
    return Trained(model.eval().requires_grad_(False), info, state, device)


def read_checkpoint(path: Path, device: torch.device) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Tensors and state of a checkpoint. Raises ProjectError when it is missing, truncated or foreign."""
    if not path.is_file():
        raise ProjectError(f"{path.parent} has no checkpoint.", "Run `fieldwork train` first.")
    try:
        with safe_open(path, "pt", device=str(device)) as file:
            state = json.loads((file.metadata() or {})["fieldwork"])
            names = list(file.keys())
            return migrate_tensors({name: read_tensor(file, name) for name in names}), state
    except (SafetensorError, KeyError, json.JSONDecodeError, OSError) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Train the run again.") from error
