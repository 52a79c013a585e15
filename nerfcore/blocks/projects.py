"""A project for each block: its photos, their poses, and its part of the world as the region of interest."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..data.load import load_scene
from ..files import atomic_path, linked
from ..geometry.points import Points
from ..project.schema import Frame, ImageRecord, Project
from ..project.store import (
    create_folder,
    edit_project,
    load_points,
    load_poses,
    load_project,
    load_visibility,
    save_poses,
)
from .plan import BlockPlan, Plan, block_folder

FILES = ("file", "label", "instances", "mask", "confidence", "depth")  # of an image's record


def write_block(folder: Path, plan: Plan, block: BlockPlan, holdout: int) -> Path:
    """Make the project of a block, or bring it up to date: what it was trained to stays, and is trained anew only where
    its photos or its region have changed.

    Args:
        folder: the whole capture's project. holdout: every how manieth of its photos is held out.
    Raises:
        ProjectError, DiskError.
    """
    whole, target = load_project(folder), block_folder(folder, block)
    create_folder(target)
    scene, names = load_scene(folder, holdout), set(block.images)
    held_out = {scene.views[i].name for i in scene.test}
    records = [_own(image, folder, target, held_out) for image in whole.images if image.name in names]
    low, high = plan.region(block)
    with edit_project(target, fresh=Project()) as project:
        project.images, project.classes = records, whole.classes
        project.ignore_id, project.mask_mode = whole.ignore_id, whole.mask_mode
        project.frame = Frame(**{**whole.frame.model_dump(), "bounds": [low.tolist(), high.tolist()]})
    _write_poses(folder, target, names)
    return target


def _own(image: ImageRecord, folder: Path, target: Path, held_out: set[str]) -> ImageRecord:
    """The record of a photo in a block's project, which gets its files."""
    for name in FILES:
        file = getattr(image, name)
        if file:
            _place(folder / file, target / file)
    return image.model_copy(update={"split": "test" if image.name in held_out else "train"})


def _place(source: Path, target: Path) -> None:
    """The same file at another place: a second name where the disk knows such, else a copy."""
    if not source.is_file():
        return
    if target.is_file():
        old, new = target.stat(), source.stat()
        if (old.st_size, old.st_mtime_ns) == (new.st_size, new.st_mtime_ns):
            return
    with atomic_path(target) as temporary:
        temporary.unlink(missing_ok=True)
        linked(str(source), str(temporary))


def _write_poses(folder: Path, target: Path, names: set[str]) -> None:
    """The poses of the photos, and the points that they see; all points where it is not known who sees which."""
    poses, points, sights = load_poses(folder), load_points(folder), load_visibility(folder)
    images = [image for image in poses.images if image.name in names]
    known = [sights.get(image.name, np.zeros(0, np.int32)) for image in images]
    kept = np.unique(np.concatenate(known)) if sum(map(len, known)) else np.arange(len(points))
    number = np.full(len(points), -1, np.int32)
    number[kept] = np.arange(len(kept), dtype=np.int32)
    view = np.repeat(np.arange(len(images), dtype=np.int32), [len(seen) for seen in known])
    point = number[np.concatenate(known)] if len(view) else np.zeros(0, np.int32)
    own = Points(points.xyz[kept], points.rgb[kept], points.error[kept])
    save_poses(target, poses.model_copy(update={"images": images}), own, (view, point))
