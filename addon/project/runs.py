"""The training runs of a project: which there are, how good they are, how long they take."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from .. import machine
from .snapshot import cached_json, project, read_json

HOLDOUT = 8  # every so many photos one is held out, unless a run says otherwise
RETRAINED = ".new"  # in runs: those that are trained anew, until they take the place of the old ones
TIMES_FILE = "training_times.json"  # of the machine: seconds by preset


def runs(folder: Path | None) -> list[str]:
    """Names of the runs that have a trained field, newest last."""
    if folder is None:
        return []
    found = [path.parent for path in (folder / "runs").glob("[!.]*/*.safetensors")]
    return list(dict.fromkeys(run.name for run in sorted(found, key=lambda run: run.stat().st_mtime)))


def has_run(folder: Path | None, run: str) -> bool:
    return folder is not None and any((folder / "runs" / run).glob("*.safetensors"))


def can_resume(folder: Path | None, run: str) -> bool:
    """Whether a training of the run stopped before its end and left a checkpoint."""
    if folder is None:
        return False
    if has_run(folder, f"{RETRAINED}/{run}"):
        return True
    if not has_run(folder, run):
        return False
    # Training writes its metrics at the end, and removes those of before at the start.
    return "train" not in (cached_json(folder / "runs" / run / "metrics.json") or {})


def held_out(folder: Path | None, run: str) -> bool:
    """Whether the run left photos out of its training, to measure it with."""
    info = cached_json(folder / "runs" / run / "config.json") if folder else None
    every = info.get("holdout", HOLDOUT) if isinstance(info, dict) else HOLDOUT
    placed = [image for image in (project(folder) or {}).get("images", []) if image.get("status", "ok") == "ok"]
    splits = [image.get("split", "auto") for image in placed]
    return every > 0 and ("test" in splits or splits.count("auto") >= every)


def evaluation(folder: Path | None, run: str) -> dict[str, Any]:
    """What `evaluate` found on the held-out photos of a run; empty when it was not measured."""
    metrics = cached_json(folder / "runs" / run / "metrics.json") if folder else None
    return (metrics.get("test") or {}) if isinstance(metrics, dict) else {}


def quality(folder: Path | None, run: str) -> str:
    """Measured quality of a run in a few words; empty when it was not measured."""
    measured = evaluation(folder, run)
    psnr, miou = measured.get("psnr"), measured.get("miou")
    words = [f"{psnr:.1f} dB" if psnr is not None else "", f"mIoU {miou:.2f}" if miou is not None else ""]
    return ", ".join(word for word in words if word)


def time_estimate(folder: Path | None, settings: Any) -> float | None:
    """Seconds that training with this preset took the last time, in this project or else on this machine; None when
    that says nothing."""
    if settings.time_limit > 0 or settings.steps > 0:
        return None
    for step in reversed((project(folder) or {}).get("provenance", [])):
        same = step.get("verb") == "train" and step.get("settings", {}).get("preset") == settings.preset
        if same and not step["settings"].get("time_limit") and not step["settings"].get("steps"):
            return step.get("result", {}).get("seconds")
    times = cached_json(machine.user_folder() / TIMES_FILE)
    return times.get(settings.preset) if isinstance(times, dict) else None


def remember_time(preset: str, seconds: float) -> None:
    """Note how long a whole training with a preset took on this machine, where the disk takes it."""
    # Not at the top: enabling the extension must be quick.
    from ...nerfcore.errors import DiskError
    from ...nerfcore.files import write_json

    path = machine.user_folder() / TIMES_FILE
    with suppress(DiskError):
        write_json(path, {**(read_json(path) or {}), preset: seconds})
