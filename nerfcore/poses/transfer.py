"""A model taken to another database: other features of the same photos, or other ids. Runs in the pose process."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pycolmap

from .features import database


def start_model(model: Any, path: Path, image_folder: Path, folder: Path) -> Path:
    """Write `model` so that mapping in the database `path` can go on from it; returns the folder.

    A model of other features than the database's keeps its poses and lenses, and gets points from the database's
    features.
    """
    taken_to(model, path, image_folder, folder).write(str(folder))
    return folder


def taken_to(model: Any, path: Path, image_folder: Path, folder: Path) -> Any:
    """The model with the ids and features of the database `path`: itself where it has them; `folder` is made anew."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if belongs_to(model, path):
        set_lens_models(path, model)
        return model
    bare = posed_model(model, path)
    set_lens_models(path, bare)
    bare.write(str(folder))
    return pycolmap.triangulate_points(bare, path, image_folder, folder, clear_points=True)


def set_lens_models(path: Path, model: Any) -> None:
    """Give the lenses in the database `path` the lens models that those of `model` have: COLMAP refuses to go on from a
    model with others, and the database has those of the last attempt."""
    with database(path) as db:
        for camera in db.read_all_cameras():
            if model.exists_camera(camera.camera_id) and model.camera(camera.camera_id).model != camera.model:
                camera.model = model.camera(camera.camera_id).model
                camera.params = model.camera(camera.camera_id).params
                db.update_camera(camera)


def belongs_to(model: Any, path: Path) -> bool:
    """Whether a model has the ids of a database, and as many features of each photo."""
    with database(path) as db:
        images = {image.name: image for image in db.read_all_images()}
        counts = {name: db.num_keypoints_for_image(image.image_id) for name, image in images.items()}
    for image in model.images.values():
        other = images.get(image.name)
        if other is None or counts[image.name] != image.num_points2D():
            return False
        if (other.image_id, other.camera_id, other.frame_id) != (image.image_id, image.camera_id, image.frame_id):
            return False
    return True


def posed_model(model: Any, path: Path) -> Any:
    """The poses and lenses of a model for the photos of the same names in a database, without points."""
    known = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    bare = pycolmap.Reconstruction()
    with database(path) as db:
        images = [image for image in db.read_all_images() if image.name in known]
        lenses = {image.camera_id: known[image.name].camera for image in images}
        frames = {image.frame_id for image in images}
        for camera in db.read_all_cameras():
            if camera.camera_id in lenses:
                camera.model = lenses[camera.camera_id].model
                camera.params = lenses[camera.camera_id].params
                bare.add_camera(camera)
        for rig in db.read_all_rigs():
            if rig.ref_sensor_id.id in lenses:
                bare.add_rig(rig)
        for frame in db.read_all_frames():
            if frame.frame_id in frames:
                bare.add_frame(frame)
    for image in images:
        bare.add_image(image)
        bare.frame(image.frame_id).rig_from_world = known[image.name].cam_from_world()
        bare.register_frame(image.frame_id)
    return bare
