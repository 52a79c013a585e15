"""Which cells may hold something, from cameras and sparse points."""

import math
from pathlib import Path

import numpy as np
import torch
from fieldwork.nerfcore.config import SamplingConfig, SceneConfig
from fieldwork.nerfcore.data.box import choose_box
from fieldwork.nerfcore.data.scene import Scene, View
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.geometry.points import Points
from fieldwork.nerfcore.sampling.known_space import KnownSpace, known_space
from fieldwork.nerfcore.sampling.path import cells_before_path
from fieldwork.nerfcore.sampling.visibility import cells_at, depth_ranges, grid_centers

OFF = {"close_near_cameras": False, "close_single_views": False, "close_between_cameras": False}
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


def space_of(
    poses: torch.Tensor,
    points: torch.Tensor,
    resolution: int,
    contracted: bool,
    focus: torch.Tensor | None = None,
    **rules: bool,
) -> KnownSpace:
    config = SamplingConfig.model_validate(rules)
    return known_space([CAMERA] * len(poses), poses, points, focus, resolution, contracted, config)


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
    free, bounded = (space_of(poses, points, 32, False, **rules).views > 0 for rules in (OFF, {}))
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
    counts = space_of(poses, points, 64, True).views
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


def ring(count: int, radius: float) -> torch.Tensor:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    poses = [looking_at_origin([radius * np.cos(a), radius * np.sin(a), 0.3]) for a in angles]
    return torch.from_numpy(np.stack(poses)).float()


def free_cells(poses: torch.Tensor, points: torch.Tensor, contracted: bool) -> torch.Tensor:
    return cells_before_path([CAMERA] * len(poses), poses, torch.zeros(3), points, 64, contracted)


def test_nothing_hangs_where_the_photos_were_taken_from():
    """Also between the cameras, where no photo looks, and behind them; what they surround stays."""
    poses, cells = ring(18, 0.8), grid_centers(64, False, torch.device("cpu"))
    empty = free_cells(poses, torch.zeros(0, 3), False)
    circle = torch.stack([torch.tensor([0.8 * math.cos(a), 0.8 * math.sin(a), 0.3]) for a in np.linspace(0, 6.28, 90)])
    assert empty[cells_at(circle, 64, False)].all()
    distance = torch.hypot(cells[:, :2].norm(dim=1) - 0.8, cells[:, 2] - 0.3)
    free = 0.125 * math.hypot(0.8, 0.3)
    behind = cells[:, :2].norm(dim=1) > 0.8
    # The way's straight pieces, to cameras as far as 40° on, leave the circle by up to 0.05.
    assert empty[distance < free - 0.03].all()
    assert not empty[behind & (distance > free + 0.06)].any()
    assert not empty[cells.norm(dim=1) < 0.6].any()


def test_few_cameras_have_a_way_between_them_too():
    poses = ring(7, 0.8)  # 51° apart
    halves = (poses[:, :3, 3] + poses.roll(1, 0)[:, :3, 3]) / 2
    assert free_cells(poses, torch.zeros(0, 3), False)[cells_at(halves, 64, False)].all()


def test_cameras_far_apart_or_looking_elsewhere_have_no_way_between_them():
    middle = torch.tensor([[0.0, 0.0, 0.3]])  # of the ring
    for count in (2, 4):
        poses = ring(count, 0.8)
        empty = free_cells(poses, torch.zeros(0, 3), False)
        assert empty[cells_at(poses[:, :3, 3], 64, False)].sum() == 0
        assert not empty[cells_at(middle, 64, False)].any()


def test_sparse_points_beside_the_way_are_kept():
    poses, post = ring(18, 0.8), torch.tensor([0.8, 0.0, 0.37]) + torch.linspace(-0.003, 0.003, 40)[:, None]
    without = free_cells(poses, torch.zeros(0, 3), False)
    kept = free_cells(poses, torch.cat([torch.from_numpy(ball(500, 0.3)).float(), post]), False)
    there = cells_at(post, 64, False)
    assert without[there].all()
    assert not kept[there].any()
    assert kept[cells_at(poses[9:10, :3, 3], 64, False)].all()  # the other side is as free as before


def test_what_stands_on_the_way_itself_is_kept():
    poses = ring(18, 0.8)
    middle = (poses[0, :3, 3] + poses[1, :3, 3]) / 2
    post = middle + torch.linspace(-0.003, 0.003, 40)[:, None]
    kept = free_cells(poses[:2], torch.cat([torch.from_numpy(ball(500, 0.3)).float(), post]), False)
    assert free_cells(poses[:2], torch.zeros(0, 3), False)[cells_at(post, 64, False)].all()
    assert not kept[cells_at(post, 64, False)].any()


def test_large_cells_on_the_way_around_something_small_are_empty():
    poses = ring(18, 6.0)
    empty = free_cells(poses, torch.zeros(0, 3), True)
    assert empty[cells_at((poses[:-1, :3, 3] + poses[1:, :3, 3]) / 2, 64, True)].all()
    assert not empty[cells_at(torch.from_numpy(ball(2000, 0.9)).float(), 64, True)].any()
