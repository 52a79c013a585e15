"""The verb `train`: run the loop, report, checkpoint, stop when told."""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..config import make_config
from ..data.box import box_poses
from ..data.pixels import training_size
from ..data.scene import Scene
from ..errors import Cancelled, DiskError, ProjectError, TrainingError
from ..files import atomic_path, disk_errors, write_json
from ..geometry.similarity import transform_points
from ..images.encode import write_picture
from ..kernels.device import use_device
from ..kernels.runtime import compile_seconds
from ..params import TrainParams
from ..progress import Reporter
from ..project.runs import (
    CHECKPOINT,
    EVENTS,
    INFO,
    METRICS,
    TrainingFolder,
    cut_events,
    read_events,
)
from ..project.store import load_project, record_step
from ..render.image import background_of, render_view
from ..render.model import Model
from ..render.run import (
    PIXEL_FEATURES,
    REFINED_POSES,
    Origin,
    RunInfo,
    save_info,
)
from ..render.unfinished import Unfinished
from ..verdict import train_verdict
from .checkpoint import is_finite, restore, save_checkpoint
from .closed_picture import closed_picture, picture_closed
from .initial_state import InitialState
from .inputs import training_inputs, training_length
from .pose_refinement import write_poses
from .prepare import make_trainer, plan_run, without_effect
from .results import Measured
from .resume import place_to_resume, resumable, saved_state
from .schedule import largest_batch
from .trainer import Trainer
from .voxel_init import save_features, why_without_effect

# Not tuned: the next two.
MOST_DROPPED = 0.01  # share of the rays that may be left out without a word
MEASURED_STEPS = (16, 48)  # the steps between these say how fast the machine is
PREVIEW_PAUSE = 20  # times what a preview costs, before the next one


class _Clock:
    """Seconds of training, without kernel compilation, across resumed sessions."""

    def __init__(self, before: float) -> None:
        self.before, self.begin, self.compiled = before, time.perf_counter(), compile_seconds()

    def seconds(self) -> float:
        return self.before + time.perf_counter() - self.begin - (compile_seconds() - self.compiled)


def train(params: TrainParams, report: Reporter) -> dict[str, Any]:
    """Train a run of a project until its steps or its time are used up.

    A run that is there already stays as it is until the new training has a checkpoint; then it is replaced.

    Returns:
        {"run", "steps", "seconds", "psnr_train", "checkpoint", "verdict", …}
    Raises:
        TrainingError, ProjectError, SettingError, DiskError, Cancelled (after writing a checkpoint).
    """
    project_folder = Path(params.project)
    device = use_device()
    place = place_to_resume(project_folder, params.run, report) if params.resume else None
    saved = None
    if place is not None:
        info, scene = resumable(place, params, report)
        saved = saved_state(place, info, device)
    else:
        info, scene = _planned(params, device, report)
        place = TrainingFolder.anew(project_folder, params.run)
    save_info(place.folder, info)
    for half_written in place.folder.glob(".*.safetensors"):  # by a process that was killed
        half_written.unlink()
    trainer = make_trainer(project_folder, info, scene, device, report)
    points = transform_points(info.box(load_project(project_folder)).box_from_world, scene.points.xyz)
    picture_closed(place.folder, trainer.space, trainer.store.rays.center, torch.from_numpy(points).float())
    initial = InitialState(trainer) if trainer.sky is not None else None
    state = {"seconds": 0.0, "progress": 0.0, "psnr": None, "largest_batch": None}
    if saved is not None:
        try:
            restore(trainer, *saved)
        except (RuntimeError, KeyError) as error:
            raise ProjectError(
                f"{place.folder / CHECKPOINT} holds a field of another shape than {INFO} beside it describes.",
                "Train the run anew, without --resume.",
            ) from error
        cut_events(place.folder, trainer.steps)
        state.update({key: saved[1].get(key) for key in state})
        trainer.largest_batch = state["largest_batch"]
        del saved
    limit = training_length(params.steps, params.time_limit, info.config)["steps"]
    useless = why_without_effect(info.config.field, trainer.model.field.grid, limit)
    if useless is not None:
        report.warn(f"field.voxel_init has no effect: {useless}.")
    report.stage("Training")
    loop = _Loop(trainer, initial, info, place, state, limit, params.time_limit, report)
    del initial
    model = trainer.model
    del trainer  # another one takes its place where training starts over
    try:
        with report.watching(Unfinished(project_folder, params.run, info, scene, model)) as show:
            loop.run(_preview(project_folder, place, info, scene, model), show)
    except Cancelled:
        loop.checkpoint()
        raise
    loop.checkpoint()
    loop.keep()
    result = {"run": params.run, **loop.result()}
    config = info.config
    curve = read_events(place.folder)
    result["verdict"] = train_verdict(result, curve, config.sampling.warmup, config.train.steps)
    if loop.trainer.poses is not None:
        result["pose_shift"] = loop.trainer.poses.shift(info.box(load_project(project_folder)).world_from_box)
    write_json(place.folder / METRICS, {"train": result})
    # What was done: a resumed run keeps the settings it began with.
    done = {"preset": info.preset, "holdout": info.holdout, "config": info.config.model_dump(mode="json")}
    record_step(project_folder, "train", params.model_dump(mode="json") | done, result, info.origin.inputs)
    return result


def _planned(params: TrainParams, device: torch.device, report: Reporter) -> tuple[RunInfo, Scene]:
    """A new run with the fingerprint of its inputs, and its scene. Raises ProjectError, SettingError, TrainingError."""
    project, config = Path(params.project), make_config(params.preset, params.set)
    info, scene = plan_run(project, params.preset, config, device, params.holdout)
    for text in without_effect(config, len(info.class_ids)):
        report.warn(text)
    info.origin = Origin(
        project=load_project(project).uuid,
        training=uuid.uuid4().hex,
        inputs=training_inputs(project, params, config),
    )
    return info, scene


class _Loop:
    """Steps until the limit; events twice a second, previews and checkpoints as configured."""

    def __init__(
        self,
        trainer: Trainer,
        initial: InitialState | None,
        info: RunInfo,
        place: TrainingFolder,
        state: dict[str, Any],
        steps: int | None,
        seconds: float | None,
        report: Reporter,
    ) -> None:
        self.trainer, self.info, self.place, self.state = trainer, info, place, state
        self.step_limit, self.time_limit, self.report = steps, seconds, report
        self.clock = _Clock(state["seconds"])
        self.initial = initial  # while training may have to start over
        self.warned: set[str] = set()
        self.measured_from: float | None = None  # seconds at the first of `MEASURED_STEPS`

    def progress(self) -> float:
        """Position in the schedule, in [0, 1]: of the time limit when there is one, else of the steps."""
        if self.time_limit:
            done = self.clock.seconds() / self.time_limit
            return max(done, self.trainer.steps / self.step_limit) if self.step_limit else done
        assert self.step_limit is not None
        return self.trainer.steps / self.step_limit

    def run(self, preview: Callable[[], Path], show: Callable[[], None]) -> None:
        train = self.info.config.train
        last_event = last_checkpoint = last_preview = time.perf_counter()
        cost = 0.0  # seconds of the last preview
        seen, began = False, self.trainer.steps
        with disk_errors(self.place.folder):
            while (progress := self.progress()) < 1:
                if self.trainer.steps in MEASURED_STEPS and self.state["largest_batch"] is None:
                    self._fit_into_time()
                self.trainer.step(progress)
                self._start_over_if_needed(progress)
                show()
                self.state.update(progress=progress, seconds=self.clock.seconds())
                now = time.perf_counter()
                if now - last_event >= 0.5:
                    self._write_event(progress, now - last_event)
                    last_event = now
                if now - last_checkpoint >= train.checkpoint_every:
                    self.checkpoint()
                    if self._kept_early() and seen:
                        self.report.event("preview", path=str(preview()))  # the one told of lay elsewhere
                    last_checkpoint = time.perf_counter()
                if now - last_preview >= max(train.preview_every, PREVIEW_PAUSE * cost):
                    self.report.event("preview", path=str(preview()))
                    seen = True
                    last_preview = time.perf_counter()
                    cost = last_preview - now
                self.report.check()
            self.state["progress"] = 1.0
            self._write_event(1.0, max(time.perf_counter() - last_event, 1e-3))
            if self.state["psnr"] is None and self.trainer.steps > began:
                raise _diverged()

    def _start_over_if_needed(self, progress: float) -> None:
        """Start over, with masks of the sky, where these have turned out to be needed."""
        sky, initial = self.trainer.sky, self.initial
        if sky is None or initial is None:
            return
        if sky.decide(self.trainer.steps, progress):
            self.report.note("Much of what is near passes for sky so far: training starts over, with masks of the sky.")
            self.trainer = initial.restarted(self.trainer)
            (self.place.folder / EVENTS).write_bytes(b"")
        if sky.needed is not None:
            self.initial = None

    def _fit_into_time(self) -> None:
        """Let a short training have enough steps, by how long its first ones take."""
        first, last = MEASURED_STEPS
        if self.time_limit is None:
            return
        if self.trainer.steps == first:
            self.measured_from = self.clock.seconds()
        elif self.measured_from is not None:
            each = (self.clock.seconds() - self.measured_from) / (last - first)
            self.trainer.largest_batch = largest_batch(self.info.config.train, self.time_limit, each)
            self.state["largest_batch"] = self.trainer.largest_batch

    def _warn(self, measured: Measured) -> None:
        """Say once what keeps training from using all that it computes."""
        told = {}
        if measured.dropped > MOST_DROPPED * measured.rays:
            share = measured.dropped / max(measured.rays, 1)
            told["dropped"] = f"{share:.1%} of the rays were left out for want of capacity; their number follows soon."
        if measured.skipped + measured.lost_rows > 0:
            told["not finite"] = (
                f"Gradients that were not finite were left out ({measured.skipped} steps, {measured.lost_rows} rows of "
                "the grid). If it goes on, lower train.network_rate and train.grid_rate."
            )
        for name, text in told.items():
            if name not in self.warned:
                self.warned.add(name)
                self.report.warn(text)

    def _write_event(self, progress: float, elapsed: float) -> None:
        measured = self.trainer.take_measured()
        self._warn(measured)
        if int(measured.finite) == 0:  # the trainer says when that goes on for too long
            return
        self.state["psnr"] = round(measured.psnr, 3)
        values = {
            "step": self.trainer.steps,
            "seconds": round(self.clock.seconds(), 2),
            "loss": round(measured.mean_loss, 6),
            "psnr": self.state["psnr"],
            "rays_per_second": round(measured.rays / elapsed),
        }
        counts = {"dropped": measured.dropped, "skipped": measured.skipped, "lost_rows": measured.lost_rows}
        values |= {name: count for name, count in counts.items() if count > 0}
        with open(self.place.folder / EVENTS, "a", encoding="utf-8") as events:
            events.write(json.dumps(values) + "\n")
        self.report.event("train", **values)
        self.report.progress(progress, f"step {values['step']}, {values['psnr']:.1f} dB")

    def checkpoint(self) -> None:
        trainer, info = self.trainer, self.info
        if not is_finite(trainer):  # what was saved before is worth more
            raise _diverged()
        save_checkpoint(self.place.folder / CHECKPOINT, trainer, {**self.state, "training": info.origin.training})
        if trainer.poses is not None:
            path = self.place.folder / REFINED_POSES
            write_poses(path, trainer.poses, trainer.store.rays, info.images, np.array(info.sfm_from_box))
        if trainer.pixel_features is not None:
            save_features(self.place.folder / PIXEL_FEATURES, trainer.pixel_features)

    def result(self) -> dict[str, Any]:
        """What the verb tells of the training, after its end."""
        trainer = self.trainer
        return {
            "steps": trainer.steps,
            "seconds": round(self.clock.seconds(), 2),
            "compile_seconds": round(compile_seconds(), 2),
            "psnr_train": self.state["psnr"],
            "checkpoint": str(self.place.folder / CHECKPOINT),
            "params_m": round(trainer.model.field.parameter_count() / 1e6, 2),
            "device": str(trainer.device),
            "closed_picture": closed_picture(self.place.folder),
            "backend": trainer.backend.name,
            "precision": str(trainer.model.field.dtype).removeprefix("torch."),
        }

    def keep(self) -> None:
        """Let the run take the place of the one before it. Raises DiskError."""
        self.place.keep()

    def _kept_early(self) -> bool:
        """Replace the run that was there, now that there is a checkpoint; whether its folder is another one now."""
        if not self.place.beside:
            return False
        try:
            self.keep()
        except DiskError as error:  # somebody reads the old one: the end of training tries again
            self.report.warn(str(error))
            return False
        return True


def _diverged() -> TrainingError:
    return TrainingError(
        "Training diverged: what it learns is no longer a number.", "Lower train.network_rate and train.grid_rate."
    )


def _preview(
    project_folder: Path, place: TrainingFolder, info: RunInfo, scene: Scene, model: Model
) -> Callable[[], Path]:
    """A function that renders a small held-out view to preview.png in the run's folder and returns its path."""
    view = scene.views[scene.test[len(scene.test) // 2] if scene.test else scene.train[0]]
    camera = view.camera.resized(*training_size(view.camera, 256))
    pose = box_poses([view], info.box(load_project(project_folder)).box_from_world)[0]

    def preview() -> Path:
        path = place.folder / "preview.png"
        frame = render_view(model, camera, pose, background_of(info), semantics=False)
        with atomic_path(path) as temporary:
            write_picture(temporary, frame.color)
        return path

    return preview
