"""How long labelling keeps one waiting, and what accepting changes: the verbs themselves, on a copy of the project."""

from __future__ import annotations

import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..data.box import box_poses
from ..data.load import load_scene
from ..data.photo import photo_of
from ..evaluate.metrics import Confusion, psnr
from ..files import linked
from ..images.picture import over, resized, to_bytes
from ..images.working import nearest
from ..labels.accept import accept
from ..labels.assist.verbs import segment
from ..labels.journal import Mark
from ..labels.overlay import photo_labels
from ..labels.propagate import propagate
from ..labels.revisions import computed
from ..labels.stroke import checkout, stroke
from ..params import (
    AssistSegmentParams,
    LabelAcceptParams,
    LabelCheckoutParams,
    LabelPropagateParams,
    LabelStrokeParams,
)
from ..progress import Reporter
from ..project.store import load_project
from ..render.image import background_of, render_view
from ..render.run import load_trained
from .label_stand_in import decoder, encoder
from .label_trials import Annotator, Subject, scores

LOOKS = 20  # photos whose labels are looked up
CLICKS = 10
VIEWS = 6  # held-out photos that are rendered before and after accepting
STROKES = 10


class Watch(Reporter):
    """Remembers when progress was told first after a call of `begin`, and hands cancels on."""

    def __init__(self, report: Reporter) -> None:
        super().__init__()
        self._report, self.first, self._begin = report, 0.0, 0.0

    def begin(self) -> None:
        self.first, self._begin = 0.0, time.perf_counter()

    def progress(self, fraction: float, message: str = "") -> None:
        self.first = self.first or time.perf_counter() - self._begin

    def check(self) -> None:
        self._report.check()


def waiting_times(project: Path, subject: Subject, seed: int, report: Reporter) -> dict[str, list[float]]:
    """Seconds of each, in one process that is warm: "parts" and "full", from the release of a stroke until the labels of
    whole parts and of all surfels are on disk; "undo", until the labels of the revision before are those of a photo;
    "overlay", the labels of another photo; "click", an answer of a model but for the model's own time."""
    watch = Watch(report)
    everything = Annotator(subject, seed).marks
    marks = everything[: STROKES + 1]
    found: dict[str, list[float]] = {"parts": [], "full": [], "undo": [], "overlay": [], "click": []}
    for number, mark in enumerate(marks):
        watch.begin()
        begin = time.perf_counter()
        draw(project, mark, report)
        propagate(LabelPropagateParams(project=project), watch)
        if number:  # the first one warms up
            found["parts"].append(watch.first)
            found["full"].append(time.perf_counter() - begin)
    photo = subject.first[0]
    for number in range(len(marks) - 1, 0, -1):
        begin = time.perf_counter()
        checkout(LabelCheckoutParams(project=project, revision=number), report)
        photo_labels(*computed(project, "main", None), photo, subject.void)
        found["undo"].append(time.perf_counter() - begin)
    checkout(LabelCheckoutParams(project=project, revision=len(marks)), report)
    for mark in everything[len(marks) :]:  # what is accepted later has all classes
        draw(project, mark, report)
    propagate(LabelPropagateParams(project=project), report)
    ready, shown = computed(project, "main", None)
    photo_labels(ready, shown, photo, subject.void)
    for other in ready.photos[:LOOKS]:
        begin = time.perf_counter()
        photo_labels(ready, shown, other.name, subject.void)
        found["overlay"].append(time.perf_counter() - begin)
    found["click"] = click_times(project, photo, report)
    return found


def draw(project: Path, mark: Mark, report: Reporter) -> None:
    """Take a simulated mark into the project's journal."""
    values = mark.model_dump(include={"photo", "shape", "points", "width", "class_id"})
    stroke(LabelStrokeParams.model_validate({"project": project, **values}), report)


def click_times(project: Path, photo: str, report: Reporter) -> list[float]:
    """Seconds of clicks on a photo that was encoded before, with a model that computes nothing."""
    folder = project / "jobs" / "stand-in"
    folder.mkdir(parents=True, exist_ok=True)
    eyes, mouth = encoder(folder / "encoder.onnx"), decoder(folder / "decoder.onnx")
    record = next(image for image in load_project(project).images if image.name == photo)
    random, found = np.random.default_rng(0), []
    for number in range(CLICKS + 1):
        point = (float(random.uniform(0, record.width)), float(random.uniform(0, record.height)))
        begin = time.perf_counter()
        asked = AssistSegmentParams(project=project, photo=photo, points=[point], encoder=eyes, decoder=mouth)
        segment(asked, report)
        if number:  # the first one encodes
            found.append(time.perf_counter() - begin)
    return found


def accepted(project: Path, subject: Subject, report: Reporter) -> dict[str, float]:
    """{"seconds", "psnr": by how many dB held-out photos changed, "miou" and "shown": of the field's classes and of the
    labels that were accepted, on the same photos}."""
    chosen = subject.test[:: max(1, len(subject.test) // VIEWS)][:VIEWS]
    some = replace(subject, test=chosen)
    _, shown = computed(project, "main", None)
    before, _ = rendered(project, some, report)
    begin = time.perf_counter()
    accept(LabelAcceptParams(project=project), report)
    seconds = time.perf_counter() - begin
    after, miou = rendered(project, some, report)
    return {
        "seconds": round(seconds, 2),
        "psnr": round(after - before, 4),
        "miou": miou or 0.0,
        "shown": scores(some, shown)["miou"],
    }


@torch.no_grad()
def rendered(project: Path, subject: Subject, report: Reporter) -> tuple[float, float | None]:
    """Mean PSNR of a subject's held-out photos at the size of their maps, and mIoU of the field's classes; None where it has
    none."""
    trained, scene = load_trained(project, "main"), load_scene(project)
    box = trained.info.box(load_project(project))
    confusion, found = Confusion(subject.class_ids), []
    for view in (view for view in scene.views if view.name in subject.test):
        size = subject.ready.of_photo[view.name]
        camera, pose = view.camera.resized(size.width, size.height), box_poses([view], box.box_from_world)[0]
        frame = render_view(trained.model, camera, pose, background_of(trained.info), check=report.check)
        photo = over(resized(photo_of(view), camera.width, camera.height), background_of(trained.info))
        found.append(psnr(to_bytes(frame.color), to_bytes(photo.pixels[..., :3])))
        truth = subject.truth[view.name]
        if trained.info.class_ids:
            ids = frame.label(trained.info.class_ids, subject.void)
            confusion.add(truth, nearest(ids.astype(np.int32), truth.shape[1], truth.shape[0]))
    miou = confusion.miou() if trained.info.class_ids else None
    return float(np.mean(found)), None if miou is None else round(miou, 4)


def without_marks(project: Path, target: Path) -> Path:
    """A copy of a project, with the same files where the file system can, that has no marks and no revisions."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(project, target, copy_function=linked, ignore=shutil.ignore_patterns("marks", "revisions", "jobs"))
    (target / "jobs").mkdir(exist_ok=True)
    return target


def figures_of(seconds: list[float]) -> dict[str, Any]:
    """Median and 95th percentile."""
    return {"median": round(float(np.median(seconds)), 4), "p95": round(float(np.percentile(seconds, 95)), 4)}
