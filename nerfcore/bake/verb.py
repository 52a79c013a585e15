"""The verb `bake`: the field as voxels that render fast, on the CPU, on CUDA and by graphics cards' own means."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..data.box import box_poses
from ..data.camera_rays import CameraRays
from ..data.load import load_scene
from ..data.pixels import PixelStore, training_size
from ..data.scene import Scene, View
from ..errors import SettingError
from ..geometry.cameras import Camera
from ..params import BakeParams
from ..progress import Reporter
from ..project.runs import state_id
from ..project.store import load_project, record_step
from ..render.baked import Meta, most_blocks, save_baked, texture_bytes, texture_shape, voxels_folder
from ..render.panorama import panorama
from ..render.run import Trained, load_trained, refined_poses
from .blocks import (
    Blocks,
    Check,
    finest_side,
    march_settings,
    read_blocks,
    seen_by,
    side_for,
    visible_grid,
    weights_and_cameras,
)
from .class_votes import vote
from .colors import HARMONIC_RANGE, vertex_texels
from .fit import fitted

# Not tuned: the next three.
FINEST = 96  # blocks along a side of the grid
MOST_CLASSES = 255  # that a byte tells apart, and void
MOST_VIEWS = 1000  # training photos whose rays are asked
# Measured (docs/experiments.md, “How fine must a baked field be?”):
RAYS = 2_000_000  # through training cameras, that tell what is seen
PIXELS = 16_000_000  # of the photos that the baked field is fitted to; not tuned
LEAST_SEEN = 0.05  # weight that a block has in one of these rays at least
TRIES = 3  # of grids that fit into memory, each finer than the one before; not tuned
ENOUGH = 0.92  # of the blocks that fit, with which no finer grid is tried; not tuned


def bake(params: BakeParams, report: Reporter) -> dict[str, Any]:
    """Bake a run into runs/RUN/voxels, in the place of what was baked before.

    Returns:
        {"run", "folder", "blocks", "cells", "memory_mb", "seconds", "files"}; cells: along a side of the grid
    Raises:
        ProjectError: the run has no checkpoint. SettingError: more than 255 classes.
        DiskError: the files cannot be written; what was baked before is still there.
    """
    begin, folder = time.perf_counter(), Path(params.project)
    project, trained = load_project(folder), load_trained(folder, params.run)
    classes = trained.info.class_ids if trained.model.field.classes else []
    if len(classes) > MOST_CLASSES:
        raise SettingError(
            f"The run “{params.run}” has {len(classes)} classes; a baked field holds at most {MOST_CLASSES}.",
            "Render from the field itself, or train with fewer classes.",
        )
    scene = load_scene(folder, trained.info.holdout)
    report.stage("Looking for what the photos show")
    box_from_world = trained.info.box(project).box_from_world
    asked = [scene.views[number] for number in evenly(scene.train, MOST_VIEWS)]
    cameras = [view.camera.resized(*training_size(view.camera, trained.info.image_size)) for view in asked]
    poses = trained_poses(folder, params.run, trained, asked, box_from_world)
    rays = sparser_rays(cameras, poses, trained.device)
    pixels = [1 / camera.pixels_per_radian for camera in cameras]
    blocks = visible_blocks(trained, rays, pixels, params.memory * 1e6, report.check)
    if len(blocks) == 0:
        report.warn("The photos show nothing of the field: what was baked is empty. Train longer.")
    report.stage("Reading colours")
    views = seen_by(blocks, rays, march_settings(trained.model, blocks.side, 1.0), True, report.check)
    texels, changes = vertex_texels(trained.model, blocks, views, rays.center, report.check)
    report.stage("Fitting to the photos")
    photos = training_photos(folder, params.run, trained, scene, classes, box_from_world, report)
    settings = march_settings(trained.model, blocks.side, 1.0)
    blocks = fitted(trained.model, blocks, texels, changes, photos, settings, report.check)
    vote(blocks, texels, len(classes), photos, settings, report.check)
    report.stage("Writing")
    names = {c.id: c.name for c in scene.classes}
    meta = Meta(
        checkpoint=state_id(trained.state),
        side=blocks.side,
        blocks=len(blocks),
        across=texture_shape(len(blocks)),
        contracted=settings.contracted,
        near=settings.near,
        far=settings.far,
        empty_distance=settings.empty_distance,
        harmonic_range=HARMONIC_RANGE,
        class_ids=classes,
        class_names=[names.get(number, str(number)) for number in classes],
        sfm_from_box=trained.info.sfm_from_box,
        environment=trained.model.environment is not None,
        label_revision=trained.info.label_revision,
    )
    environment = panorama(trained.model, report.check) if meta.environment else None
    place = voxels_folder(folder, params.run)
    lut = class_table(scene, classes)
    index = blocks.index().cpu().numpy()
    files = save_baked(place, meta, index, texels.cpu().numpy(), changes.cpu().numpy(), lut, environment)
    result = {
        "run": params.run,
        "folder": str(place),
        "blocks": len(blocks),
        "cells": settings.resolution,
        "label_revision": meta.label_revision,
        "memory_mb": round(texture_bytes(len(blocks), blocks.side) / 1e6, 1),
        "seconds": round(time.perf_counter() - begin, 1),
        "files": [str(path) for path in files],
    }
    record_step(folder, "bake", params.model_dump(mode="json"), result)
    return result


def evenly(numbers: list[int], most: int) -> list[int]:
    """So many of the numbers at most, evenly from first to last."""
    return [numbers[n] for n in np.unique(np.linspace(0, len(numbers) - 1, most).round().astype(int))]


def sparser_rays(cameras: list[Camera], poses: np.ndarray, device: torch.device) -> CameraRays:
    """Rays of cameras (poses (V, 4, 4)), made so small that there are about `RAYS`."""
    pixels = sum(camera.width * camera.height for camera in cameras)
    scale = min(1.0, (RAYS / max(pixels, 1)) ** 0.5)
    small = [c.resized(max(1, round(c.width * scale)), max(1, round(c.height * scale))) for c in cameras]
    return CameraRays(small, poses, device)


def trained_poses(
    folder: Path, run: str, trained: Trained, views: list[View], box_from_world: np.ndarray
) -> np.ndarray:
    """Camera-to-box poses (V, 4, 4) of training views as the field knows them."""
    refined = refined_poses(folder, run, trained.info)
    poses = box_poses(views, box_from_world)
    for number, view in enumerate(views):
        poses[number] = refined.get(view.name, poses[number])
    return poses


def training_photos(
    folder: Path,
    run: str,
    trained: Trained,
    scene: Scene,
    classes: list[int],
    box_from_world: np.ndarray,
    report: Reporter,
) -> PixelStore:
    """Training photos and the labels of these classes, as large as in training, so many of them that there are about `PIXELS`."""
    size = sum(math.prod(training_size(scene.views[n].camera, trained.info.image_size)) for n in scene.train)
    count = max(1, min(len(scene.train), int(len(scene.train) * PIXELS / max(size, 1))))
    chosen = evenly(scene.train, count)
    photos = PixelStore(scene, chosen, classes, box_from_world, trained.info.image_size, trained.device, report)
    poses = trained_poses(folder, run, trained, photos.views, box_from_world)
    photos.rays = CameraRays(photos.cameras, poses, trained.device)
    return photos


def visible_blocks(trained: Trained, rays: CameraRays, angles: list[float], memory: float, check: Check) -> Blocks:
    """The blocks that rays of training cameras see, of the finest grid found with which they fit into so many bytes.

    `angles`: the width of a pixel of each camera's photo over its distance.
    """
    model = trained.model
    model.refine(check=check, everywhere=True)
    grid = visible_grid(model, model.render_grid(), rays, check)
    finest = min(FINEST, finest_side(grid, rays.center, torch.tensor(angles, device=rays.device)))

    def seen(side: int) -> Blocks:
        found = read_blocks(model, grid, side, check)
        views = seen_by(found, rays, march_settings(model, side, 1.0), False, check)
        weights, _ = weights_and_cameras(views.amax(1))
        return found.kept(weights > LEAST_SEEN)

    return finest_blocks(seen, finest, memory)


def finest_blocks(seen: Callable[[int], Blocks], finest: int, memory: float) -> Blocks:
    """The blocks `seen` of a grid with so many along a side, at most `finest`, as fine as fits into so many bytes.

    How many there are depends on where their sides meet walls: 70 along a side can be more blocks than 74. So the first
    grid, a coarse one, only tells how fine the next may be, and a next one is tried where the last left much over.
    """
    highest = min(finest, int((memory / 16) ** (1 / 3)))  # the index takes a quarter at most
    found, best, fitting = seen(max(1, highest // 3)), None, 0
    while True:
        wanted = side_for(len(found), found.side, most_blocks(memory, highest))
        found = seen(min(highest, wanted if best is None else max(wanted, best.side + 1)))
        most = most_blocks(memory, found.side)
        if len(found) > most:
            highest = found.side - 1
        else:
            best, fitting = found, fitting + 1
        if best is not None and (best.side >= highest or fitting == TRIES or len(best) >= ENOUGH * most):
            return best


def class_table(scene: Scene, class_ids: list[int]) -> np.ndarray:
    """Colour and opacity (256, 4) uint8 of each class index; all classes are opaque."""
    colors = {c.id: c.color for c in scene.classes}
    table = np.full((256, 4), 255, np.uint8)
    for index, number in enumerate(class_ids):
        table[index, :3] = np.round(np.array(colors.get(number, (1.0, 1.0, 1.0))) * 255)
    return table
