"""What a mesh has of what photos show: a ball before a dark room, with and without parts missing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from fieldwork.nerfcore.data.box import Box
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.data.scene import Scene
from fieldwork.nerfcore.geometry.cameras import pixel_centers, rays
from fieldwork.nerfcore.kernels.raycast import FirstHits
from fieldwork.nerfcore.mesh import coverage as module
from fieldwork.nerfcore.mesh.build import Built
from fieldwork.nerfcore.mesh.coverage import Coverage, coverage, shown_by
from fieldwork.nerfcore.mesh.depth_maps import DepthMap, FlatView
from fieldwork.nerfcore.mesh.painted import training_photos
from fieldwork.nerfcore.mesh.region import Region
from fieldwork.nerfcore.mesh.surface import Surface
from fieldwork.nerfcore.mesh.verb import judge
from fieldwork.nerfcore.params import MeshParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.verdict import mesh_verdict
from fieldwork.tests.nerfcore.support.ball import RADIUS, ball_project
from PIL import Image

ROOM = 2.4  # distance of the room's walls from every camera, at a depth that is near: 2.5 times the ball's is 3.3


def ball_depth(_model: object, flat: FlatView, _check: object) -> DepthMap:
    """What the field says: a ball of half the size of the world's unit, with the room's walls behind it."""
    local = rays(flat.camera, pixel_centers(flat.camera.width, flat.camera.height).reshape(-1, 2))[0]
    d, o = local @ flat.pose[:3, :3].T, flat.pose[:3, 3]
    b = d @ o
    root = b * b - (o @ o - RADIUS**2)
    away = np.where(root > 0, -b - np.sqrt(np.maximum(root, 0)), ROOM)
    depth = (away * local[:, 2]).reshape(flat.inside.shape).astype(np.float32)
    return DepthMap(depth, depth, depth)


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Scene]:
    """Photos of the ball before black, with the noise of a sensor."""
    folder, random = ball_project(tmp_path / "ball", views=6, side=96), np.random.default_rng(0)
    for path in (folder / "images").iterdir():
        with Image.open(path) as image:
            rgba = np.array(image).astype(int)
        rgb = rgba[..., :3] * (rgba[..., 3:] > 0) + random.normal(scale=1.5, size=rgba[..., :3].shape)
        Image.fromarray(rgb.clip(0, 255).astype(np.uint8)).save(path)
    monkeypatch.setattr(module, "render_depth", ball_depth)
    return folder, load_scene(folder, 0)


def found(
    scene: Scene, keep: np.ndarray | None = None, bounds: tuple[np.ndarray, np.ndarray] | None = None
) -> Coverage:
    ball = trimesh.creation.icosphere(5, RADIUS)
    faces = np.asarray(ball.faces) if keep is None else np.asarray(ball.faces)[keep]
    return coverage(None, scene, np.eye(4), np.asarray(ball.vertices), faces, bounds, lambda: None)  # pyright: ignore


def middles() -> np.ndarray:
    return np.asarray(trimesh.creation.icosphere(5, RADIUS).triangles_center)


def level(shares: Coverage) -> str:
    return mesh_verdict(0.3, shares.solid, shares.holes)["level"]


def test_an_object_before_a_dark_room_is_all_there(room: tuple[Path, Scene]) -> None:
    whole = found(room[1])
    assert whole.solid is not None
    assert whole.solid > 0.95
    assert whole.holes == 0
    assert level(whole) == "good"


def test_half_an_object_and_one_with_holes_are_told(room: tuple[Path, Scene]) -> None:
    half = found(room[1], middles()[:, 2] > 0)
    assert half.solid is not None
    assert 0.2 < half.solid < 0.8
    assert level(half) != "good"
    towards = np.array([1.0, 0.2, 0.1]) / np.linalg.norm([1.0, 0.2, 0.1])
    with_hole = found(room[1], middles() @ towards < 0.8 * RADIUS)
    assert with_hole.holes > 0.02
    assert level(with_hole) == "weak"
    assert "holes" in mesh_verdict(0.3, 1.0, with_hole.holes)["reasons"][0]
    # What was not asked for is not missing.
    region = np.array([-1.0, -1, 0]), np.ones(3)
    asked = found(room[1], middles()[:, 2] > 0, region)
    assert asked.solid is not None
    assert asked.solid > 0.95


def test_a_room_that_can_be_seen_is_missing(room: tuple[Path, Scene]) -> None:
    folder, _ = room
    stripes = (128 + 60 * np.sin(np.arange(96) * 0.8)).astype(int)
    for path in (folder / "images").iterdir():
        with Image.open(path) as image:
            rgb = np.array(image).astype(int)
        beside = rgb.max(2, keepdims=True) < 12
        rgb = np.where(beside, np.broadcast_to(stripes[None, :, None], rgb.shape), rgb)
        Image.fromarray(rgb.astype(np.uint8)).save(path)
    seen = found(load_scene(folder, 0))
    assert seen.solid is not None
    assert seen.solid < 0.7
    assert level(seen) != "good"


def test_places_are_shown_by_the_photos_that_see_them(room: tuple[Path, Scene]) -> None:
    """A place p of a ball about the origin is seen from c where p · c > r²."""
    views = room[1].views
    poses, ball = np.stack([view.camera_to_world for view in views]), trimesh.creation.icosphere(5, RADIUS)
    places = RADIUS * np.asarray(trimesh.creation.icosphere(3, 1.0).vertices)
    above = places @ poses[:, :3, 3].T / RADIUS**2 - 1
    clear = (np.abs(above) > 0.5).all(1)  # what is hidden by less than three hundredths counts as seen
    count = shown_by(places, views, poses, FirstHits(np.asarray(ball.vertices), np.asarray(ball.faces)), lambda: None)
    assert clear.sum() > 100
    assert (count[clear] == (above > 0).sum(1)[clear]).all()
    assert len(np.unique(count[clear])) > 1
    assert (shown_by(places, views, poses, FirstHits(np.zeros((0, 3)), np.zeros((0, 3), int)), lambda: None) == 6).all()


def test_photos_that_show_none_of_the_places_count_for_nothing(room: tuple[Path, Scene]) -> None:
    _, scene = room
    views = scene.views[:1]
    pose = views[0].camera_to_world
    behind = pose[:3, 3] - pose[:3, 2] * np.array([[1.0], [2.0]])
    ball = trimesh.creation.icosphere(2)
    hits = FirstHits(np.asarray(ball.vertices), np.asarray(ball.faces))
    assert (shown_by(behind, views, pose[None], hits, lambda: None) == 0).all()


def test_what_fewer_than_three_photos_show_is_told_apart(room: tuple[Path, Scene]) -> None:
    """The first photo is held out; of the others three are trained on, and what each of them sees is on the mesh."""
    views = room[1].views
    scene = replace(room[1], test=[0], train=[1, 2, 3])
    toward = np.stack([view.camera_to_world[:3, 3] for view in views[1:4]])
    seen_by = (middles() @ toward.T > RADIUS**2).sum(1)
    by_one, by_two = found(scene, seen_by >= 1), found(scene, seen_by >= 2)
    assert by_one.solid is not None
    assert by_two.solid is not None
    assert by_two.solid < by_one.solid
    assert by_two.few > 0.2
    told = mesh_verdict(0.3, 0.7, 0.0, 1.0, 0.95, 0.25)
    assert told["level"] == "weak"
    assert told["reasons"][0].startswith(
        "Of what the photos show near, 30% is missing in the mesh, and 25% is in fewer"
    )
    assert "Train longer" in mesh_verdict(0.3, 0.7, 0.0, 1.0, 0.8, 0.1)["reasons"][0]
    both = mesh_verdict(0.3, 0.7, 0.0, 1.0, 0.8, 0.25)["reasons"][0]
    assert "25% is in fewer than three photos" in both
    assert "train longer" in both


def test_what_lies_beside_a_small_region_is_not_missing(room: tuple[Path, Scene]) -> None:
    """A cap of the ball, in 1 % of the pixels, of which nothing is missing: good where it was asked for, and else a scrap."""
    folder, scene = room
    ball = trimesh.creation.icosphere(5, RADIUS)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)[middles()[:, 2] > 0.45]
    colors, ids = np.zeros((len(vertices), 3), np.uint8), np.zeros(len(vertices), int)
    region = Region(vertices.min(0), vertices.max(0), 0.01)
    built = Built(vertices, faces, vertices, colors, region, (vertices, faces))
    surface = Surface(vertices, faces, vertices, colors, ids, ids[: len(faces)])
    box, photos = Box(np.eye(4), False), training_photos(scene, np.eye(4))
    trained = SimpleNamespace(model=None, info=SimpleNamespace(images=[view.name for view in scene.views]))
    told = {}
    for asked in ("-1,-1,0.45,1,1,1", "photos"):
        params = MeshParams(project=folder, region=asked)
        told[asked] = judge(trained, scene, box, built, surface, photos, params, Reporter())  # pyright: ignore
    cap, whole = told.values()
    assert cap["shown"] == whole["shown"] < 0.02
    assert cap["solid_shown"] > 0.9
    assert (cap["verdict"]["level"], whole["verdict"]["level"]) == ("good", "failed")


def test_a_guess_is_offered_for_what_is_missing_and_told_where_it_is_much() -> None:
    for missing in ((0.3, 0.7), (0.3, 1.0, 0.1)):
        assert "close gaps" not in mesh_verdict(*missing)["reasons"][0]
        assert "close gaps" in mesh_verdict(*missing, guessed=None)["reasons"][0]
    assert mesh_verdict(0.3, 1.0, guessed=None)["level"] == mesh_verdict(0.3, 1.0, guessed=0.09)["level"] == "good"
    much = mesh_verdict(0.3, 1.0, guessed=0.31)
    assert much["level"] == "weak"
    assert "31%" in much["reasons"][0]


def test_scraps_are_told_whatever_they_cover() -> None:
    assert mesh_verdict(0.5, 0.97, 0.0, 0.3)["level"] == "weak"
    assert "pieces" in mesh_verdict(0.5, 0.97, 0.0, 0.3)["reasons"][0]
    assert mesh_verdict(0.05, 0.97)["level"] == "good"  # a small thing in large photos
    assert mesh_verdict(0.05, None)["level"] == "weak"
    assert mesh_verdict(0.45, 0.45)["level"] == "failed"
