"""Ours and the baselines as one thing: a step of training, a picture from a camera, what it costs.

All get the same photos, labels, noise, cube and held-out cameras; only what happens to a ray is their own.
"""

from __future__ import annotations

import shutil
import time
import uuid
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from ...bake.verb import bake
from ...config import make_config
from ...data.camera_rays import CameraRays
from ...data.pixels import PixelStore
from ...data.scene import Scene
from ...evaluate.speed import split_times
from ...geometry.cameras import Camera
from ...images.picture import Picture
from ...params import BakeParams
from ...progress import Reporter
from ...project.runs import CHECKPOINT, TrainingFolder
from ...project.store import load_project
from ...render.baked import BakedField, load_baked
from ...render.image import LEAST, Frame, background_of, render_view
from ...render.run import Origin, RunInfo, save_info
from ...train.checkpoint import save_checkpoint
from ...train.prepare import degrade, make_trainer, plan_run
from ...train.schedule import largest_batch
from ..baselines.method import Baseline, Rays, Setup, camera_rays
from ..baselines.registry import make_baseline
from .protocol import Trial

MEASURED = 16, 32  # between these steps is measured how long one takes, as `train` does


class Trainee(ABC):
    """What a trial trains. `info`: classes, cube and size of pictures; `scene`: in the world frame."""

    info: RunInfo
    scene: Scene
    box_from_world: np.ndarray
    device: torch.device

    @abstractmethod
    def step(self, progress: float) -> tuple[int, float]:
        """One step at `progress` in [0, 1]; returns its rays and their mean squared error."""

    @abstractmethod
    def finish(self, report: Reporter) -> None:
        """After the last step: what is needed before pictures are rendered."""

    @abstractmethod
    def frame(self, camera: Camera, pose: np.ndarray, semantics: bool, check: Callable[[], None]) -> Frame:
        """What a camera (pose (4, 4) in the normalised frame) sees."""

    @abstractmethod
    def sampling_share(self, camera: Camera, pose: np.ndarray, report: Reporter) -> float:
        """Share of a picture's time that finding samples takes; the rest is reading the field and compositing."""

    @abstractmethod
    def parameter_count(self) -> int: ...

    @property
    def background(self) -> float:
        return background_of(self.info)


class OurTrainee(Trainee):
    def __init__(self, trial: Trial, project: Path, device: torch.device, report: Reporter) -> None:
        self.trial, self.project, self.device = trial, project, device
        self.info, self.scene = planned_run(trial, project, device)
        self.trainer = make_trainer(project, self.info, self.scene, device, report)
        self.box_from_world = self.info.box(load_project(project)).box_from_world
        self.baked: BakedField | None = None
        self._measured_from = 0.0

    def step(self, progress: float) -> tuple[int, float]:
        trainer, trial = self.trainer, self.trial
        timer = clock_of(trial)
        if trial.seconds and trainer.steps == MEASURED[0]:
            self._measured_from = timer()
        elif trial.seconds and trainer.steps == MEASURED[1]:
            each = (timer() - self._measured_from) / (MEASURED[1] - MEASURED[0])
            trainer.largest_batch = largest_batch(self.info.config.train, trial.seconds, each)
        trainer.step(progress)
        measured = trainer.take_measured()
        return measured.rays, float(measured.mse)

    def finish(self, report: Reporter) -> None:
        if self.trial.baked:
            self.baked = self._baked(report)
        else:
            self.trainer.model.eval().requires_grad_(False)
            self.trainer.model.refine(check=report.check)

    def _baked(self, report: Reporter) -> BakedField:
        """The trained field as voxels, by way of a run of the benchmark's copy of the project."""
        place = TrainingFolder.anew(self.project, self.trial.name)
        self.info.origin = Origin(project=load_project(self.project).uuid, training=uuid.uuid4().hex)
        save_info(place.folder, self.info)
        state = {"progress": 1.0, "training": self.info.origin.training}
        save_checkpoint(place.folder / CHECKPOINT, self.trainer, state)
        place.keep()
        bake(BakeParams(project=self.project, run=self.trial.name), report)
        baked = load_baked(self.project, self.trial.name, self.info)
        shutil.rmtree(place.folder)
        return baked

    def frame(self, camera: Camera, pose: np.ndarray, semantics: bool, check: Callable[[], None]) -> Frame:
        shown = self.trainer.model if self.baked is None else self.baked
        return render_view(shown, camera, pose, self.background, semantics, check)

    def sampling_share(self, camera: Camera, pose: np.ndarray, report: Reporter) -> float:
        if self.baked is not None:
            return 0.0
        rays = CameraRays([camera], pose[None], self.device)
        with torch.no_grad():
            sampling, network, _, _ = split_times(self.trainer.model, rays, camera.width * camera.height, report)
        return sampling / max(sampling + network, 1e-9)

    def parameter_count(self) -> int:
        return self.trainer.model.field.parameter_count()


class BaselineTrainee(Trainee):
    def __init__(self, trial: Trial, project: Path, device: torch.device, report: Reporter) -> None:
        self.device = device
        self.info, self.scene = planned_run(trial, project, device)
        config = self.info.config
        self.box_from_world = self.info.box(load_project(project)).box_from_world
        self.store = PixelStore(
            self.scene,
            [i for i, view in enumerate(self.scene.views) if view.name in self.info.images],
            self.info.class_ids,
            self.box_from_world,
            self.info.image_size,
            device,
            report,
        )
        degrade(self.store, config)
        setup = Setup(
            classes=len(self.info.class_ids),
            images=len(self.store.views),
            contracted=self.info.contracted,
            background=self.background,
            rays=trial.step_rays,
            device=device,
        )
        self.method: Baseline = make_baseline(trial.method, setup, trial.seed)
        self.method.timer = clock_of(trial)
        self.generator = torch.Generator(device).manual_seed(trial.seed)

    def step(self, progress: float) -> tuple[int, float]:
        batch = self.store.batch(self.store.random_pixels(self.method.rays, self.generator))
        rays = camera_rays(self.store.rays, batch.image, batch.pixel, training=True)
        return len(rays), self.method.train_step(batch, rays, progress, self.generator)

    def finish(self, report: Reporter) -> None:
        self.method.eval()

    def frame(self, camera: Camera, pose: np.ndarray, semantics: bool, check: Callable[[], None]) -> Frame:
        cameras = CameraRays([camera], pose[None], self.device)
        rows = []
        for pixel in torch.arange(camera.width * camera.height, device=self.device).split(self.method.chunk):
            check()
            rays = camera_rays(cameras, torch.zeros_like(pixel), pixel, training=False)
            sees = ~rays.directions[:, 0].isnan()
            if not bool(sees.all()):
                ahead = cameras.rotation[0, :, 2].expand_as(rays.directions)
                directions = torch.where(sees[:, None], rays.directions, ahead)
                rays = Rays(rays.origins, directions.contiguous(), rays.radii.nan_to_num(0.0))
            out = self.method.render(rays, semantics)
            distance = torch.where(out.opacity > LEAST, out.depth / out.opacity.clamp(min=LEAST), torch.nan)
            columns = [
                out.color,
                out.opacity[:, None],
                (distance * (rays.directions @ cameras.rotation[0, :, 2]))[:, None],
            ]
            columns.append(rays.origins + rays.directions * distance[:, None])
            if out.probabilities is not None:
                columns.append(out.probabilities)
            rows.append(torch.cat([column * sees[:, None] for column in columns], 1).cpu())
        image = torch.cat(rows).reshape(camera.height, camera.width, -1).numpy()
        picture = Picture(np.ascontiguousarray(image[..., :4]), "srgb", "associated")
        probabilities = image[..., 8:] if image.shape[-1] > 8 else None
        return Frame(picture, self.background, image[..., 4], probabilities, image[..., 5:8])

    def sampling_share(self, camera: Camera, pose: np.ndarray, report: Reporter) -> float:
        self.method.network_seconds, begin = 0.0, self.method.timer()
        self.frame(camera, pose, True, report.check)
        return 1 - self.method.network_seconds / max(self.method.timer() - begin, 1e-9)

    def parameter_count(self) -> int:
        return self.method.parameter_count()


def clock_of(trial: Trial) -> Callable[[], float]:
    """Seconds, as the trial's budget counts them."""
    return time.process_time if trial.clock == "processor" else time.perf_counter


def planned_run(trial: Trial, project: Path, device: torch.device) -> tuple[RunInfo, Scene]:
    """The cube, classes and pictures of a trial, the same for all methods."""
    own = {**trial.settings, "scene.image_size": str(trial.image_size), "train.seed": str(trial.seed)}
    config = make_config("standard", {**own, "train.noise": str(trial.noise)})
    return plan_run(project, "standard", config, device)


def make_trainee(trial: Trial, project: Path, device: torch.device, report: Reporter) -> Trainee:
    """What a trial trains, before its first step. Raises SettingError."""
    kind = OurTrainee if trial.method == "ours" else BaselineTrainee
    return kind(trial, project, device, report)
