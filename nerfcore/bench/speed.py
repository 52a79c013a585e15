"""What the suite `speed` adds to the figures of a run: how near to the machine pictures and training steps come."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from ..config import make_config
from ..data.box import box_poses
from ..data.camera_rays import CameraRays
from ..data.load import load_scene
from ..kernels.device import synchronize
from ..progress import Reporter
from ..project.store import load_project
from ..render.image import CPU_RAYS, render_view
from ..render.run import Trained, load_trained
from ..render.sparse_rays import sparse_rays
from ..train.prepare import make_trainer, plan_run
from ..train.trainer import Trainer
from .jobs import Job
from .roofline import Rates, measure_rates, rendering_work, training_work

SIDE = 400
WARM_STEPS, STEPS = 24, 32
LATE = 0.5  # progress through the schedule of the steps that are measured


@dataclass(frozen=True)
class Usage:
    """What this process has used so far: seconds of the clock, of the processor, of those in the system, page faults."""

    wall: float
    processor: float
    system: float
    faults: int

    def __sub__(self, other: Usage) -> Usage:
        return Usage(*(a - b for a, b in zip(asdict(self).values(), asdict(other).values())))


def usage() -> Usage | None:
    """None where the system does not tell (Windows)."""
    if sys.platform == "win32":
        return None
    import resource  # not on Windows

    used = resource.getrusage(resource.RUSAGE_SELF)
    return Usage(time.perf_counter(), used.ru_utime + used.ru_stime, used.ru_stime, used.ru_minflt)


def measure(job: Job, project: Path, report: Reporter) -> dict[str, Any]:
    """{"roofline": {…}}, see `tables.SHARES`: the machine's rates before, times, and the rates after."""
    trained = load_trained(project, job.name)
    model = trained.model
    report.stage("Measuring the machine")
    before = measure_rates(model.field, trained.device)
    found = {**_frame(trained, project, report), **_steps(job, project, report)}
    after = measure_rates(model.field, trained.device)
    # What was there while both were measured: other programs come and go.
    rates = Rates(*(max(a, b) for a, b in zip(asdict(before).values(), asdict(after).values())))
    rendering = rendering_work(model.field, found["evaluated"], found["visible"]).seconds(rates)
    step = training_work(model.field, *(found[f"step_{key}"] for key in ("evaluated", "visible", "touched")))
    least = step.seconds(rates)
    return {
        "roofline": {
            "precision": str(model.field.dtype).removeprefix("torch."),
            "gflops": round(rates.flops / 1e9, 1),
            "reads": round(rates.reads / 1e6, 1),
            "copy": round(rates.bytes / 1e9, 1),
            "render_least": round(rendering, 4),
            "render_taken": round(found["seconds"], 4),
            "render_ratio": round(found["seconds"] / rendering, 2),
            "step_least": round(least * 1e3, 1),
            "step_taken": round(found["step_seconds"] * 1e3, 1),
            "step_ratio": round(found["step_seconds"] / least, 2),
            "step_faults": found["step_faults"],
            "step_system": found["step_system"],
            **{key: found[key] for key in ("evaluated", "visible", "step_evaluated", "step_visible", "step_touched")},
        }
    }


@torch.no_grad()
def _frame(trained: Trained, project: Path, report: Reporter) -> dict[str, Any]:
    """Seconds of a picture with classes, the best of three, and its samples."""
    model, info = trained.model, trained.info
    scene = load_scene(project, info.holdout)
    view = scene.views[(scene.test or scene.train)[0]]
    box = info.box(load_project(project))
    pose = box_poses([view], box.box_from_world)[0]
    camera = view.camera.undistorted().resized(SIDE, SIDE)
    model.refine(math.inf, report.check, sparse_rays([camera], pose[None], model.device))
    times = []
    for _ in range(4):
        begin = time.perf_counter()
        render_view(model, camera, pose, 0.0, check=report.check)
        times.append(time.perf_counter() - begin)
    rays = CameraRays([camera], pose[None], model.device)
    count = model.config.render.samples or model.config.sampling.samples
    evaluated = visible = 0
    for pixel in torch.arange(SIDE * SIDE, device=model.device).split(CPU_RAYS):
        rendered = model.render(*rays(torch.zeros_like(pixel), pixel), count, grid=model.render_grid())
        evaluated += int((rendered.evaluated_density >= 0).sum())
        visible += int(rendered.visible)
    return {"seconds": min(times[1:]), "evaluated": evaluated, "visible": visible}


def _steps(job: Job, project: Path, report: Reporter) -> dict[str, Any]:
    """Seconds, samples, blocks of the grid, page faults and share of system time of a step in the middle of training."""
    saved = load_trained(project, job.name)
    info, scene = plan_run(project, job.preset, make_config(job.preset, job.settings), saved.device)
    trainer = make_trainer(project, info, scene, saved.device, report)
    trainer.model.load_state_dict(saved.model.state_dict())
    trainer.steps = saved.state["steps"]
    counted = _Counted(trainer)
    for _ in range(WARM_STEPS):
        trainer.step(LATE)
        report.check()
    counted.reset()
    synchronize(saved.device)
    before, begin = usage(), time.perf_counter()
    for _ in range(STEPS):
        trainer.step(LATE)
        report.check()
    synchronize(saved.device)
    seconds, after = time.perf_counter() - begin, usage()
    used = after - before if after is not None and before is not None else None
    return {
        "step_seconds": seconds / STEPS,
        **{f"step_{key}": round(value / STEPS) for key, value in counted.totals().items()},
        "step_faults": None if used is None else round(used.faults / STEPS),
        "step_system": None if used is None else round(100 * used.system / max(used.processor, 1e-9), 1),
    }


class _Counted:
    """Counts samples that a trainer's steps evaluate and see, and the blocks of the grid that they touch."""

    def __init__(self, trainer: Trainer) -> None:
        self.model = trainer.model
        self.reset()
        observe, grid = self.model.observe, self.model.field.grid

        def observing(rendered: list[Any]) -> None:
            self.evaluated += sum(int((r.evaluated_density >= 0).sum()) for r in rendered)
            self.visible += sum(int(r.visible) for r in rendered)
            observe(rendered)

        self.model.observe = observing  # type: ignore[method-assign]
        if grid is not None:
            step = grid.step

            def stepping(*arguments: Any) -> None:
                self.touched += int(grid.touched.sum())
                step(*arguments)

            grid.step = stepping  # type: ignore[method-assign]

    def reset(self) -> None:
        self.evaluated = self.visible = self.touched = 0

    def totals(self) -> dict[str, int]:
        return {"evaluated": self.evaluated, "visible": self.visible, "touched": self.touched}
