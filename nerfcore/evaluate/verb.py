"""The verb `evaluate`: held-out metrics and comparison pictures."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from ..data.box import box_poses
from ..data.load import class_inputs, load_scene, view_inputs
from ..data.pixels import training_size
from ..data.scene import Scene, View
from ..errors import InputError
from ..files import atomic_path, write_json
from ..images.encode import write_picture
from ..images.picture import cut_out, over, resized, to_bytes
from ..images.working import nearest, read_image, read_label, read_picture
from ..kernels.runtime import compile_seconds
from ..params import EvaluateParams
from ..progress import Reporter
from ..project.fingerprints import Earlier, Fingerprint, compare, digest, read_made, write_made
from ..project.runs import checkpoint_id, run_folder, state_id
from ..project.schema import step
from ..project.store import load_project
from ..render.image import Frame, background_of, render_view
from ..render.pictures import colorize_depth, colorize_labels, side_by_side
from ..render.run import Trained, load_info, load_trained, refined_poses
from .metrics import Confusion, psnr, ssim
from .refit import refit_camera
from .speed import SPEED_KEYS, measure_speed, peak_memory


def evaluate(params: EvaluateParams, report: Reporter) -> dict[str, Any]:
    """Render the held-out (or training) views of a run and compare them with the photos.

    Returns:
        {"psnr", "ssim", "lpips", "miou", "per_class_iou", "fps", "rps", "spr", "ms_sampling", "ms_network",
        "params_m", "memory_mb", "images", "background", …}; what was not measured is None. Of runs with refined poses
        training views are rendered from those and held-out ones from poses fitted to their photos;
        "psnr_given_poses" is what the latter score without that.
    Raises:
        ProjectError: no such run. InputError: nothing is held out, or a photo cannot be read.
    """
    folder = Path(params.project)
    project, trained = load_project(folder), load_trained(folder, params.run)
    scene = load_scene(folder, trained.info.holdout)
    indices = scene.test if params.split == "test" else scene.train
    if not indices:
        raise InputError(
            f"The run “{params.run}” has no held-out photos: all were trained on.",
            "Train another run with --holdout 8 to measure, or measure the training photos (--split train).",
        )
    # Views larger than the training images are compared at the training size.
    sizes = [training_size(scene.views[index].camera, trained.info.image_size) for index in indices]
    report.stage("Preparing")
    trained.model.refine(check=report.check)
    box = trained.info.box(project)
    background = background_of(trained.info)
    out = run_folder(folder, params.run) / "evaluation"
    confusion = Confusion(trained.info.class_ids if trained.model.field.classes else [])
    names = {c.id: c.name for c in scene.classes}
    refined = refined_poses(folder, params.run, trained.info)
    scores: list[dict[str, Any]] = []
    pictures = []
    seconds, rays = 0.0, 0
    report.stage("Rendering held-out views" if params.split == "test" else "Rendering training views")
    for number, index in enumerate(indices):
        view = scene.views[index]
        report.progress(number / len(indices), view.name)
        pose = box_poses([view], box.box_from_world)[0]
        camera = view.camera.resized(*sizes[number])
        photo, keep, label = _truth(view, scene, camera.width, camera.height, background)
        given: dict[str, float] = {}
        if view.name in refined:
            pose = refined[view.name]
        elif refined:
            before = render_view(trained.model, camera, pose, background, semantics=False, check=report.check)
            given["psnr_given_pose"] = psnr(to_bytes(before.color), photo, keep)
            pose = refit_camera(trained.model, camera, pose, photo, keep, background, report.check)
        begin, compiled = time.perf_counter(), compile_seconds()
        frame = render_view(trained.model, camera, pose, background, check=report.check)
        seconds += time.perf_counter() - begin - (compile_seconds() - compiled)
        rays += camera.width * camera.height
        image = to_bytes(frame.color)
        score = {"name": view.name, "psnr": psnr(image, photo, keep), "ssim": ssim(image, photo), **given}
        if label is not None and confusion.class_ids:
            present = frame.label(confusion.class_ids, scene.ignore_id)
            confusion.add(label, present)
        scores.append(score)
        pictures.append(_write_pictures(out, view.name, photo, frame, label, trained, scene))
    per_class = {names.get(c, str(c)): round(v, 4) for c, v in confusion.iou().items()}
    speed: dict[str, Any] = dict.fromkeys(SPEED_KEYS)
    if params.speed:
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
        "memory_mb": round(peak_memory(trained.device)),
        "background": "white" if background == 1 else "black",
        "device": str(trained.device),
        "per_image": [{k: (round(v, 4) if isinstance(v, float) else v) for k, v in s.items()} for s in scores],
        "pictures": [str(p.relative_to(folder)) for p in pictures],
    }
    if any("psnr_given_pose" in score for score in scores):
        result["psnr_given_poses"] = round(float(np.mean([score["psnr_given_pose"] for score in scores])), 3)
    path = run_folder(folder, params.run) / "metrics.json"
    stored = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    write_json(path, {**stored, params.split: result})
    made = step("evaluate", params.model_dump(mode="json"), result, evaluation_inputs(params), state_id(trained.state))
    write_made(_record(params), made)
    return result


def _record(params: EvaluateParams) -> Path:
    return run_folder(Path(params.project), params.run) / "evaluation" / f"{params.split}.json"


def evaluation_inputs(params: EvaluateParams) -> Fingerprint:
    """What an evaluation depends on. Raises ProjectError."""
    folder = Path(params.project)
    info = load_info(folder, params.run)
    scene = load_scene(folder, info.holdout)
    return {
        "trained field": checkpoint_id(folder, params.run),
        "classes": class_inputs(scene),
        "settings": digest([params.split, params.speed, info.config.model_dump(mode="json")]),
        **view_inputs(scene, scene.test if params.split == "test" else scene.train, files=True),
    }


def evaluated(params: EvaluateParams) -> Earlier:
    """The evaluation that is there, if it is of the present field and photos."""
    made = read_made(_record(params))
    pictures = [Path(params.project) / name for name in made.result.get("pictures", [])] if made else []
    return compare(made, evaluation_inputs(params), pictures)


def _truth(
    view: View, scene: Scene, width: int, height: int, background: float
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Photo (H, W, 3) uint8 on the background, mask of pixels that count (or None), label ids (or None)."""
    picture = resized(read_picture(view.image), width, height)
    keep = None
    if view.mask is not None:
        inside = nearest(read_image(view.mask)[..., 0], width, height) > 127
        if scene.mask_mode == "empty":
            picture = cut_out(picture, inside)
        else:
            keep = inside
    photo = to_bytes(over(picture, background).pixels)
    label = None
    if view.label is not None:
        label = nearest(read_label(view.label), width, height)
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
