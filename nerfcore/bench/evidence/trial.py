"""One trial: train until the budget is used up, compare with held-out photos, remember the figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import psutil
import torch

from ...errors import FieldworkError, TrainingError
from ...files import write_json
from ...kernels.device import use_device
from ...kernels.runtime import compile_seconds
from ...progress import Reporter
from ...train.losses import psnr
from ..machine import taken
from .perceptual import Perceptual
from .protocol import Trial
from .scores import scored
from .trainees import Trainee, clock_of, make_trainee

POINTS = 60  # of the curve


def _begin_peak(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def _peak(device: torch.device) -> int | None:
    """Peak memory in MiB of a GPU since `_begin_peak`; None on the CPU, where one process runs all trials."""
    return round(torch.cuda.max_memory_allocated(device) / 2**20) if device.type == "cuda" else None


def trial_file(trial: Trial, out: Path) -> Path:
    return out / "trials" / f"{trial.name}.json"


def stored(trial: Trial, out: Path) -> dict[str, Any] | None:
    """The figures of a trial that was finished before."""
    path = trial_file(trial, out)
    if not path.is_file():
        return None
    found = json.loads(path.read_text(encoding="utf-8"))
    return found if found["trial"] == trial.model_dump(mode="json") else None


def run_trial(
    trial: Trial, project: Path, out: Path, perceptual: Perceptual | None, report: Reporter
) -> dict[str, Any]:
    """Train, compare and store; returns {"trial", "taken", "load", "steps", "rays", "seconds", "curve", figures…}.

    Raises:
        TrainingError: the loss is no longer a number. Cancelled.
    """
    device = use_device()
    _begin_peak(device)
    trainee = make_trainee(trial, project, device, report)
    report.stage("Training")
    spent = _trained(trial, trainee, report)
    training = _peak(device)
    _begin_peak(device)
    trainee.finish(report)
    report.stage("Comparing")
    figures = scored(trial, trainee, project, out, perceptual, report)
    result = {
        "trial": trial.model_dump(mode="json"),
        "taken": taken().model_dump(mode="json"),
        "load": round(psutil.getloadavg()[0], 2),
        **spent,
        **figures,
        "params_m": round(trainee.parameter_count() / 1e6, 3),
        "memory_training_mb": training,
        "memory_rendering_mb": _peak(device),
    }
    write_json(trial_file(trial, out), result)
    return result


def _trained(trial: Trial, trainee: Trainee, report: Reporter) -> dict[str, Any]:
    """Train until the budget is used up: {"steps", "rays", "seconds", "curve": (seconds, rays, PSNR of its rays)}."""
    timer = clock_of(trial)
    begin, compiled = timer(), compile_seconds()
    steps = rays = 0
    seconds, progress, last, since = 0.0, 0.0, 0.0, [0.0, 0]
    curve: list[list[float]] = []
    while progress < 1:
        drawn, mse = trainee.step(progress)
        if not mse < float("inf"):
            raise TrainingError(f"{trial.title} diverged: the loss is no longer a number.")
        steps, rays = steps + 1, rays + drawn
        seconds = timer() - begin - (compile_seconds() - compiled)
        progress = rays / trial.rays if trial.rays else seconds / (trial.seconds or 1.0)
        since = [since[0] + mse, since[1] + 1]
        if progress >= last + 1 / POINTS or progress >= 1:
            curve.append([round(seconds, 3), rays, round(psnr(since[0] / since[1]), 3)])
            last, since = progress, [0.0, 0]
        report.progress(min(progress, 1.0), f"step {steps}, {curve[-1][2]:.1f} dB" if curve else f"step {steps}")
        report.check()
    return {"steps": steps, "rays": rays, "seconds": round(seconds, 2), "curve": curve}


def failed(trial: Trial, error: FieldworkError) -> dict[str, Any]:
    """What stands for a trial that could not be finished."""
    return {"trial": trial.model_dump(mode="json"), "error": str(error)}
