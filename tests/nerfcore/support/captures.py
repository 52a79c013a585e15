"""Ingesting and posing real captures, and comparing them with the truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from fieldwork.nerfcore.capture.ingest import new
from fieldwork.nerfcore.data.importer import read_dataset
from fieldwork.nerfcore.geometry.cameras import rays
from fieldwork.nerfcore.geometry.similarity import fit_similarity, transform_points
from fieldwork.nerfcore.params import NewParams, PosesParams
from fieldwork.nerfcore.poses.estimate import estimate_poses
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_poses

Data = Callable[[str], Path]


def ingest(photos: Path, project: Path, **settings: object) -> Path:
    new(NewParams(photos=photos, project=project, **settings), Reporter())  # type: ignore[arg-type]
    return project


def poses(project: Path, preset: str = "fast", **settings: object) -> dict:
    return estimate_poses(PosesParams(project=project, preset=preset, **settings), Reporter())  # type: ignore[arg-type]


def centre_errors(project: Path, dataset: Path) -> np.ndarray:
    """Errors of camera centres after the best similarity, in per cent of the extent of the true ones."""
    truth = {view.name: view.camera_to_world[:3, 3] for view in read_dataset(dataset).views}
    found = {image.name: np.array(image.camera_to_world)[:3, 3] for image in load_poses(project).images}
    a, b = np.stack([found[name] for name in sorted(found)]), np.stack([truth[name] for name in sorted(found)])
    misfit = np.linalg.norm(transform_points(fit_similarity(a, b), a) - b, axis=1)
    return 100 * misfit / np.linalg.norm(np.ptp(b, axis=0))


def view_errors(project: Path, dataset: Path) -> np.ndarray:
    """Errors of viewing directions in degrees: pose and lens together, over all photos and each photo's area.

    The rotation of a pose alone says less: a shift of the principal point by d pixels and a turn of all cameras by
    d / f show the same pictures.
    """
    truth = {view.name: view for view in read_dataset(dataset).views}
    poses = load_poses(project)
    pairs = [(image, truth[image.name]) for image in poses.images]
    found = np.stack([np.array(image.camera_to_world) for image, _ in pairs])
    true = np.stack([view.camera_to_world for _, view in pairs])
    fit = fit_similarity(found[:, :3, 3], true[:, :3, 3])
    turn = fit[:3, :3] / np.cbrt(np.linalg.det(fit[:3, :3]))
    grid = np.stack(np.meshgrid(np.linspace(0.05, 0.95, 12), np.linspace(0.05, 0.95, 12)), -1).reshape(-1, 2)
    errors = []
    for (image, view), pose in zip(pairs, found):
        ours = poses.cameras[image.camera]
        a, valid_a = rays(ours, grid * [ours.width, ours.height])
        b, valid_b = rays(view.camera, grid * [view.camera.width, view.camera.height])
        a, b = a @ (turn @ pose[:3, :3]).T, b @ view.camera_to_world[:3, :3].T
        sine = np.linalg.norm(np.cross(a, b), axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
        errors.append(np.degrees(np.arcsin(np.clip(sine, 0, 1)))[valid_a & valid_b])
    return np.concatenate(errors)


def rotation_errors(project: Path, dataset: Path) -> np.ndarray:
    """Errors of the cameras' rotations in degrees, after the similarity that fits their centres best."""
    truth = {view.name: view.camera_to_world for view in read_dataset(dataset).views}
    images = load_poses(project).images
    found = np.stack([np.array(image.camera_to_world) for image in images])
    true = np.stack([truth[image.name] for image in images])
    fit = fit_similarity(found[:, :3, 3], true[:, :3, 3])
    turn = fit[:3, :3] / np.cbrt(np.linalg.det(fit[:3, :3]))
    left = np.einsum("nji,jk,nkl->nil", true[:, :3, :3], turn, found[:, :3, :3])
    return np.degrees(np.arccos(np.clip((np.trace(left, axis1=1, axis2=2) - 1) / 2, -1, 1)))
