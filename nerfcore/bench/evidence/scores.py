"""How good and how fast pictures of a trained method are, on held-out photos: the same code for all methods."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...data.box import box_poses
from ...data.pixels import training_size
from ...data.scene import View
from ...errors import InputError
from ...evaluate.metrics import BoundaryOverlap, Confusion, calibration_error, psnr, ssim
from ...evaluate.verb import compared_with, spread
from ...files import atomic_path
from ...images.encode import write_picture
from ...images.picture import to_bytes
from ...images.working import nearest, read_depth
from ...kernels.device import synchronize
from ...progress import Reporter
from ...project.store import load_project, world_from_sfm
from ...render.image import Frame
from ...train.depth import depth_scale
from .perceptual import Perceptual
from .protocol import Trial
from .trainees import Trainee, clock_of

FRAME = 800  # pixels on a side of the frame whose time is told
SOLID = 0.5  # opacity from which a pixel has a depth


def scored(
    trial: Trial, trainee: Trainee, project: Path, out: Path, perceptual: Perceptual | None, report: Reporter
) -> dict[str, Any]:
    """Figures of a trained method; None is what was not measured. Photos of which a mask leaves nothing do not count.

    Returns:
        {"psnr", "ssim", "lpips", "miou", "per_class_iou", "boundary_iou", "ece", "depth_error": median of |z − z'| / z,
        "images": how many were compared, "ms_frame", "ms_frame_plain": without classes, "ms_sampling", "ms_network": of a frame of 800×800 by the
        time of the frames here, "pictures"}
    Raises:
        InputError: the masks leave nothing of the photos.
    """
    scene, info, device = trainee.scene, trainee.info, trainee.device
    chosen = [scene.test[place] for place in sorted(spread(len(scene.test))[: trial.held_out])]
    poses = box_poses([scene.views[i] for i in chosen], trainee.box_from_world)
    confusion, outlines = Confusion(info.class_ids), BoundaryOverlap(info.class_ids)
    images: list[dict[str, Any]] = []
    sure, right, depth_errors, pictures = [], [], [], []
    seconds, rays, timer = 0.0, 0, clock_of(trial)
    scale = depth_scale(world_from_sfm(load_project(project)), trainee.box_from_world)
    frame = None
    for number, (index, pose) in enumerate(zip(chosen, poses)):
        view = scene.views[index]
        camera = view.camera.resized(*training_size(view.camera, info.image_size))
        photo, keep, label = compared_with(view, scene, camera.width, camera.height, trainee.background)
        report.progress(number / len(chosen), view.name)
        if keep is not None and not keep.any():
            continue
        begin = timer()
        frame = trainee.frame(camera, pose, True, report.check)
        synchronize(device)
        seconds, rays = seconds + timer() - begin, rays + camera.width * camera.height
        image = to_bytes(frame.color)
        told = {"name": view.name, "psnr": psnr(image, photo, keep), "ssim": ssim(image, photo, keep)}
        images.append({**told, "lpips": perceptual(image, photo) if perceptual is not None else None})
        if label is not None and frame.probabilities is not None:
            predicted = frame.label(info.class_ids, scene.ignore_id)
            confusion.add(label, predicted)
            outlines.add(label, predicted)
            known = np.isin(label, info.class_ids)
            if known.any():
                sure.append(frame.confidence()[known])
                right.append((predicted == label)[known])
        depth_errors += _depth_errors(view, frame, scale)
        if not pictures:
            pictures = _write_pictures(out, trial, image, photo)
    if frame is None:
        raise InputError("The masks leave nothing of the photos to compare.", "White in a mask marks what counts.")
    camera = scene.views[chosen[-1]].camera
    camera = camera.resized(*training_size(camera, info.image_size))
    each = seconds / rays * FRAME**2 * 1e3  # milliseconds of a frame
    plain = each
    if frame.probabilities is not None:
        begin = timer()
        trainee.frame(camera, poses[-1], False, report.check)
        synchronize(device)
        plain = (timer() - begin) / (camera.width * camera.height) * FRAME**2 * 1e3
    share = trainee.sampling_share(camera, poses[-1], report)
    miou = confusion.miou() if sure else None
    return {
        "psnr": _mean(images, "psnr"),
        "ssim": _mean(images, "ssim"),
        "lpips": _mean(images, "lpips"),
        "miou": None if miou is None else round(miou, 4),
        "per_class_iou": _named(confusion.iou(), {c.id: c.name for c in scene.classes}) if sure else {},
        "boundary_iou": _rounded(outlines.mean()) if sure else None,
        "ece": _rounded(calibration_error(np.concatenate(sure), np.concatenate(right))) if sure else None,
        "depth_error": _rounded(float(np.median(np.concatenate(depth_errors)))) if depth_errors else None,
        "images": len(images),
        "ms_frame": float(f"{each:.4g}"),
        "ms_frame_plain": float(f"{plain:.4g}"),
        "ms_sampling": float(f"{each * share:.4g}"),
        "ms_network": float(f"{each * (1 - share):.4g}"),
        "pictures": pictures,
    }


def _depth_errors(view: View, frame: Frame, scale: float) -> list[np.ndarray]:
    """|z − z'| / z of the pixels with a true depth and something rendered; empty without depth maps.

    `scale`: normalised units per unit of the depth maps."""
    if view.depth is None:
        return []
    height, width = frame.opacity.shape
    truth = nearest(read_depth(view.depth), width, height) * scale
    there = (truth > 0) & np.isfinite(truth) & (frame.opacity > SOLID) & np.isfinite(frame.depth)
    return [np.abs(frame.depth[there] - truth[there]) / truth[there]] if there.any() else []


def _write_pictures(out: Path, trial: Trial, image: np.ndarray, photo: np.ndarray) -> list[str]:
    """Render and photo of one held-out view below `out`; their names."""
    names = []
    for kind, pixels in ((trial.name, image), (f"{trial.scene}-{trial.image_size}-photo", photo)):
        path = out / "pictures" / f"{kind}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary:
            write_picture(temporary, pixels)
        names.append(path.name)
    return names


def _mean(images: list[dict[str, Any]], key: str) -> float | None:
    values = [image[key] for image in images if image[key] is not None]
    return round(float(np.mean(values)), 4) if len(values) == len(images) else None


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


def _named(values: dict[int, float], names: dict[int, str]) -> dict[str, float]:
    return {names.get(number, str(number)): round(value, 4) for number, value in values.items()}
