"""The verb `evaluate`: held-out metrics and comparison pictures."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.select import TWIN
from ..data.box import box_poses
from ..data.load import class_inputs, load_scene, view_inputs
from ..data.photo import photo_of
from ..data.pixels import training_size
from ..data.scene import Scene, View
from ..errors import InputError, SettingError
from ..files import atomic_path, require_writable, write_json
from ..geometry.cameras import Camera
from ..images.encode import write_picture
from ..images.picture import cut_out, over, resized, to_bytes
from ..images.working import MASK_UNKNOWN, nearest, read_image, read_label
from ..kernels.runtime import compile_seconds
from ..params import EvaluateParams
from ..progress import Reporter, shortened
from ..project.fingerprints import Earlier, Fingerprint, compare, digest, files_digest, read_made, write_made
from ..project.label_revision import is_made
from ..project.runs import METRICS, checkpoint_id, read_metrics, run_folder, state_id
from ..project.schema import step
from ..project.store import load_project
from ..render.baked import META, BakedField, load_baked, voxels_folder
from ..render.image import Frame, background_of, render_view
from ..render.model import Model
from ..render.pictures import colorize_depth, colorize_labels, side_by_side
from ..render.run import Trained, load_info, load_trained, refined_poses, without_seen
from ..render.sparse_rays import sparse_rays
from ..verdict import evaluate_verdict
from .advice import advice
from .documentation import results_of
from .metrics import Confusion, psnr, ssim
from .refit import refit_camera
from .report import check_report, write_report
from .speed import SPEED_KEYS, measure_speed, peak_memory

UNKNOWN_SIDE = 96  # pixels, see `Comparison._unknown`
KEPT_AS = {"test": "test", "train": "train_photos"}  # splits in metrics.json, whose "train" is of the training


@dataclass
class Comparison:
    """Views of a run rendered and held against their photos; `scores`, `pictures`, `confusion`, and the rays and
    seconds of rendering, grow with every view.

    shown: what is rendered, the model or its baked field. refined: camera-to-box poses (4, 4) by image of a run that
    refined them. out: folder of the pictures.
    """

    trained: Trained
    shown: Model | BakedField
    scene: Scene
    refined: dict[str, np.ndarray]
    box_from_world: np.ndarray
    out: Path
    confusion: Confusion
    scores: list[dict[str, Any]] = field(default_factory=list)
    pictures: list[Path] = field(default_factory=list)
    hidden: list[str] = field(default_factory=list)
    opacity: list[float] = field(default_factory=list)
    spread: list[float] = field(default_factory=list)  # 95th percentile of depth over the 5th
    seconds: float = 0.0
    rays: int = 0

    @property
    def background(self) -> float:
        return background_of(self.trained.info)

    def add(self, view: View, size: tuple[int, int], check: Callable[[], None]) -> None:
        """Compare one view at a size (width, height); `hidden` notes those whose mask leaves nothing to compare."""
        background = self.background
        camera = view.camera.resized(*size)
        photo, keep, label = compared_with(view, self.scene, camera.width, camera.height, background)
        if keep is not None and not keep.any():
            self.hidden.append(view.name)
            return
        pose, given = self._pose(view, camera, photo, keep, check)
        begin, compiled = time.perf_counter(), compile_seconds()
        frame = render_view(self.shown, camera, pose, background, check=check)
        self.seconds += time.perf_counter() - begin - (compile_seconds() - compiled)
        self.rays += camera.width * camera.height
        image = to_bytes(frame.color)
        self.opacity.append(float(frame.opacity.mean()))
        solid = frame.depth[np.isfinite(frame.depth) & (frame.opacity > 0.5)]
        self.spread.append(float(np.divide(*np.percentile(solid, [95, 5]))) if solid.size else 1.0)
        likeness = {"psnr": psnr(image, photo, keep), "ssim": ssim(image, photo, keep)}
        scores: dict[str, Any] = {"name": view.name, **likeness}
        if isinstance(self.shown, Model):  # a baked field does not know what no photo showed
            scores["unknown"] = self._unknown(self.shown, camera, pose, check)
        self.scores.append({**scores, **given})
        if label is not None and self.confusion.class_ids:
            self.confusion.add(label, frame.label(self.confusion.class_ids, self.scene.ignore_id))
        self.pictures.append(_write_pictures(self.out, view.name, photo, frame, label, self.trained, self.scene))

    def _unknown(self, model: Model, camera: Camera, pose: np.ndarray, check: Callable[[], None]) -> float:
        """Share of the way of a view's rays that no training photo shows, of a small picture: it takes as long as
        rendering."""
        share = min(1.0, UNKNOWN_SIDE / max(camera.width, camera.height))
        small = camera.resized(max(1, round(share * camera.width)), max(1, round(share * camera.height)))
        frame = render_view(model, small, pose, self.background, semantics=False, check=check, unknown=True)
        assert frame.unknown is not None
        return float(frame.unknown.mean())

    def _pose(
        self, view: View, camera: Camera, photo: np.ndarray, keep: np.ndarray | None, check: Callable[[], None]
    ) -> tuple[np.ndarray, dict[str, float]]:
        """Camera-to-box pose (4, 4) of a view and, where it was fitted to the photo, what the given one scores."""
        pose = box_poses([view], self.box_from_world)[0]
        if view.name in self.refined:
            return self.refined[view.name], {}
        if not self.refined:
            return pose, {}
        model, background = self.trained.model, self.background
        before = render_view(model, camera, pose, background, semantics=False, check=check)
        given = {"psnr_given_pose": psnr(to_bytes(before.color), photo, keep)}
        return refit_camera(model, camera, pose, photo, keep, background, check), given

    def means(self) -> dict[str, Any]:
        """Scores over all views."""
        names = {c.id: c.name for c in self.scene.classes}
        miou = self.confusion.miou()
        return {
            "images": len(self.scores),
            "opacity": round(float(np.mean(self.opacity)), 4),
            "depth_spread": round(float(np.median(self.spread)), 4),
            "psnr": self._mean("psnr", 3),
            "ssim": self._mean("ssim", 4),
            "lpips": None,
            "miou": None if miou is None else round(miou, 4),
            "per_class_iou": {names.get(c, str(c)): round(v, 4) for c, v in self.confusion.iou().items()},
        }

    def details(self, folder: Path) -> dict[str, Any]:
        """Scores of each view, and the pictures by their path in the project's folder, in the order of the photos."""
        place = {view.name: number for number, view in enumerate(self.scene.views)}
        taken = sorted(range(len(self.scores)), key=lambda i: place[self.scores[i]["name"]])
        rounded = [{k: (round(v, 4) if isinstance(v, float) else v) for k, v in self.scores[i].items()} for i in taken]
        result: dict[str, Any] = {
            "per_image": rounded,
            "pictures": [str(self.pictures[i].relative_to(folder)) for i in taken],
        }
        if any("psnr_given_pose" in score for score in self.scores):
            result["psnr_given_poses"] = self._mean("psnr_given_pose", 3)
        return result

    def _mean(self, key: str, digits: int) -> float:
        return round(float(np.mean([score[key] for score in self.scores])), digits)


def _name_of(background: float, environment: bool) -> str:
    if environment:
        return "environment"
    return "white" if background == 1 else "black"


def evaluate(params: EvaluateParams, report: Reporter) -> dict[str, Any]:
    """Render the held-out (or training) views of a run and compare them with the photos.

    Returns:
        {"psnr", "ssim", "lpips", "miou", "per_class_iou", "fps", "rps", "spr", "ms_sampling", "ms_network",
        "params_m", "memory_mb", "images", "background", …}; what was not measured is None, as "fps", "spr",
        "ms_sampling" and "ms_network" are unless `params.speed` asks for them. Of runs with refined poses
        training views are rendered from those and held-out ones from poses fitted to their photos;
        "psnr_given_poses" is what the latter score without that. "split" and "baked" say what was compared: with
        `params.baked` the baked field, of which "lost" says {"psnr", "miou"} by which it is worse than the field, None where
        that was not measured before. "advice" are sentences on what to photograph next.
    Raises:
        ProjectError: no such run, or no baked field of its present training. InputError: nothing is held out, or a
        photo cannot be read. SettingError: the speed of a baked field was asked for.
    """
    if params.baked and params.speed:
        raise SettingError("--speed measures the field itself.", "Leave out --baked, or look at its `rps`.")
    if params.report is not None:
        check_report(params.report)
        require_writable(params.report)
    folder, asked = Path(params.project), time.perf_counter()
    project, trained = load_project(folder), load_trained(folder, params.run)
    scene = load_scene(folder, trained.info.holdout)
    indices = scene.test if params.split == "test" else scene.train
    if not indices:
        raise InputError(
            f"The run “{params.run}” has no held-out photos: all were trained on.",
            "Train another run with --holdout 8 to measure, or measure the training photos (--split train).",
        )
    if params.split == "test":
        scene = without_guesses(without_seen(scene, trained.info, report), folder)
        indices = scene.test
    # Views larger than the training images are compared at the training size.
    sizes = [training_size(scene.views[index].camera, trained.info.image_size) for index in indices]
    shown = load_baked(folder, params.run, trained.info) if params.baked else trained.model
    refined = refined_poses(folder, params.run, trained.info)
    report.stage("Preparing")
    box_from_world = trained.info.box(project).box_from_world
    views = [scene.views[index] for index in indices]
    if not params.baked or refined:  # poses are fitted to the field
        cameras = [view.camera.resized(*size) for view, size in zip(views, sizes)]
        # However few they are: what a field is worth does not depend on how many photos are compared.
        rays = sparse_rays(cameras, box_poses(views, box_from_world), trained.device)
        trained.model.refine(math.inf, report.check, rays)
    compared = Comparison(
        trained,
        shown,
        scene,
        refined,
        box_from_world,
        _record(params).parent,
        Confusion(trained.info.class_ids if trained.model.field.classes else []),
    )
    report.stage("Rendering held-out views" if params.split == "test" else "Rendering training views")
    begin, order = time.perf_counter(), range(len(indices)) if params.time_limit is None else spread(len(indices))
    for number, place in enumerate(order):
        now = time.perf_counter()
        if params.time_limit is not None and number > 0 and now - asked + (now - begin) / number > params.time_limit:
            report.note(f"{number} of {len(indices)} photos are compared: the time is used up.")
            break
        view = scene.views[indices[place]]
        report.progress(number / len(indices), view.name)
        compared.add(view, sizes[place], report.check)
    if compared.hidden:
        report.warn(shortened("Photos whose masks leave nothing of them were not compared", compared.hidden))
    if not compared.scores:
        raise InputError("The masks leave nothing of the photos to compare.", "White in a mask marks what counts.")
    environment = trained.model.environment is not None
    speed: dict[str, Any] = dict.fromkeys(SPEED_KEYS)
    if params.speed:
        speed = measure_speed(trained, scene, indices, box_from_world, report)
    result: dict[str, Any] = {
        "run": params.run,
        "split": params.split,
        "baked": params.baked,
        "label_revision": trained.info.label_revision,
        **compared.means(),
        **speed,
        "rps": round(compared.rays / compared.seconds),
        "seconds_per_image": round(compared.seconds / len(compared.scores), 3),
        "params_m": round(trained.model.field.parameter_count() / 1e6, 3),
        "memory_mb": round(peak_memory(trained.device)),
        "background": _name_of(compared.background, environment),
        "device": str(trained.device),
        **compared.details(folder),
    }
    psnr_train = (read_metrics(run_folder(folder, params.run)).get("train") or {}).get("psnr_train")
    empty_around = trained.info.transparent or (scene.mask_mode == "empty" and any(v.mask for v in scene.views))
    opaque = not environment and not empty_around
    result["verdict"] = evaluate_verdict(result, psnr_train, opaque, bool(compared.confusion.class_ids), environment)
    if params.baked:
        result["lost"] = _lost(params, result)
    rejected = sum(image.status == "rejected" and not image.reason.startswith(TWIN) for image in project.images)
    held_out = result["per_image"] if params.split == "test" else []
    result["advice"] = advice(scene, held_out, result["per_class_iou"], rejected)
    place = run_folder(folder, params.run)
    kept_as = KEPT_AS[params.split] + ("_baked" if params.baked else "")
    write_json(place / METRICS, {**read_metrics(place), kept_as: result})
    made = step("evaluate", params.model_dump(mode="json"), result, evaluation_inputs(params), state_id(trained.state))
    write_made(_record(params), made)
    if params.report is not None:
        report.stage("Writing the report")
        found = {**results_of(load_project(folder), params.run), "evaluate": result}
        write_report(params.report, folder, params.run, folder / "exports" / params.run / "renders", found, report)
    return result


def spread(count: int) -> list[int]:
    """0 … count − 1 in an order whose first few are always spread over all of them, from the middle on, as the first and the last
    photo of a capture often see what few others do: each halves the widest gap that the ones before it leave (van der Corput's
    sequence)."""
    digits = count.bit_length() + 1
    reverse = [int(f"{number:0{digits}b}"[::-1], 2) for number in range(1, 1 << digits)]
    return list(dict.fromkeys(count * place >> digits for place in reverse))


def _record(params: EvaluateParams) -> Path:
    folder = run_folder(Path(params.project), params.run) / "evaluation"
    return (folder / "baked" if params.baked else folder) / f"{params.split}.json"


def _lost(params: EvaluateParams, baked: dict[str, Any]) -> dict[str, float | None]:
    """By how much the baked field is worse than the field was in its last evaluation, None where that is not known."""
    field = evaluated(params.model_copy(update={"baked": False})).result or {}
    pairs = {key: (field.get(key), baked[key]) for key in ("psnr", "miou")}
    return {key: None if None in pair else round(pair[0] - pair[1], 4) for key, pair in pairs.items()}


def evaluation_inputs(params: EvaluateParams) -> Fingerprint:
    """What an evaluation depends on. Raises ProjectError."""
    folder = Path(params.project)
    info = load_info(folder, params.run)
    scene = load_scene(folder, info.holdout).unseen_by(info.images)
    if params.split == "test":
        scene = without_guesses(scene, folder)
    limit = [] if params.time_limit is None else ["limited"]  # to however many seconds
    return {
        "trained field": checkpoint_id(folder, params.run),
        "classes": class_inputs(scene),
        "settings": digest([params.split, info.config.model_dump(mode="json"), *limit]),
        **({"baked field": files_digest([("meta", voxels_folder(folder, params.run) / META)])} if params.baked else {}),
        **view_inputs(scene, scene.test if params.split == "test" else scene.train, files=True),
    }


def evaluated(params: EvaluateParams) -> Earlier:
    """The evaluation that is there, if it is of the present field and photos."""
    made = read_made(_record(params))
    pictures = [Path(params.project) / name for name in made.result.get("pictures", [])] if made else []
    return compare(made, evaluation_inputs(params), pictures)


def without_guesses(scene: Scene, folder: Path) -> Scene:
    """The scene of a project without label maps of held-out views that marks or models made: they are no truth, and those of
    marks come from a field."""

    def judged(number: int, view: View) -> View:
        made = view.label is not None and is_made(view.label.relative_to(folder).as_posix())
        return replace(view, label=None, confidence=None) if made and number in held_out else view

    held_out = set(scene.test)
    return replace(scene, views=[judged(number, view) for number, view in enumerate(scene.views)])


def compared_with(
    view: View, scene: Scene, width: int, height: int, background: float
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """What a render of a view is compared with: photo (H, W, 3) uint8 on the background, mask of pixels that count (or
    None), label ids (or None)."""
    picture = resized(photo_of(view), width, height)
    keep = None
    if view.mask is not None:
        mask = nearest(read_image(view.mask)[..., 0], width, height)
        inside = mask > 127
        if scene.mask_mode == "empty":
            picture = cut_out(picture, inside)
            keep = None if (mask != MASK_UNKNOWN).all() else mask != MASK_UNKNOWN
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
    path = out / f"{name}.png"
    with atomic_path(path) as temporary:
        write_picture(temporary, side_by_side(tiles))
    return path
