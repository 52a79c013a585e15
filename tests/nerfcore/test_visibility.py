"""Which cells may hold something, from cameras and sparse points."""

import math
from pathlib import Path

import numpy as np
import torch
from fieldwork.nerfcore.config import SceneConfig
from fieldwork.nerfcore.data.box import choose_box
from fieldwork.nerfcore.data.cameras import Camera
from fieldwork.nerfcore.data.scene import Points, Scene, View
from fieldwork.nerfcore.sampling.visibility import cells_at, depth_ranges, grid_centers, view_counts

CAMERA = Camera(model="PINHOLE", width=100, height=80, fx=80.0, fy=80.0, cx=50.0, cy=40.0)


def looking_at_origin(position) -> np.ndarray:
    forward = -np.asarray(position, float) / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = position
    return pose


def half_ring(count: int, radius: float) -> np.ndarray:
    angles = np.linspace(0, np.pi / 2, count)
    return np.stack([looking_at_origin([radius * np.cos(a), radius * np.sin(a), 0.3 * radius]) for a in angles])


def ball(count: int, radius: float) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * radius


def test_depth_ranges_are_a_margin_before_the_points_in_view_and_their_median():
    poses = torch.from_numpy(half_ring(3, 0.9)).float()
    points = torch.from_numpy(ball(2000, 0.2)).float()
    distance = float(poses[0, :3, 3].norm())
    ranges = depth_ranges([CAMERA] * 3, poses, points)
    assert torch.allclose(ranges[:, 0], torch.full((3,), distance - 0.4), atol=0.03)
    assert torch.allclose(ranges[:, 1], torch.full((3,), distance), atol=0.02)


def test_cameras_with_too_few_points_have_no_depth_range():
    poses = torch.from_numpy(half_ring(2, 0.9)).float()
    assert not depth_ranges([CAMERA] * 2, poses, torch.zeros(5, 3)).any()


def test_nothing_may_hang_right_in_front_of_a_camera():
    poses = torch.from_numpy(half_ring(5, 0.9)).float()
    points = torch.from_numpy(ball(2000, 0.2)).float()
    ranges = depth_ranges([CAMERA] * 5, poses, points)
    centers = grid_centers(32, False, poses.device)
    free, bounded = (view_counts([CAMERA] * 5, poses, 32, False, r) > 0 for r in (None, ranges))
    close = torch.stack([(centers - pose[:3, 3]) @ pose[:3, 2] for pose in poses])
    sideways = torch.stack([((centers - pose[:3, 3]) @ pose[:3, :2]).abs().amax(1) for pose in poses])
    in_front = ((close > 0.05) & (close < ranges[:, :1] * 0.9) & (sideways < close * 0.4)).any(0)
    assert in_front.any()
    assert free[in_front].all()
    assert not bounded[in_front].any()
    surface = centers.norm(dim=1) < 0.25
    assert bounded[surface].all()


def scene(poses: np.ndarray, points: np.ndarray) -> Scene:
    views = [View(f"{i}", CAMERA, pose, Path(f"{i}.png")) for i, pose in enumerate(poses)]
    cloud = Points(points, np.zeros((len(points), 3), np.uint8), np.zeros(len(points)))
    indices = list(range(len(views)))
    return Scene(views=views, train=indices, test=[], points=cloud)


def test_the_cube_shrinks_to_the_points_where_cameras_stand_far_off():
    poses = half_ring(7, 3.0)
    far = choose_box(scene(poses, ball(500, 0.4)), SceneConfig(), False)
    near = choose_box(scene(poses, ball(500, 2.9)), SceneConfig(), False)
    assert far.contracted
    assert near.contracted
    assert 0.4 < far.world_from_box[0, 0] < 0.65
    assert near.world_from_box[0, 0] > 2.5


def test_the_large_cells_around_far_cameras_are_empty():
    poses = torch.from_numpy(half_ring(9, 6.0)).float()
    points = torch.from_numpy(ball(2000, 0.7)).float()
    counts = view_counts([CAMERA] * 9, poses, 64, True, depth_ranges([CAMERA] * 9, poses, points))
    near = poses[:, :3, 3] + 0.02 * poses[:, :3, 2]
    assert not counts[cells_at(near, 64, True)].any()
    assert (counts[cells_at(points, 64, True)] > 0).all()


def test_without_points_cameras_around_something_show_what_fills_their_photos():
    poses = torch.from_numpy(half_ring(5, 2.0)).float()
    ranges = depth_ranges([CAMERA] * 5, poses, torch.zeros(0, 3), torch.zeros(3))
    distance = float(poses[0, :3, 3].norm())
    assert torch.allclose(ranges[:, 1], torch.full((5,), distance), atol=1e-4)
    touching = math.atan(2 * 100 / 80 / 2)  # of the ray that touches the ball, at twice the half of the photo
    assert torch.allclose(ranges[:, 0], torch.full((5,), distance * (1 - math.sin(touching))), atol=1e-4)
    box = choose_box(scene(half_ring(5, 2.0), np.zeros((0, 3))), SceneConfig(), False)
    assert box.contracted
    assert box.world_from_box[0, 0] < 2.0
