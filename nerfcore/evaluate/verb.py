"""The verb `evaluate`: held-out metrics and comparison pictures."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch

from ..data.box import box_poses
from ..data.pixels import read_image, read_label, read_photo, resize, training_size
from ..data.scene import Scene, View
from ..errors import InputError
from ..files import atomic_path, write_json
from ..params import EvaluateParams
from ..progress import Reporter
from ..project import load_project, load_scene
from ..render.image import Frame, background_of, render_view, to_bytes, write_picture
from ..render.pictures import colorize_depth, colorize_labels, side_by_side
from ..train.run import Trained, load_trained, run_folder
from .metrics import Confusion, psnr, ssim


def evaluate(params: EvaluateParams, report: Reporter) -> dict[str, Any]:
    """Render the held-out (or training) views of a run and compare them with the photos.

    Returns:
        {"psnr", "ssim", "lpips", "miou", "per_class_iou", "fps", "rps", "spr", "ms_sampling", "ms_network",
        "params_m", "memory_mb", "images", "background", …}; what was not measured is None.
    Raises:
        ProjectError: no such run. InputError: nothing is held out, or a photo cannot be read.
    """
    folder = Path(params.project)
    project, scene = load_project(folder), load_scene(folder)
    trained = load_trained(folder, params.run)
    indices = scene.test if params.split == "test" else scene.train
    if not indices:
        raise InputError(f"{folder} has no held-out images.", "Captures of 8 or more photos hold every 8th one out.")
    box = trained.info.box(project)
    background = background_of(trained.info)
    out = run_folder(folder, params.run) / "evaluation"
    confusion = Confusion(trained.info.class_ids if trained.model.field.classes else [])
    names = {c.id: c.name for c in scene.classes}
    scores: list[dict[str, Any]] = []
    pictures = []
    seconds, rays = 0.0, 0
    report.stage("Rendering held-out views" if params.split == "test" else "Rendering training views")
    for number, index in enumerate(indices):
        view = scene.views[index]
        report.progress(number / len(indices), view.name)
        pose = box_poses([view], box.box_from_world)[0]
        # Views larger than the training images are compared at the training size.
        camera = view.camera.resized(*training_size(view.camera, trained.info.config.scene.image_size))
        begin = time.perf_counter()
        frame = render_view(trained.model, camera, pose, background, check=report.check)
        seconds += time.perf_counter() - begin
        rays += camera.width * camera.height
        photo, keep, label = _truth(view, scene, camera.width, camera.height, background)
        image = to_bytes(frame.color)
        score = {"name": view.name, "psnr": psnr(image, photo, keep), "ssim": ssim(image, photo)}
        if label is not None and confusion.class_ids:
            present = frame.label(confusion.class_ids, scene.ignore_id)
            confusion.add(label, present)
        scores.append(score)
        pictures.append(_write_pictures(out, view.name, photo, frame, label, trained, scene))
    per_class = {names.get(c, str(c)): round(v, 4) for c, v in confusion.iou().items()}
    speed = measure_speed(trained, scene, indices, box.box_from_world, report)
    result: dict[str, Any] = {
        "run": params.run,
        "split": params.split,
        "images": len(indices),
        "psnr": round(float(np.mean([s["psnr"] for s in scores])), 3),
        "ssim": round(float(np.mean([s["ssim"] for s in scores])), 4),
        "lpips": None,
        "miou": None if confusion.miou() is None else round(confusion.miou() or 0.0, 4),
        "per_class_iou": per_class,
        **speed,
        "rps": round(rays / seconds),
        "seconds_per_image": round(seconds / len(indices), 3),
        "params_m": round(trained.model.field.parameter_count() / 1e6, 3),
        "memory_mb": round(_memory(trained.device)),
        "background": "white" if background == 1 else "black",
        "device": str(trained.device),
        "per_image": [{k: (round(v, 4) if isinstance(v, float) else v) for k, v in s.items()} for s in scores],
        "pictures": [str(p.relative_to(folder)) for p in pictures],
    }
    path = run_folder(folder, params.run) / "metrics.json"
    known = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    write_json(path, {**known, params.split: result})
    return result


def _truth(
    view: View, scene: Scene, width: int, height: int, background: float
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Photo (H, W, 3) uint8 on the background, mask of pixels that count (or None), label ids (or None)."""
    rgba = resize(read_photo(view.image), width, height).astype(np.float64) / 255
    keep = None
    if view.mask is not None:
        inside = resize(read_image(view.mask)[..., :1], width, height, nearest=True)[..., 0] > 127
        if scene.mask_mode == "empty":
            rgba[..., 3] = np.where(inside, rgba[..., 3], 0)
        else:
            keep = inside
    photo = to_bytes(rgba[..., :3] * rgba[..., 3:] + background * (1 - rgba[..., 3:]))
    label = None
    if view.label is not None:
        label = resize(read_label(view.label)[..., None], width, height, nearest=True)[..., 0]
        if keep is not None:
            label = np.where(keep, label, scene.ignore_id)
    return photo, keep, label


def _write_pictures(
    out: Path, name: str, photo: np.ndarray, frame: Frame, label: np.ndarray | None, trained: Trained, scene: Scene
) -> Path:
    """photo | render | depth | labels (| true labels) side by side, with the frame's parts beside it."""
    colors = {c.id: c.color for c in scene.classes}
    tiles = [photo, to_bytes(frame.color), colorize_depth(frame.depth, frame.opacity)]
    if frame.probabilities is not None:
        tiles.append(colorize_labels(frame.label(trained.info.class_ids, scene.ignore_id), colors))
        if label is not None:
            tiles.append(colorize_labels(label, colors))
    path = out / f"{Path(name).stem}.png"
    with atomic_path(path) as temporary:
        write_picture(temporary, side_by_side(tiles))
    return path


def _memory(device: torch.device) -> float:
    """Peak memory in MiB: of the GPU when one is used, else resident memory of this process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    return psutil.Process().memory_info().rss / 2**20


@torch.no_grad()
def measure_speed(
    trained: Trained, scene: Scene, indices: list[int], box_from_world: np.ndarray, report: Reporter, side: int = 800
) -> dict[str, Any]:
    """Frames a second at side × side with colour and classes: warm, synchronised; median over five test poses
    on a GPU, one pose on a CPU.

    `ms_sampling` and `ms_network` split one frame; `spr` is the number of field samples per ray.
    """
    from ..data.pixels import CameraRays
    from ..kernels.composite import render_weights
    from ..kernels.march import sample

    model, device = trained.model, trained.device
    count = model.config.render.samples or model.config.sampling.samples

    def synchronize() -> None:
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    times, sampling, network, samples, rays = [], 0.0, 0.0, 0, 0
    report.stage("Measuring speed")
    # The evaluation before has warmed everything up; a frame on a CPU takes seconds, so one pose must do there.
    for index in indices[: 5 if device.type == "cuda" else 1]:
        report.check()
        view = scene.views[index]
        camera = view.camera.undistorted().resized(side, side)
        pose = box_poses([view], box_from_world)[0]
        synchronize()
        begin = time.perf_counter()
        render_view(model, camera, pose, 0.0, check=report.check)
        synchronize()
        times.append(time.perf_counter() - begin)
    view = scene.views[indices[0]]
    camera = view.camera.undistorted().resized(side, side)
    camera_rays = CameraRays([camera], box_poses([view], box_from_world), device)
    settings, occupancy = model.occupancy.march_settings(), model.occupancy
    for pixel in torch.arange(side * side, device=device).split(1 << 15):
        origins, directions = camera_rays(torch.zeros_like(pixel), pixel)
        synchronize()
        begin = time.perf_counter()
        s = sample(origins, directions, occupancy.cells, occupancy.blocks, settings, count)
        synchronize()
        middle = time.perf_counter()
        geometry = model.field.geometry(s.points)
        weights = render_weights(geometry.density, s.delta, s.packing)
        shown = geometry[(weights > model.config.render.cull).nonzero()[:, 0]]
        model.field.color(shown, torch.zeros(len(shown.density), 16, device=device))
        if model.field.semantic_head is not None:
            model.field.logits(shown)
        synchronize()
        sampling += middle - begin
        network += time.perf_counter() - middle
        samples += len(s)
        rays += len(pixel)
    return {
        "fps": round(1 / float(np.median(times)), 3),
        "fps_size": [side, side],
        "spr": round(samples / rays, 3),
        "ms_sampling": round(sampling * 1e3, 2),
        "ms_network": round(network * 1e3, 2),
    }
