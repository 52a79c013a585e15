"""One training run of a benchmark: train, evaluate, measure, and remember the figures so that it is not repeated."""

from __future__ import annotations

import gc
import json
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from ..config import make_config
from ..data.load import load_scene
from ..errors import FieldworkError, ProjectError
from ..evaluate.speed import measure_speed
from ..evaluate.verb import evaluate
from ..files import write_json
from ..kernels.device import use_device
from ..params import EvaluateParams, Preset, TrainParams
from ..progress import Reporter
from ..project.store import load_project
from ..render.run import CHECKPOINT, load_info, load_trained, run_folder, settled_as
from ..train.verb import train
from .machine import peak_memory, taken

COUNTING_SIDE = 200  # of a frame that only counts samples per ray
# Guesses, only for the estimate of the time left.
SECONDS_PER_STEP, EVALUATION_SECONDS = 0.1, 60.0


@dataclass(frozen=True)
class Job:
    """A variant trained on a scene, until `steps` or `seconds` are used up.

    `sides`: frame sizes to time. `seed`: of the settings, where a suite trains several.
    """

    scene: str
    variant: str
    settings: dict[str, str] = field(default_factory=dict)
    steps: int | None = None
    seconds: float | None = None
    preset: Preset = "standard"
    sides: tuple[int, ...] = (COUNTING_SIDE,)
    seed: int | None = None

    @property
    def budget(self) -> str:
        return f"{self.steps} steps" if self.steps else f"{self.seconds:g} s"

    @property
    def name(self) -> str:
        """Name of its run and of its file."""
        seed = "" if self.seed is None else f"-seed-{self.seed}"
        return re.sub(r"[^\w.-]+", "-", f"bench-{self.scene}-{self.variant}-{self.budget}{seed}")

    @property
    def title(self) -> str:
        """Name of it for the user."""
        return f"{self.scene} {self.variant} {self.budget}" + ("" if self.seed is None else f", seed {self.seed}")

    @property
    def training_seconds(self) -> float:
        """Expected, not measured."""
        return self.seconds or (self.steps or 0) * SECONDS_PER_STEP

    @property
    def expected_seconds(self) -> float:
        return self.training_seconds + EVALUATION_SECONDS


Measure = Callable[[Job, Path, Reporter], dict[str, Any]]  # of a job whose field is in a project


class JobReporter(Reporter):
    """Turns the stages of one job into a share of the whole suite's progress."""

    def __init__(self, outer: Reporter, begin: float, share: float, job: Job, title: str) -> None:
        super().__init__()
        self.outer, self.begin, self.share, self.title = outer, begin, share, title
        trained = job.training_seconds / job.expected_seconds
        # Where in the job a stage begins and ends.
        self.stages = {
            "Training": (0.0, trained),
            "Rendering": (trained, trained + 0.8 * (1 - trained)),
            "Measuring": (trained + 0.8 * (1 - trained), 1.0),
        }
        self.inner, self.span = "", (0.0, 0.0)

    def stage(self, name: str) -> None:
        self.inner = name
        # What has no share of its own goes on where the stage before ended.
        self.span = self.stages.get(name.split(" ")[0], (self.span[1], self.span[1]))

    def progress(self, fraction: float, message: str = "") -> None:
        low, high = self.span
        done = low + (high - low) * min(fraction, 1.0)
        self.outer.progress(self.begin + self.share * done, f"{self.title}: {self.inner} {message}")

    def warn(self, message: str) -> None:
        self.outer.warn(f"{self.title}: {message}")

    def check(self) -> None:
        self.outer.check()


def load_result(job: Job, out: Path) -> dict[str, Any] | None:
    """The figures of a job that was finished before with the same settings."""
    path = out / "runs" / f"{job.name}.json"
    if not path.is_file():
        return None
    known = json.loads(path.read_text(encoding="utf-8"))
    return known if known["job"] == _description(job) else None


def _description(job: Job) -> dict[str, Any]:
    values = json.loads(json.dumps(asdict(job)))
    return {key: value for key, value in values.items() if key != "seed" or value is not None}


def run_job(
    job: Job, project: Path, out: Path, report: Reporter, keep: bool = False, more: Measure | None = None
) -> dict[str, Any]:
    """Train and measure; returns and stores {"job": …, figures…}. A run that was interrupted goes on.

    `keep`: the trained field stays in the project; else only its figures, pictures and curve do. `more`: measures what a
    suite adds to the figures while the trained field is there.
    """
    device = use_device()
    _reset_peak(device)
    trained = train(
        TrainParams(
            project=project,
            preset=job.preset,
            run=job.name,
            time_limit=job.seconds,
            steps=job.steps,
            set=job.settings,
            resume=interrupted(job, project),
        ),
        report,
    )
    memory = _peak(device)
    _reset_peak(device)
    evaluated = evaluate(EvaluateParams(project=project, run=job.name), report)
    folder = run_folder(project, job.name)
    figures = {
        "job": _description(job),
        **{key: trained[key] for key in ("steps", "seconds", "compile_seconds", "psnr_train", "params_m", "device")},
        **{key: evaluated[key] for key in ("psnr", "ssim", "lpips", "miou", "per_class_iou", "images", "background")},
        "rays_per_second": training_rate(folder / "events.jsonl"),
        "speed": _speeds(job, project, report),
        "memory_training_mb": memory,
        "memory_rendering_mb": _peak(device),
        "curve": training_curve(folder / "events.jsonl"),
        "pictures": evaluated["pictures"][:4],
        "taken": taken().model_dump(mode="json"),
        "project": str(project),
    }
    if more is not None:
        figures |= more(job, project, report)
    write_json(out / "runs" / f"{job.name}.json", figures)
    if not keep:
        (folder / CHECKPOINT).unlink(missing_ok=True)
    return figures


def interrupted(job: Job, project: Path) -> bool:
    """Whether an unfinished run of just this job is there."""
    try:
        info = load_info(project, job.name)
    except ProjectError:
        return False
    same = info.preset == job.preset and info.config == settled_as(make_config(job.preset, job.settings), info.config)
    return same and (run_folder(project, job.name) / CHECKPOINT).is_file()


def _speeds(job: Job, project: Path, report: Reporter) -> list[dict[str, Any]]:
    """Frame times at every side of the job."""
    trained = load_trained(project, job.name)
    scene = load_scene(project, trained.info.holdout)
    box = trained.info.box(load_project(project))
    views = scene.test or scene.train
    return [measure_speed(trained, scene, views, box.box_from_world, report, side) for side in job.sides]


def _reset_peak(device: torch.device) -> None:
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)


def _peak(device: torch.device) -> float | None:
    """Peak memory in MiB: on a GPU since the last reset, on a CPU of the process so far."""
    if device.type == "cuda":
        return round(torch.cuda.max_memory_allocated(device) / 2**20, 1)
    return round(peak_memory(), 1)


def _events(path: Path) -> list[dict[str, Any]]:
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return [json.loads(line) for line in lines if line.endswith("}")]


def training_rate(path: Path) -> int | None:
    """Mean training rays a second over the second half of a run; None when nothing was recorded."""
    rates = [event["rays_per_second"] for event in _events(path)]
    late = rates[len(rates) // 2 :]
    return round(sum(late) / len(late)) if late else None


def training_curve(path: Path, points: int = 100) -> list[list[float]]:
    """At most about `points` pairs (seconds, training PSNR)."""
    events = _events(path)
    step = max(1, len(events) // points)
    return [[event["seconds"], event["psnr"]] for event in events[::step]]


def unknown_origin(results: Sequence[dict[str, Any]], out: Path) -> list[Path]:
    """Files of finished runs that do not say with what they were measured: a version before that was recorded."""
    names = [Job(**result["job"]).name for result in results if "error" not in result and not result.get("taken")]
    return [out / "runs" / f"{name}.json" for name in names]


def planned(jobs: Sequence[Job], out: Path) -> list[str]:
    """The plan in lines for the user: what is trained, what is there already, about how long it takes."""
    there = [load_result(job, out) is not None for job in jobs]
    lines = [f"{'there' if known else 'to do'}: {job.title}" for job, known in zip(jobs, there)]
    left = sum(job.expected_seconds for job, known in zip(jobs, there) if not known)
    return [*lines, f"{len(jobs) - sum(there)} of {len(jobs)} runs to do, roughly {max(left / 60, 1):.0f} minutes."]


def run_all(
    jobs: Sequence[Job],
    projects: dict[str, Path],
    out: Path,
    report: Reporter,
    keep: bool = False,
    more: Measure | None = None,
) -> list[dict[str, Any]]:
    """Figures of all jobs in their order; finished ones are read, failed ones have only "job" and "error".

    `keep`, `more`: see `run_job`.
    """
    total = sum(job.expected_seconds for job in jobs) or 1.0
    done, results, begin = 0.0, [], time.monotonic()
    for line in planned(jobs, out):
        report.note(line)
    report.stage(f"{len(jobs)} runs")
    for number, job in enumerate(jobs, 1):
        share = job.expected_seconds / total
        title = f"run {number} of {len(jobs)}, {job.title}"
        known = load_result(job, out)
        if known is None:
            try:
                known = run_job(job, projects[job.scene], out, JobReporter(report, done, share, job, title), keep, more)
            except FieldworkError as error:
                report.warn(f"{title} failed: {error}")
                known = {"job": _description(job), "error": str(error)}
        results.append(known)
        done += share
        report.progress(min(done, 1.0), f"{title}: done after {time.monotonic() - begin:.0f} s")
    return results
