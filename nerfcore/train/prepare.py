"""From a project to a trainer: classes, box, pixels, visibility."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ..config import MOST_VERTICES, RunConfig
from ..data.box import Box, box_poses, choose_box, looks_inward
from ..data.load import load_scene
from ..data.pixels import VOID, PixelStore
from ..data.scene import Scene
from ..errors import SettingError, TrainingError
from ..field.blend import RESOLUTION
from ..geometry.frames import focus_point
from ..geometry.similarity import transform_points
from ..images.working import read_label, shows_transparency
from ..kernels.device import free_memory
from ..progress import Reporter
from ..project.label_revision import map_revision
from ..project.runs import HOLDOUT
from ..project.store import load_project, load_visibility, world_from_sfm
from ..render.run import CPU_IMAGE_SIZE, GPU_IMAGE_SIZE, RunInfo, new_model
from ..sampling.known_space import KnownSpace, known_space
from .background import LEVEL, choose_background
from .depth import depth_scale, find_depths
from .sky_masks import sky_masks
from .sky_stage import SkyStage
from .trainer import Trainer

VIEWS_ENOUGH = 8  # cells seen by this many cameras count fully as evidence; not tuned


def present_classes(scene: Scene, indices: list[int]) -> list[int]:
    """Ids of the classes that occur in the labels of some views, without void, ascending."""
    present: set[int] = set()
    for index in indices:
        path = scene.views[index].label
        if path is not None:
            present.update(np.unique(read_label(path)).tolist())
    present.discard(scene.ignore_id)
    declared = {c.id for c in scene.classes}
    return sorted(present & declared) if declared else sorted(present)


def has_transparency(scene: Scene) -> bool:
    """Whether some training photo has empty surroundings: an alpha channel in use, or a mask that means "empty"."""
    views = [scene.views[i] for i in scene.train]
    if scene.mask_mode == "empty" and any(view.mask is not None for view in views):
        return True
    return any(shows_transparency(view.image) for view in views)


def pixels_across(scene: Scene, views: list[int], box: Box, image_size: int) -> int:
    """Pixels of the photos that fit side by side into the grid: its side by the median footprint of a pixel at the
    middle of the box."""
    footprints = []
    for index, pose in zip(views, box_poses([scene.views[i] for i in views], box.box_from_world)):
        camera = scene.views[index].camera
        scale = min(1.0, image_size / max(camera.width, camera.height))
        footprints.append(max(float(np.linalg.norm(pose[:3, 3])), 0.5) / (camera.pixels_per_radian * scale))
    return round((4.0 if box.contracted else 2.0) / float(np.median(footprints)))


def plan_run(
    project_folder: Path, preset: str, config: RunConfig, device: torch.device, holdout: int = HOLDOUT
) -> tuple[RunInfo, Scene]:
    """Decide what a run will be: its views, classes and box, and the settings that follow from the photos.

    Raises:
        TrainingError: fewer than two posed training images, or more classes than a field tells apart.
        SettingError: an environment behind transparent photos.
    """
    project, scene = load_project(project_folder), load_scene(project_folder, holdout)
    train = training_views(scene, config)
    if len(train) < 2:
        raise TrainingError(
            f"{project_folder} has {len(train)} posed training image.",
            "At least two are needed: add photos and run poses.",
        )
    transparent = has_transparency(scene)
    if transparent and config.scene.background == "environment":
        raise SettingError(
            "scene.background is “environment”, and photos or masks are transparent: nothing tells what is behind.",
            "Leave it at “auto”.",
        )
    background = choose_background(scene, transparent)
    # In front of one colour all around there is nothing but that colour, unless somebody says what else.
    asked = config.scene.background
    box = choose_box(scene, config.scene, transparent or (background in LEVEL and asked in ("auto", *LEVEL)))
    config = config.model_copy(deep=True)
    if config.scene.image_size is None:
        config.scene.image_size = CPU_IMAGE_SIZE if device.type == "cpu" else GPU_IMAGE_SIZE
    if config.scene.background == "auto":
        config.scene.background = background
    if config.field.finest is None:
        across = pixels_across(scene, train, box, config.scene.image_size)
        config.field.finest = min(max(across, 2 * config.field.coarsest), MOST_VERTICES)
    class_ids = present_classes(scene, train) if config.loss.semantic_weight > 0 else []
    if len(class_ids) > VOID:
        raise TrainingError(
            f"The labels of {project_folder} hold {len(class_ids)} classes; a field tells at most {VOID} apart.",
            "Leave some out of the project's classes, or train without: --set loss.semantic_weight=0.",
        )
    priority = {c.id: c.priority for c in scene.classes}
    info = RunInfo(
        preset=preset,
        config=config,
        class_ids=class_ids,
        priorities=[priority.get(i, 1.0) for i in class_ids],
        images=[scene.views[i].name for i in train],
        sfm_from_box=(np.linalg.inv(world_from_sfm(project)) @ box.world_from_box).tolist(),
        contracted=box.contracted,
        transparent=transparent,
        holdout=holdout,
        map_revision=map_revision(project) if class_ids else None,
    )
    return info, scene


def without_effect(asked: RunConfig, classes: int) -> list[str]:
    """Sentences on what was asked for and does nothing beside the other settings; `classes`: how many there are to learn."""
    told = []
    if asked.field.levels == 1 and asked.field.finest is not None and asked.field.branch != "implicit":
        told.append("field.finest has no effect: with one level there are the vertices of field.coarsest alone.")
    if asked.sampling.pdf == "literal" and not classes:
        told.append("sampling.pdf=literal has no effect: without classes samples are spread evenly, as with uniform.")
    return told


def training_views(scene: Scene, config: RunConfig) -> list[int]:
    """Indices of the views to train on; `view_share` keeps an evenly spread part of them."""
    share = config.train.view_share
    if share >= 1:
        return scene.train
    count = max(2, round(len(scene.train) * share))
    return [scene.train[i] for i in np.linspace(0, len(scene.train) - 1, count).round().astype(int)]


def make_trainer(project_folder: Path, info: RunInfo, scene: Scene, device: torch.device, report: Reporter) -> Trainer:
    """Load the pixels and build the trainer of a run.

    Raises:
        TrainingError: a photo of the run is gone from the project, or masks leave nothing of the photos.
    """
    config = info.config
    names = {view.name: i for i, view in enumerate(scene.views)}
    missing = [name for name in info.images if name not in names]
    if missing:
        raise TrainingError(
            f"Image {missing[0]} of this run is gone from the project.", "Train a new run (--run NAME)."
        )
    trained = [names[name] for name in info.images]
    project = load_project(project_folder)
    box = info.box(project)
    report.stage("Loading photos")
    store = PixelStore(
        scene,
        trained,
        info.class_ids,
        box.box_from_world,
        info.image_size,
        device,
        report,
        photo_budget(config, device),
    )
    if store.usable is not None and not len(store.usable):
        raise TrainingError("The masks leave nothing of the photos to train on.", "White in a mask marks what counts.")
    if store.home != device:
        report.warn(
            f"{len(store) / 1e6:.0f} million pixels are more than the device's memory has room for "
            "(scene.photo_memory): they stay in the host's memory, which takes longer."
        )
    degrade(store, config)
    space = space_of(scene, trained, box, config, device)
    shown, known = (_at_resolution(cells, config.sampling.resolution) for cells in (space.views > 0, ~space.unknown))
    model = new_model(info, device, shown, ~known)
    model.occupancy.empty_distance.fill_(space.empty_distance)
    if model.field.blend is not None:
        model.field.blend.views.copy_((space.views / VIEWS_ENOUGH).clamp(max=1))
    trainer = Trainer(model, store, config, LEVEL.get(config.scene.background), report.check)
    trainer.space = space
    if model.environment is not None and config.train.environment_start > 0:
        masks = sky_masks(store.views, store.cameras, scene.points.xyz, device, report.check)
        trainer.sky = SkyStage(masks, config.train.environment_start)
    if config.loss.depth_weight > 0:
        scale = depth_scale(world_from_sfm(project), box.box_from_world)
        visibility = load_visibility(project_folder)
        trainer.depths = find_depths(scene, store, visibility, box.box_from_world, scale, box.contracted)
        if not len(trainer.depths):
            report.warn("loss.depth_weight has no effect: the project has neither depth maps nor points of its views.")
    return trainer


def photo_budget(config: RunConfig, device: torch.device) -> float:
    """Bytes of the device's memory that the training photos may take."""
    given = config.scene.photo_memory
    return free_memory(device) / 2 if given is None else given * 1e9


def space_of(scene: Scene, trained: list[int], box: Box, config: RunConfig, device: torch.device) -> KnownSpace:
    """What the views `trained` tell of the cells of the grid of evidence."""
    views = [scene.views[i] for i in trained]
    poses = torch.from_numpy(box_poses(views, box.box_from_world)).float().to(device)
    points = torch.from_numpy(transform_points(box.box_from_world, scene.points.xyz)).float().to(device)
    focus = None
    if looks_inward(views):
        point = focus_point([view.camera_to_world for view in views])
        center = transform_points(box.box_from_world, point[None])[0]
        focus = torch.from_numpy(center).float().to(device)
    cameras = [view.camera for view in views]
    return known_space(cameras, poses, points, focus, RESOLUTION, box.contracted, config.sampling)


def _at_resolution(cells: torch.Tensor, resolution: int) -> torch.Tensor:
    """A cubic grid of cells (N³,) bool at another resolution (resolution³,), on the CPU: those that any of the cells reaches
    into."""
    side = round(len(cells) ** (1 / 3))
    grid = cells.cpu().view(1, side, side, side).float()
    return torch.nn.functional.adaptive_max_pool3d(grid, resolution).view(-1) > 0


def degrade(store: PixelStore, config: RunConfig) -> None:
    """Input noise, label noise and missing labels of the robustness tests, the same for the same seed."""
    t = config.train
    generator = torch.Generator().manual_seed(t.seed + 1)
    if t.noise > 0:
        noise = torch.randn(len(store), 3, generator=generator) * (t.noise * 255)
        noisy = (store.rgba[:, :3].float().cpu() + noise).round().clamp(0, 255)
        store.rgba[:, :3] = noisy.to(torch.uint8).to(store.home)
    if t.labelled_share < 1:
        count = len(store.views)
        kept = max(1, round(count * t.labelled_share)) if t.labelled_share > 0 else 0
        keep = torch.randperm(count, generator=generator)[:kept].tolist()
        for index in set(range(count)) - set(keep):
            store.label[int(store.first[index]) : int(store.first[index + 1])] = 255
    if t.label_noise > 0:
        flip = torch.rand(len(store), generator=generator) < t.label_noise
        classes = max(int(store.label[store.label != 255].max()) + 1, 1) if bool((store.label != 255).any()) else 1
        wrong = torch.randint(0, classes, (len(store),), generator=generator).to(torch.uint8)
        flip &= store.label.cpu() != 255
        store.label[flip.to(store.home)] = wrong[flip].to(store.home)
