"""What the suite `live` adds to the figures of a run: what its baked field costs and loses, and how fast it is."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import torch

from ..bake.verb import bake
from ..data.box import box_poses
from ..data.camera_rays import CameraRays
from ..data.load import load_scene
from ..evaluate.verb import evaluate
from ..kernels.voxel_march_torch import texture_reads
from ..params import BakeParams, EvaluateParams
from ..progress import Reporter
from ..project.store import load_project
from ..render.baked import load_baked
from ..render.image import background_of, render_view
from ..render.run import load_info
from .jobs import Job
from .results import Row

SIZES = {"400": (400, 400), "800": (800, 800), "1080": (1920, 1080)}
READ_SIDE = 96  # pixels of the pictures whose reads are counted
VIEWS = 3  # pictures of each size, of different photos
COLUMNS = {
    "scene": "scene",
    "budget": "budget",
    "psnr": "PSNR of the field (dB)",
    "lost_psnr": "lost, baked (dB)",
    "miou": "mIoU of the field",
    "lost_miou": "lost, baked",
    "bake_seconds": "baked in (s)",
    "cells": "cells along a side",
    "graphics_mb": "graphics memory (MB)",
    "disk_mb": "files (MB)",
    "reads": "texture reads a pixel",
    "field_400": "field, 400×400 (frames/s)",
    "baked_400": "baked, 400×400 (frames/s)",
    "baked_800": "baked, 800×800 (frames/s)",
    "baked_1080": "baked, 1920×1080 (frames/s)",
}


def measure(job: Job, project: Path, report: Reporter) -> dict[str, Any]:
    """{"live": {…}}, keys as in COLUMNS."""
    baked = bake(BakeParams(project=project, run=job.name), report)
    lost = evaluate(EvaluateParams(project=project, run=job.name, baked=True), report)["lost"]
    return {
        "live": {
            "lost_psnr": lost["psnr"],
            "lost_miou": lost["miou"],
            "bake_seconds": baked["seconds"],
            "cells": baked["cells"],
            "graphics_mb": baked["memory_mb"],
            "reads": texture_reads_of_views(job, project),
            "disk_mb": round(sum(Path(file).stat().st_size for file in baked["files"]) / 1e6, 1),
            **{f"baked_{name}": rate for name, rate in frame_rates(job, project, report).items()},
        }
    }


@torch.no_grad()
def frame_rates(job: Job, project: Path, report: Reporter) -> dict[str, float]:
    """Frames a second of the baked field with colour and classes, as `render --baked` makes them, by the names of SIZES."""
    info = load_info(project, job.name)
    scene, box = load_scene(project, info.holdout), info.box(load_project(project))
    shown = load_baked(project, job.name, info)
    views = [scene.views[number] for number in (scene.test or scene.train)[:VIEWS]]
    rates = {}
    for name, size in SIZES.items():
        report.stage(f"Measuring frames of {size[0]}×{size[1]}")
        times = []
        for number in range(len(views) + 1):
            view = views[number % len(views)]
            begin = time.perf_counter()
            pose = box_poses([view], box.box_from_world)[0]
            camera = view.camera.undistorted().reframed(*size)
            render_view(shown, camera, pose, background_of(info), check=report.check)
            times.append(time.perf_counter() - begin)
        rates[name] = round(1 / median(times[1:]), 2)  # the first one warms up
    return rates


@torch.no_grad()
def texture_reads_of_views(job: Job, project: Path) -> float:
    """How often Blender's viewport reads a texture for a pixel, the mean over small pictures of some photos' views."""
    info = load_info(project, job.name)
    scene, box = load_scene(project, info.holdout), info.box(load_project(project))
    shown, found = load_baked(project, job.name, info), []
    for number in (scene.test or scene.train)[:VIEWS]:
        camera = scene.views[number].camera.undistorted().reframed(READ_SIDE, READ_SIDE)
        rays = CameraRays([camera], box_poses([scene.views[number]], box.box_from_world), shown.device)
        pixels = torch.arange(READ_SIDE**2, device=shown.device)
        found.append(texture_reads(*rays(torch.zeros_like(pixels), pixels), shown.field, shown.settings).mean())
    return round(float(torch.stack(found).mean()), 1)


def live_table(rows: Sequence[Row]) -> tuple[dict[str, str], list[Row]]:
    """Columns and rows of the suite's table."""
    return COLUMNS, [{key: row.get(key) for key in COLUMNS} for row in rows]
