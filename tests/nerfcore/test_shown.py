"""Whether the silhouettes of a mesh are those that masks cut out of photos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from fieldwork.nerfcore.data.scene import Scene, View
from fieldwork.nerfcore.geometry.cameras import Camera, pixel_centers, rays
from fieldwork.nerfcore.images.working import MASK_UNKNOWN
from fieldwork.nerfcore.mesh.shown import silhouette
from fieldwork.tests.nerfcore.support.depth_views import orbit
from PIL import Image

CAMERA = Camera(width=120, height=120, fx=150.0, fy=150.0, cx=60.0, cy=60.0)
RADIUS = 0.4


def nothing() -> None:
    pass


def ball_views(folder: Path, masks: bool) -> list[View]:
    """Photos of a ball, cut out by masks or by their transparency."""
    views = []
    local, _ = rays(CAMERA, pixel_centers(120, 120).reshape(-1, 2))
    for number, pose in enumerate(orbit(6, 2.0)):
        along = local @ pose[:3, :3].T
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        near = -(along @ pose[:3, 3])[:, None] * along + pose[:3, 3]
        ball = (np.linalg.norm(near, axis=1) < RADIUS).reshape(120, 120)
        photo, mask = folder / f"{number}.png", folder / f"{number}_mask.png"
        grey = np.full((120, 120, 3), 128, np.uint8)
        alpha = (ball * 255).astype(np.uint8)[..., None]
        Image.fromarray(grey if masks else np.concatenate([grey, alpha], 2)).save(photo)
        Image.fromarray(alpha[..., 0]).save(mask)
        views.append(View(str(number), CAMERA, pose, photo, mask=mask if masks else None))
    return views


@pytest.mark.parametrize("masks", [True, False])
def test_a_silhouette_is_held_against_what_is_cut_out(tmp_path: Path, masks: bool) -> None:
    views = ball_views(tmp_path, masks)
    scene = Scene(views, [0, 1, 2, 3], [4, 5], mask_mode="empty")
    ball = trimesh.creation.icosphere(4, RADIUS)
    faces = np.asarray(ball.faces)
    assert silhouette(scene, ball.vertices, faces, nothing) > 0.97
    assert silhouette(scene, ball.vertices * 1.2, faces, nothing) == pytest.approx(1 / 1.2**2, abs=0.03)
    assert silhouette(scene, ball.vertices + 5, faces, nothing) == 0


def test_a_silhouette_is_held_against_photos_from_all_sides(tmp_path: Path) -> None:
    views = ball_views(tmp_path, True)
    assert views[1].mask is not None
    Image.fromarray(np.zeros((120, 120), np.uint8)).save(views[1].mask)
    scene = Scene(views, [], [0] * 20 + [1] * 20, mask_mode="empty")  # the first half of an orbit, and the second one
    ball = trimesh.creation.icosphere(4, RADIUS)
    assert silhouette(scene, ball.vertices, np.asarray(ball.faces), nothing) == pytest.approx(0.5, abs=0.03)


def test_photos_that_cut_nothing_out_say_nothing(tmp_path: Path) -> None:
    views = ball_views(tmp_path, True)
    ball = trimesh.creation.icosphere(2, RADIUS)
    scene = Scene(views, [0, 1, 2, 3], [4, 5], mask_mode="ignore")  # black is what one must not look at
    assert silhouette(scene, ball.vertices, np.asarray(ball.faces), nothing) is None


def test_a_silhouette_is_not_held_against_what_nobody_knows(tmp_path: Path) -> None:
    """Grey in a mask that Fieldwork made: a ball whose right half may be an opening is neither right nor wrong there."""
    views = ball_views(tmp_path, True)
    for view in views:
        assert view.mask is not None
        mask = np.asarray(Image.open(view.mask)).copy()
        mask[:, 60:][mask[:, 60:] > 0] = MASK_UNKNOWN
        Image.fromarray(mask).save(view.mask)
    scene = Scene(views, [0, 1, 2, 3], [4, 5], mask_mode="empty")
    ball = trimesh.creation.icosphere(4, RADIUS)
    whole = silhouette(scene, ball.vertices, np.asarray(ball.faces), nothing)
    assert whole is not None
    assert whole > 0.97


def test_of_a_region_only_what_photos_show_of_it_counts(tmp_path: Path) -> None:
    """A ball of which the photos show a second one beside it, which is not in the region."""
    views = ball_views(tmp_path, True)
    for view in views:
        assert view.mask is not None
        mask = np.asarray(Image.open(view.mask)).copy()
        Image.fromarray(np.maximum(mask, np.roll(mask, 60, 1))).save(view.mask)
    scene = Scene(views, [0, 1, 2, 3], [4, 5], mask_mode="empty")
    ball, box = trimesh.creation.icosphere(4, RADIUS), np.full(3, RADIUS * 1.05)
    faces = np.asarray(ball.faces)
    whole, there = (silhouette(scene, ball.vertices, faces, nothing, where) for where in (None, (-box, box)))
    assert whole is not None
    assert there is not None
    assert whole < 0.6
    assert there > 0.75  # the box around a ball shows a little of the other one
    top = faces[ball.triangles_center[:, 2] > 0]
    cut = trimesh.Trimesh(ball.vertices, top)  # without what no triangle has
    assert silhouette(scene, cut.vertices, np.asarray(cut.faces), nothing, (np.array([-1.0, -1, 0]), box)) is None
