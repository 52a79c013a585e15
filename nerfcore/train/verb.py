"""The verb `train`: run the loop, report, checkpoint, stop when told."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from ..config import make_config
from ..data.box import box_poses
from ..data.load import load_scene
from ..data.pixels import training_size
from ..data.scene import Scene
from ..errors import Cancelled, TrainingError
from ..files import atomic_path, disk_errors, write_json
from ..images.encode import write_picture
from ..kernels.device import use_device
from ..kernels.runtime import compile_seconds
from ..params import TrainParams
from ..progress import Reporter
from ..project.store import load_project, record_step
from ..render.image import background_of, render_view
from ..render.model import Model
from ..render.run import (
    CHECKPOINT,
    PIXEL_FEATURES,
    REFINED_POSES,
    RunInfo,
    load_info,
    read_checkpoint,
    run_folder,
    save_info,
)
from .checkpoint import restore, save_checkpoint
from .pose_refinement import write_poses
from .prepare import make_trainer, plan_run
from .trainer import Trainer
from .voxel_init import save_features

PREVIEW_PAUSE = 20  # times what a preview costs, before the next one


class _Clock:
    """Seconds of training, without kernel compilation, across resumed sessions."""

    def __init__(self, before: float) -> None:
        self.before, self.begin, self.compiled = before, time.perf_counter(), compile_seconds()

    def seconds(self) -> float:
        return self.before + time.perf_counter() - self.begin - (compile_seconds() - self.compiled)


def train(params: TrainParams, report: Reporter) -> dict[str, Any]:
    """Train a run of a project until its steps or its time are used up.

    Returns:
        {"run", "steps", "seconds", "psnr_train", "checkpoint", …}
    Raises:
        TrainingError, ProjectError, SettingError, DiskError, Cancelled (after writing a checkpoint).
    """
    project_folder = Path(params.project)
    folder = run_folder(project_folder, params.run)
    device = use_device()
    saved = None
    if params.resume and (folder / CHECKPOINT).is_file():
        info, scene = load_info(project_folder, params.run), load_scene(project_folder)
        saved = read_checkpoint(folder / CHECKPOINT, device)
    else:
        info, scene = plan_run(project_folder, params.preset, make_config(params.preset, params.set), device)
        with disk_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        for stale in (CHECKPOINT, REFINED_POSES, PIXEL_FEATURES, "events.jsonl", "metrics.json"):
            (folder / stale).unlink(missing_ok=True)
        save_info(project_folder, params.run, info)
    for half_written in folder.glob(".*.safetensors"):  # by a process that was killed
        half_written.unlink()
    trainer = make_trainer(project_folder, info, scene, device, report)
    state = {"seconds": 0.0, "progress": 0.0, "psnr": None}
    if saved is not None:
        restore(trainer, *saved)
        state.update({key: saved[1][key] for key in state})
        del saved
    limit = params.steps or (None if params.time_limit else info.config.train.steps)
    report.stage("Training")
    loop = _Loop(trainer, info, folder, state, limit, params.time_limit, report)
    try:
        loop.run(_preview(project_folder, folder, info, scene, trainer.model))
    except Cancelled:
        loop.checkpoint()
        raise
    loop.checkpoint()
    result = {
        "run": params.run,
        "steps": trainer.steps,
        "seconds": round(loop.clock.seconds(), 2),
        "compile_seconds": round(compile_seconds(), 2),
        "psnr_train": loop.state["psnr"],
        "checkpoint": str(folder / CHECKPOINT),
        "params_m": round(trainer.model.field.parameter_count() / 1e6, 2),
        "device": str(device),
    }
    if trainer.poses is not None:
        result["pose_shift"] = trainer.poses.shift(info.box(load_project(project_folder)).world_from_box)
    write_json(folder / "metrics.json", {"train": result})
    record_step(project_folder, "train", params.model_dump(mode="json"), result)
    return result


class _Loop:
    """Steps until the limit; events twice a second, previews and checkpoints as configured."""

    def __init__(
        self,
        trainer: Trainer,
        info: RunInfo,
        folder: Path,
        state: dict[str, Any],
        steps: int | None,
        seconds: float | None,
        report: Reporter,
    ) -> None:
        self.trainer, self.info, self.folder, self.state = trainer, info, folder, state
        self.step_limit, self.time_limit, self.report = steps, seconds, report
        self.clock = _Clock(state["seconds"])

    def progress(self) -> float:
        """Position in the schedule, in [0, 1]: of the time limit when there is one, else of the steps."""
        if self.time_limit:
            done = self.clock.seconds() / self.time_limit
            return max(done, self.trainer.steps / self.step_limit) if self.step_limit else done
        assert self.step_limit is not None
        return self.trainer.steps / self.step_limit

    def run(self, preview: Callable[[], Path]) -> None:
        train = self.info.config.train
        last_event = last_checkpoint = last_preview = time.perf_counter()
        cost = 0.0  # seconds of the last preview
        with disk_errors(self.folder), open(self.folder / "events.jsonl", "a", encoding="utf-8") as events:
            while (progress := self.progress()) < 1:
                self.trainer.step(progress)
                self.state.update(progress=progress, seconds=self.clock.seconds())
                now = time.perf_counter()
                if now - last_event >= 0.5:
                    self._write_event(progress, now - last_event, events)
                    last_event = now
                if now - last_checkpoint >= train.checkpoint_every:
                    self.checkpoint()
                    last_checkpoint = time.perf_counter()
                if now - last_preview >= max(train.preview_every, PREVIEW_PAUSE * cost):
                    self.report.event("preview", path=str(preview()))
                    last_preview = time.perf_counter()
                    cost = last_preview - now
                self.report.check()
            self.state["progress"] = 1.0
            self._write_event(1.0, max(time.perf_counter() - last_event, 1e-3), events)

    def _write_event(self, progress: float, elapsed: float, events: TextIO) -> None:
        measured = self.trainer.take_measured()
        loss = float(measured.loss)
        if measured.steps == 0:
            return
        if not loss < float("inf"):
            raise TrainingError(
                "Training diverged: the loss is no longer a number.", "Lower train.network_rate and train.grid_rate."
            )
        self.state["psnr"] = round(measured.psnr, 3)
        values = {
            "step": self.trainer.steps,
            "seconds": round(self.clock.seconds(), 2),
            "loss": round(loss / measured.steps, 6),
            "psnr": self.state["psnr"],
            "rays_per_second": round(measured.rays / elapsed),
        }
        events.write(json.dumps(values) + "\n")
        events.flush()
        self.report.event("train", **values)
        self.report.progress(progress, f"step {values['step']}, {values['psnr']:.1f} dB")

    def checkpoint(self) -> None:
        trainer, info = self.trainer, self.info
        save_checkpoint(self.folder / CHECKPOINT, trainer, self.state)
        if trainer.poses is not None:
            path = self.folder / REFINED_POSES
            write_poses(path, trainer.poses, trainer.store.rays, info.images, np.array(info.sfm_from_box))
        if trainer.pixel_features is not None:
            save_features(self.folder / PIXEL_FEATURES, trainer.pixel_features)


def _preview(project_folder: Path, folder: Path, info: RunInfo, scene: Scene, model: Model) -> Callable[[], Path]:
    """A function that renders a small held-out view to preview.png in the run's folder and returns its path."""
    view = scene.views[scene.test[len(scene.test) // 2] if scene.test else scene.train[0]]
    camera = view.camera.resized(*training_size(view.camera, 256))
    pose = box_poses([view], info.box(load_project(project_folder)).box_from_world)[0]
    path = folder / "preview.png"

    def preview() -> Path:
        frame = render_view(model, camera, pose, background_of(info), semantics=False)
        with atomic_path(path) as temporary:
            write_picture(temporary, frame.color)
        return path

    return preview
