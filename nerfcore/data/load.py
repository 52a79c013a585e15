"""A capture project as the scene that training reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import ProjectError
from ..project.fingerprints import Fingerprint, digest, files_digest, rounded
from ..project.runs import HOLDOUT
from ..project.store import load_points, load_poses, load_project, world_from_sfm
from .scene import ClassInfo, Scene, View


def load_scene(folder: Path, holdout: int = HOLDOUT) -> Scene:
    """The posed views of a project in the world frame, split into train and test.

    Images whose split is "auto" are divided as usual for captures: every `holdout`-th one is held out, starting with
    the first, unless the project names test images itself. With 0 all views are there to train on.
    """
    folder = Path(folder)
    project, poses = load_project(folder), load_poses(folder)
    records = {image.name: image for image in project.images if image.status != "rejected"}
    views, splits = [], []
    for posed in sorted(poses.images, key=lambda image: image.name):
        record = records.get(posed.name)
        if record is None:
            continue
        views.append(
            View(
                name=posed.name,
                camera=poses.cameras[posed.camera],
                camera_to_world=np.array(posed.camera_to_world, np.float64),
                image=folder / record.file,
                label=folder / record.label if record.label else None,
                mask=folder / record.mask if record.mask else None,
                confidence=folder / record.confidence if record.confidence else None,
                depth=folder / record.depth if record.depth else None,
                gain=posed.gain,
            )
        )
        splits.append(record.split)
    if not views:
        raise ProjectError(f"{folder} has no posed images.", "Run `fieldwork poses` again.")
    train, test = split_views(splits, holdout)
    bounds = np.array(project.frame.bounds, np.float64) if project.frame.bounds else None
    scene = Scene(
        views=views,
        train=train,
        test=test,
        classes=[ClassInfo(c.id, c.name, c.color, c.priority) for c in project.classes],
        ignore_id=project.ignore_id,
        points=load_points(folder),
        mask_mode=project.mask_mode,
    ).transformed(world_from_sfm(project), "world")
    return Scene(**{**vars(scene), "bounds": bounds})


def view_inputs(scene: Scene, indices: list[int], files: bool) -> Fingerprint:
    """Fingerprint of some views as they lie in the world: cameras, and with `files` photos, labels and masks too."""
    views = [scene.views[i] for i in indices]
    cameras = [[v.name, v.camera.model_dump(mode="json"), rounded(v.camera_to_world)] for v in views]
    inputs = {"cameras": digest(cameras)}
    if files:
        photos, gains = files_digest((v.name, v.image) for v in views), [v.gain for v in views]
        inputs |= {
            "photos": digest([photos, gains]) if any(gains) else photos,
            "labels": files_digest((v.name, v.label) for v in views),
            "masks": digest([scene.mask_mode, files_digest((v.name, v.mask) for v in views)]),
        }
    return inputs


def class_inputs(scene: Scene) -> str:
    """Digest of the classes as they are shown: ids, names, colours."""
    return digest([scene.ignore_id, [[c.id, c.name, c.color] for c in scene.classes]])


def split_views(splits: list[str], holdout: int = HOLDOUT) -> tuple[list[int], list[int]]:
    """Indices of training and held-out views from the "train"/"test"/"auto" marks of all views, in name order."""
    if holdout == 0:
        return list(range(len(splits))), []
    if "test" in splits:
        return [i for i, s in enumerate(splits) if s != "test"], [i for i, s in enumerate(splits) if s == "test"]
    automatic = [i for i, s in enumerate(splits) if s == "auto"]
    held_out = set(automatic[::holdout]) if len(automatic) >= holdout else set()
    return [i for i in range(len(splits)) if i not in held_out], sorted(held_out)
