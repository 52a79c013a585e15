"""Incremental mapping and repair. Runs in the pose process."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pycolmap

from . import resume
from .validate import ImageCheck, check_images

REPAIR_ROUNDS = 2  # of taking out wrong poses and placing their photos again; not tuned
SNAPSHOT_EVERY = 40  # photos
SEED = 1  # of RANSAC


def mapper_options(relaxed: bool, count: int, names: list[str]) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.image_names = names
    options.random_seed = SEED
    options.min_model_size = min(10, max(3, count // 4))
    if relaxed:
        options.min_num_matches = 10
        options.mapper.init_min_num_inliers = 40
        options.mapper.init_min_tri_angle = 6.0
        options.mapper.abs_pose_min_num_inliers = 15
        options.mapper.abs_pose_min_inlier_ratio = 0.15
    return options


class _Progress:
    """Tells how many of `count` photos are placed; `registered` of them were before mapping began.

    A mapper that gets no further begins a separate model of the photos that are left: those are no gain for the first.
    """

    def __init__(self, tell: Any, count: int, registered: int) -> None:
        self.tell, self.count = tell, count
        self.groups = [registered]  # photos of each model
        self.resumed = registered > 0

    def place(self, photos: int = 1) -> None:
        self.groups[-1] += photos
        now, before = self.groups[-1], max(self.groups[:-1], default=0)
        text = f"{max(now, before)} of {self.count} photos placed"
        if before:
            text += f", {min(now, before)} in a separate group"
        self.tell.progress(min(sum(self.groups), self.count) / self.count, text)

    def first_pair(self) -> None:
        if self.groups[-1] and not self.resumed:
            self.groups.append(0)
        self.place(0 if self.resumed else 2)  # it is called too when a model is taken up again
        self.resumed = False


def build(
    path: Path,
    image_folder: Path,
    output: Path,
    relaxed: bool,
    names: list[str],
    tell: Any,
    start: Path | None = None,
    memory: Path | None = None,
) -> list[Any]:
    """Reconstruct, from nothing or from the model in `start`; models with most images first.

    With `start` the poses and lenses in it are kept as they are, and images are added to them. `memory` is a folder
    in which snapshots and the outcome are kept, so that a run that was killed goes on from there.
    """
    if memory is not None and (finished := resume.finished_models(memory)) is not None:
        return finished
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir(parents=True)
    options = mapper_options(relaxed, len(names), names)
    registered = 0
    first = start
    if start is not None:
        options.fix_existing_frames = True
        options.multiple_models = False
        before = pycolmap.Reconstruction(str(start))
        options.constant_cameras = set(before.cameras)
        registered = before.num_reg_images()
    elif memory is not None:
        snapshots = memory / resume.SNAPSHOTS
        snapshots.mkdir(parents=True, exist_ok=True)
        options.snapshot_path = str(snapshots)
        options.snapshot_frames_freq = SNAPSHOT_EVERY
        first = resume.latest_snapshot(memory)
        if first is not None:
            registered = pycolmap.Reconstruction(str(first)).num_reg_images()
    progress = _Progress(tell, len(names), registered)
    tell.stage("Placing cameras")
    found = pycolmap.incremental_mapping(
        path,
        image_folder,
        output,
        options,
        input_path=str(first) if first else "",
        initial_image_pair_callback=progress.first_pair,
        next_image_callback=progress.place,
    )
    models = sorted(found.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    if memory is not None:
        resume.keep_models(memory, models)
    return models


def repair(
    model: Any, path: Path, image_folder: Path, work: Path, relaxed: bool, names: list[str], tell: Any
) -> tuple[Any, dict[int, ImageCheck], dict[tuple[int, int], int], dict[int, ImageCheck]]:
    """Take out images whose pose contradicts their matches, and try to place them again.

    Returns:
        the model (None when fewer than three images would be left), checks of its images, links between them, and the
        checks of those that had to stay out.
    """
    dropped: dict[int, ImageCheck] = {}
    for round_ in range(REPAIR_ROUNDS + 1):
        checks, links = check_images(model, path)
        bad = {i: check for i, check in checks.items() if check.bad}
        if not bad:
            return model, checks, links, {i: c for i, c in dropped.items() if i not in checks}
        if len(checks) - len(bad) < 3:
            return None, {}, {}, {}
        for image_id, check in bad.items():
            dropped[image_id] = check
            if model.exists_image(image_id) and model.image(image_id).has_pose:
                model.deregister_frame(model.image(image_id).frame_id)
        if round_ == REPAIR_ROUNDS:
            break
        folder = work / "repair_in"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        model.write(str(folder))
        models = build(path, image_folder, work / "repair_out", relaxed, names, tell, start=folder)
        if models and models[0].num_reg_images() >= model.num_reg_images():
            model = models[0]
    checks, links = check_images(model, path)
    return model, checks, links, {i: c for i, c in dropped.items() if i not in checks}
