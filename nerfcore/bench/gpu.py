"""What only a GPU can show: the asked figures, host synchronisations inside a step, and the page they go to."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import torch

from ..config import make_config
from ..kernels.device import use_device
from ..progress import Reporter
from ..train.prepare import make_trainer, plan_run

ASKED = {
    "lego_400: PSNR after 30 s (dB)": ("≥", 33.0),
    "800×800 colour (frames/s)": ("≥", 60.0),
    "800×800 colour and classes (frames/s)": ("≥", 120.0),
    "peak memory, training (MiB)": ("≤", 1.2e9 / 2**20),
    "peak memory, rendering (MiB)": ("≤", 1.2e9 / 2**20),
    "host synchronisations in an ordinary step": ("≤", 0.0),
    "share of the steps that were recorded": ("≥", 0.5),
}
WARM_STEPS, COUNTED_STEPS = 300, 32  # past the warm-up of the grid; two updates of it


def located(caught: Sequence[Any]) -> Counter[str]:
    """How often each line of ours made the host wait, from PyTorch's warnings in "warn" mode."""
    places = Counter[str]()
    for warning in caught:
        if "synchronizing CUDA operation" in str(warning.message):
            path = Path(warning.filename)
            places[f"{path.parent.name}/{path.name}:{warning.lineno}"] += 1
    return places


def count_synchronisations(step: Callable[[int], None], first: int, steps: int, every: int) -> tuple[int, Counter[str]]:
    """Call `step(i)` for `steps` indices from `first` on, less each `every`-th, and count what made the host wait.

    Returns how many steps were counted and the places, over all of them.
    """
    places, counted = Counter[str](), 0
    for index in range(first, first + steps):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            step(index)
        if index % every:
            counted += 1
            places += located(caught)
    return counted, places


def step_synchronisations(project: Path, report: Reporter) -> tuple[float, dict[str, int], float]:
    """Host synchronisations a training step, outside of updates of the occupancy grid, and where; the share of the steps
    that replayed a recording. Needs a GPU."""
    device = use_device()
    info, scene = plan_run(project, "standard", make_config("standard"), device)
    trainer = make_trainer(project, info, scene, device, report)
    report.stage("Looking for host synchronisation")
    for index in range(WARM_STEPS):
        trainer.step(index / 20000)
        report.check()
    replayed = trainer.replay.replayed
    torch.cuda.set_sync_debug_mode("warn")
    try:
        counted, places = count_synchronisations(
            lambda index: trainer.step(index / 20000), WARM_STEPS, COUNTED_STEPS, info.config.sampling.update_every
        )
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return sum(places.values()) / counted, dict(places), (trainer.replay.replayed - replayed) / COUNTED_STEPS


def kernel_checks(report_file: Path | None) -> str | None:
    """Outcome of the tests of kernels against their twins, from pytest's JUnit file; None when they did not run."""
    if report_file is None or not report_file.is_file():
        return None
    suites = list(ElementTree.parse(report_file).getroot().iter("testsuite"))
    total, skipped, bad = (
        sum(int(s.get(key, 0)) for s in suites for key in keys)
        for keys in (("tests",), ("skipped",), ("failures", "errors"))
    )
    ran = total - skipped
    return f"{ran - bad} of {ran} agree with their twins" if ran else None


def figures(
    rows: Sequence[dict[str, Any]], synchronisations: float | None, recorded: float | None
) -> dict[str, float | None]:
    """The asked figures from the suite's rows; None where one was not measured."""

    def row(scene: str) -> dict[str, Any]:
        return next((r for r in rows if r["scene"] == scene), {})

    def largest(key: str) -> float | None:
        return max((r[key] for r in rows if r.get(key) is not None), default=None)

    plain, labelled = row("lego_400"), next((r for r in rows if r.get("miou") is not None), {})
    return {
        "lego_400: PSNR after 30 s (dB)": plain.get("psnr") if plain.get("budget") == "30 s" else None,
        "800×800 colour (frames/s)": plain.get("fps_800"),
        "800×800 colour and classes (frames/s)": labelled.get("fps_800"),
        "peak memory, training (MiB)": largest("memory_training_mb"),
        "peak memory, rendering (MiB)": largest("memory_rendering_mb"),
        "host synchronisations in an ordinary step": synchronisations,
        "share of the steps that were recorded": recorded,
    }


def section(
    origin: str | None, checks: str | None, values: dict[str, float | None], table: str, places: dict[str, int]
) -> str:
    """The text of the page's GPU section; `origin`: the sentence that tells machine and commit."""
    if origin is None:
        return (
            "Not measured: no NVIDIA GPU was at hand. Every kernel compiles for sm_75, 86, 89, 90 and 120\n"
            "(`make gpu-compile`, resources in [kernels.md](kernels.md)); `make gpu-check` fills this section in where\n"
            "there is a GPU.\n"
        )
    lines = [f"{origin} Command: `make gpu-check`. Kernels: {checks or 'not measured'}.", ""]
    lines += ["| what | asked | measured | |", "| --- | --- | --- | --- |"]
    for name, (relation, limit) in ASKED.items():
        value = values.get(name)
        met = value is not None and (value >= limit if relation == "≥" else value <= limit)
        shown = "not measured" if value is None else f"{value:.4g}"
        lines.append(
            f"| {name} | {relation} {limit:.4g} | {shown} | {'' if value is None else 'met' if met else 'missed'} |"
        )
    lines += ["", table, ""]
    if places:
        lines += ["The host waited at: " + ", ".join(f"`{p}` ({n}×)" for p, n in places.items()) + ".", ""]
    return "\n".join(lines)
