"""How fast a trained field renders: frames a second, and where the time goes."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import psutil
import torch

from ..data.box import box_poses
from ..data.camera_rays import CameraRays
from ..data.scene import Scene
from ..field.encoding import spherical_harmonics
from ..geometry.cameras import Camera
from ..kernels.composite import render_weights
from ..kernels.device import backend_of, synchronize
from ..kernels.march import sample
from ..progress import Reporter
from ..render.fused import FusedRenderer, ray_renderer
from ..render.image import render_view
from ..render.model import Model
from ..render.run import Trained
from ..render.sparse_rays import sparse_rays

SPEED_KEYS = ("fps", "fps_size", "spr", "ms_sampling", "ms_network", "fused")


def peak_memory(device: torch.device) -> float:
    """Peak memory of this process in MiB: of the GPU when one is used, else resident memory now."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    return psutil.Process().memory_info().rss / 2**20


@torch.no_grad()
def measure_speed(
    trained: Trained,
    scene: Scene,
    indices: list[int],
    box_from_world: np.ndarray,
    report: Reporter,
    side: int = 800,
    poses: int | None = None,
) -> dict[str, Any]:
    """Frames a second at side × side with colour and classes: warm, synchronised; median over `poses` of the views
    `indices`, by default five on a GPU and one on a CPU, where a frame takes seconds. A frame on a GPU ends on the GPU.

    `ms_sampling` and `ms_network` split one frame: the coarse march, and all that reads the field (the fused kernel
    draws its samples there too); `spr` is the number of field samples per ray; `fused` says which kernels rendered.
    """
    model, device = trained.model, trained.device
    report.stage("Preparing")
    views = [scene.views[index] for index in indices]
    cameras = [_camera(scene, index, side) for index in indices]
    model.refine(math.inf, report.check, sparse_rays(cameras, box_poses(views, box_from_world), device))
    report.stage(f"Measuring speed at {side}×{side}")
    asynchronous = backend_of(device).asynchronous
    frame = _device_frame if asynchronous else _host_frame
    chosen = indices[: poses or (5 if asynchronous else 1)]
    if asynchronous:
        frame(model, scene, indices[0], box_from_world, side, report)  # warms up
    times = [frame(model, scene, index, box_from_world, side, report) for index in chosen]
    rays = CameraRays([_camera(scene, indices[0], side)], box_poses([scene.views[indices[0]]], box_from_world), device)
    sampling, network, samples, fused = split_times(model, rays, side * side, report)
    return {
        "fps": float(f"{1 / float(np.median(times)):.4g}"),
        "fps_size": [side, side],
        "spr": round(samples / side**2, 3),
        "ms_sampling": round(sampling * 1e3, 2),
        "ms_network": round(network * 1e3, 2),
        "fused": fused,
    }


def _camera(scene: Scene, index: int, side: int) -> Camera:
    return scene.views[index].camera.undistorted().resized(side, side)


def _host_frame(
    model: Model, scene: Scene, index: int, box_from_world: np.ndarray, side: int, report: Reporter
) -> float:
    """Seconds of a whole picture as `render` makes it."""
    pose = box_poses([scene.views[index]], box_from_world)[0]
    begin = time.perf_counter()
    render_view(model, _camera(scene, index, side), pose, 0.0, check=report.check)
    return time.perf_counter() - begin


def _device_frame(
    model: Model, scene: Scene, index: int, box_from_world: np.ndarray, side: int, report: Reporter
) -> float:
    """Seconds from a pose to colours, depths and class probabilities on the GPU; they are not brought to the host."""
    report.check()
    rays = CameraRays(
        [_camera(scene, index, side)], box_poses([scene.views[index]], box_from_world), model.priorities.device
    )
    renderer = ray_renderer(model, side * side)
    count = model.config.render.samples or model.config.sampling.samples
    synchronize(rays.device)
    begin = time.perf_counter()
    for pixel in torch.arange(side * side, device=rays.device).split(renderer.rays):
        renderer(*rays(torch.zeros_like(pixel), pixel), count)
    synchronize(rays.device)
    return time.perf_counter() - begin


def split_times(model: Model, rays: CameraRays, count: int, report: Reporter) -> tuple[float, float, int, bool]:
    """Seconds of sampling, seconds of reading the field, field samples, and whether the fused kernel was used, for the
    first camera's `count` pixels."""
    device = rays.device
    renderer = ray_renderer(model, count)
    per_ray = model.config.render.samples or model.config.sampling.samples
    sampling, network, total = 0.0, 0.0, 0
    for pixel in torch.arange(count, device=device).split(renderer.rays):
        report.check()
        origins, directions = rays(torch.zeros_like(pixel), pixel)
        synchronize(device)
        begin = time.perf_counter()
        if isinstance(renderer, FusedRenderer):
            coarse = renderer.coarse(origins, directions)
            synchronize(device)
            middle = time.perf_counter()
            evaluated = renderer.fine(coarse, per_ray).evaluated
        else:
            g = model.render_grid()
            samples = sample(origins, directions, g.cells, g.skip_distance, g.settings, per_ray)
            synchronize(device)
            middle = time.perf_counter()
            geometry = model.field.geometry(samples.points)
            weights = render_weights(geometry.density, samples.deltas, samples.packed_info)
            kept = (weights > model.config.render.cull).nonzero()[:, 0]
            ray_indices = samples.packed_info.ray_indices.long()
            model.field.color(geometry[kept], spherical_harmonics(directions)[ray_indices[kept]])
            if model.field.semantic_head is not None:
                model.field.logits(geometry[kept])
            if model.environment is not None:
                opacity = torch.zeros(len(pixel), device=device).index_add_(0, ray_indices, weights)
                model.environment.visible_rays(model.field, directions, opacity, model.config.render.cull, True)
            evaluated = len(samples)
        synchronize(device)
        sampling += middle - begin
        network += time.perf_counter() - middle
        total += int(evaluated)
    return sampling, network, total, isinstance(renderer, FusedRenderer)
