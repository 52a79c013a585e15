"""Masks that Fieldwork made keep what the others of the capture agree with."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import scipy
from fieldwork.nerfcore.capture.backdrop import object_mask
from fieldwork.nerfcore.data.hull import trim_masks
from fieldwork.nerfcore.data.importer import import_dataset
from fieldwork.nerfcore.geometry.points import Points
from fieldwork.nerfcore.images.working import MASK_UNKNOWN, read_image, read_picture
from fieldwork.nerfcore.params import ImportParams, PosesParams
from fieldwork.nerfcore.poses import estimate
from fieldwork.nerfcore.poses.inputs import posed
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_poses, load_project, save_poses
from fieldwork.nerfcore.render.verb import look_at
from fieldwork.tests.nerfcore.test_kept import MOTION, moved_worker
from PIL import Image

WIDTH, HEIGHT, FOCAL = 320, 240, 330.0
VIEWS, CLOTH = 12, 4
CLOTH_PIXELS = np.s_[95:145, 233:273]  # beside the ball


def ball_before_dark(folder: Path) -> Path:
    """A data set: a speckled ball of radius 0.6 before black, from all sides; one photo shows a cloth in the light as well."""
    (folder / "images").mkdir(parents=True)
    rng, frames = np.random.default_rng(0), []
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, np.ones_like(x)], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    for i in range(VIEWS):
        angle = 2 * math.pi * i / VIEWS
        center = np.array([3 * math.cos(angle), 3 * math.sin(angle), 1.0 if i % 2 else -0.5])
        pose = look_at(center, np.zeros(3))
        along = -(rays @ pose[:3, :3].T) @ center
        ball = center @ center - along**2 < 0.36
        noise = scipy.ndimage.gaussian_filter(rng.uniform(-1, 1, x.shape), 1.5) * 80
        shown = np.where(ball, 170 + noise, 6 + rng.normal(size=x.shape))
        if i == CLOTH:
            shown[CLOTH_PIXELS] = 90
        pixels = np.repeat(np.clip(shown, 0, 255).astype(np.uint8)[..., None], 3, 2)
        Image.fromarray(pixels).save(folder / "images" / f"{i:02}.png")
        matrix = pose @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL axes
        frames.append({"file_path": f"images/{i:02}.png", "transform_matrix": matrix.tolist()})
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return folder


@pytest.fixture
def project(tmp_path: Path) -> Path:
    import_dataset(ImportParams(dataset=ball_before_dark(tmp_path / "d"), project=tmp_path / "p"), Reporter())
    return tmp_path / "p"


def masks(project: Path) -> list[np.ndarray]:
    return [read_image(project / f"masks/{i:02}.png")[..., 0] for i in range(VIEWS)]


def made(project: Path) -> list[np.ndarray]:
    """The masks of the photos, each by itself."""
    return [object_mask(read_picture(project / record.file).pixels) for record in load_project(project).images]


def put(mask: np.ndarray, path: Path) -> None:
    Image.fromarray(mask).save(path)


def test_what_one_photo_shows_beside_the_object_is_left_open(project: Path) -> None:
    assert (made(project)[CLOTH][CLOTH_PIXELS] == 255).mean() > 0.8
    for i, (mask, alone) in enumerate(zip(masks(project), made(project))):
        if i != CLOTH:
            assert np.array_equal(mask, alone)
            continue
        beside = np.zeros(mask.shape, bool)
        beside[CLOTH_PIXELS] = True
        assert (mask[beside & (alone == 255)] == MASK_UNKNOWN).mean() > 0.7  # the rest is near the hull
        away = ~scipy.ndimage.binary_dilation(beside, iterations=6)
        assert np.array_equal(mask[away], alone[away])
    assert trim_masks(project, Reporter()) == 0  # and again


def test_masks_that_were_edited_stay_as_they_are(project: Path) -> None:
    edited = made(project)[CLOTH]
    edited[10:14, 10:14] = 255
    put(edited, project / f"masks/{CLOTH:02}.png")
    assert trim_masks(project, Reporter()) == 0
    assert np.array_equal(masks(project)[CLOTH], edited)


def test_a_photo_with_a_wrong_pose_keeps_its_mask(project: Path) -> None:
    poses = load_poses(project)
    wrong = next(image for image in poses.images if image.name == "07")
    pose = np.array(wrong.camera_to_world)
    pose[:3, :3] = pose[:3, :3] @ look_at(np.zeros(3), np.array([0.3, 0.0, 1.0]), np.array([0.0, -1.0, 0.0]))[:3, :3]
    images = [i.model_copy(update={"camera_to_world": pose.tolist()}) if i is wrong else i for i in poses.images]
    save_poses(project, poses.model_copy(update={"images": images}), Points.empty())
    before = masks(project)
    trim_masks(project, Reporter())
    assert np.array_equal(masks(project)[7], before[7])


def test_without_a_hull_masks_stay(project: Path) -> None:
    put(made(project)[CLOTH], project / f"masks/{CLOTH:02}.png")
    poses, back = load_poses(project), np.diag([-1.0, 1.0, -1.0, 1.0])  # all look away from the ball
    images = [
        i.model_copy(update={"camera_to_world": (np.array(i.camera_to_world) @ back).tolist()}) for i in poses.images
    ]
    save_poses(project, poses.model_copy(update={"images": images}), Points.empty())
    assert trim_masks(project, Reporter()) == 0


def test_poses_trim_masks_and_are_not_estimated_again_for_it(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trimmed = masks(project)
    put(made(project)[CLOTH], project / f"masks/{CLOTH:02}.png")
    monkeypatch.setattr(estimate, "run_worker", moved_worker(project, MOTION, VIEWS))
    params = PosesParams(project=project)
    estimate.estimate_poses(params, Reporter())
    left, again = (m[CLOTH] == MASK_UNKNOWN for m in (trimmed, masks(project)))
    assert (left & again).sum() > 0.9 * (left | again).sum() > 0
    assert posed(params).result is not None
    assert estimate._forget_changed(project, load_project(project).images)
