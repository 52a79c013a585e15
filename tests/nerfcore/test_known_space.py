"""What photos show of space: unknown cells stay unknown, and rules close nothing that is there."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from fieldwork.nerfcore.config import SamplingConfig
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.kernels.cells_torch import cell_index
from fieldwork.nerfcore.params import RenderParams, TrainParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.schema import Poses
from fieldwork.nerfcore.render.image import render_view
from fieldwork.nerfcore.render.run import load_trained
from fieldwork.nerfcore.render.verb import look_at
from fieldwork.nerfcore.sampling.known_space import BETWEEN, NEAR, SINGLE, KnownSpace, known_space
from fieldwork.nerfcore.sampling.occupancy import OccupancyGrid
from fieldwork.nerfcore.sampling.space import EMPTY, OCCUPIED, UNKNOWN, cell_states, state_at, unknown_share
from fieldwork.nerfcore.sampling.visibility import cells_at
from fieldwork.nerfcore.train.closed_picture import COLORS, write_closed_picture
from fieldwork.nerfcore.verbs import run_verb
from fieldwork.tests.nerfcore.support.ball import SMALL, ball_project
from fieldwork.tests.nerfcore.support.settings import trainer_of
from matplotlib.colors import to_rgb
from scipy.ndimage import find_objects, label

CAMERA = Camera(model="PINHOLE", width=100, height=80, fx=80.0, fy=80.0, cx=50.0, cy=40.0)
SIDE, RING, HEIGHT = 64, 0.8, 0.3
THIN = 0.03  # half of a post's width


def ring(count: int = 18) -> torch.Tensor:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    poses = [look_at(np.array([RING * np.cos(a), RING * np.sin(a), HEIGHT]), np.zeros(3)) for a in angles]
    return torch.from_numpy(np.stack(poses)).float()


def on_ball(count: int, radius: float = 0.3) -> torch.Tensor:
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return points / points.norm(dim=1, keepdim=True) * radius


def post(radius: float, count: int) -> torch.Tensor:
    """Points in a thin upright post between the first two of 18 cameras, `radius` away from the ring's axis."""
    angle, generator = np.pi / 18, torch.Generator().manual_seed(1)
    middle = torch.tensor([radius * np.cos(angle), radius * np.sin(angle), HEIGHT - 0.05]).float()
    return middle + (torch.rand(count, 3, generator=generator) * 2 - 1) * torch.tensor([THIN, THIN, 0.1])


def space(points: torch.Tensor, contracted: bool = False, **rules: bool) -> KnownSpace:
    poses = ring()
    cameras, config = [CAMERA] * len(poses), SamplingConfig.model_validate(rules)
    return known_space(cameras, poses, points, torch.zeros(3), SIDE, contracted, config)


@pytest.mark.parametrize("contracted", [False, True], ids=["box", "contracted"])
@pytest.mark.parametrize("count", [60, 400], ids=["few points", "many points"])
@pytest.mark.parametrize("radius", [0.62, 0.7, 0.78, 0.86])
def test_what_stands_between_neighbouring_cameras_is_not_closed(radius: float, count: int, contracted: bool) -> None:
    """A post on the way between two cameras, before or behind it; sparse points show it and a ball in the middle.
    With few points on it, it is lost among those of the ball."""
    there = cells_at(post(radius, 4000), SIDE, contracted)
    points = torch.cat([on_ball(6000), post(radius, count)])
    found = space(points, contracted)
    closed = torch.stack(list(found.closed.values())).any(0)
    assert not closed[cells_at(post(radius, count), SIDE, contracted)].any()
    assert float(closed[there].float().mean()) == 0
    # The rules do their work elsewhere.
    across = cells_at(ring()[9:11, :3, 3].mean(0, keepdim=True), SIDE, contracted)
    assert bool(found.closed[BETWEEN][across].all())


def test_a_wrong_point_in_front_of_a_camera_keeps_nothing_open() -> None:
    pose = ring()[9]
    wrong = (pose[:3, 3] + 0.1 * pose[:3, 2])[None]
    assert space(torch.cat([on_ball(2000), wrong])).closed[NEAR][cells_at(wrong, SIDE, False)].all()


@pytest.mark.setting("sampling.close_near_cameras", "sampling.close_single_views", "sampling.close_between_cameras")
def test_each_rule_has_a_switch() -> None:
    points, names = on_ball(2000), {NEAR: "near_cameras", SINGLE: "single_views", BETWEEN: "between_cameras"}
    every = space(points)
    for rule, name in names.items():
        without = space(points, **{f"close_{name}": False})
        assert not without.closed[rule].any()
        for other in set(names) - {rule}:
            assert torch.equal(without.closed[other], every.closed[other])
    assert every.closed[NEAR].any()
    assert every.closed[BETWEEN].any()
    nothing = space(points, **{f"close_{name}": False for name in names.values()})
    assert nothing.empty_distance == 0 < every.empty_distance
    assert torch.equal(nothing.views > 0, ~nothing.unknown)
    assert float((nothing.views > 0).sum()) > float((every.views > 0).sum())
    # Two cameras side by side: what only one of them sees, nearer than the ball, is closed.
    poses = ring()[:2]
    single = [
        known_space([CAMERA] * 2, poses, points, None, SIDE, False, SamplingConfig(close_single_views=on))
        for on in (True, False)
    ]
    assert single[0].closed[SINGLE].any()
    assert not single[1].closed[SINGLE].any()


def test_cells_are_unknown_closed_or_shown() -> None:
    poses = ring()[:3]
    found = known_space([CAMERA] * 3, poses, on_ball(2000), None, SIDE, False, SamplingConfig())
    closed = torch.stack(list(found.closed.values())).any(0)
    states = torch.stack([found.unknown, closed, found.views > 0]).sum(0)
    assert bool((states == 1).all())
    behind = poses[:, :3, 3] - 0.15 * poses[:, :3, 2]
    assert found.unknown[cells_at(behind, SIDE, False)].all()
    assert not found.unknown[cells_at(on_ball(500), SIDE, False)].any()


def test_unknown_cells_never_become_occupied_and_are_told_from_empty_ones() -> None:
    n = 8
    unknown = torch.zeros(n**3, dtype=torch.bool)
    unknown[: n**3 // 2] = True  # z < ½
    grid = OccupancyGrid(SamplingConfig(resolution=n, warmup=0, decay=0.1), False, ~unknown, unknown)
    generator = torch.Generator().manual_seed(2)
    for step in range(160):
        grid.update(step, lambda p: torch.where(p[:, 0] > 0.5, 50.0, 0.0), None, generator)
    points = torch.tensor([[0.9, 0.5, 0.2], [0.9, 0.5, 0.8], [0.1, 0.5, 0.8], [0.1, 0.5, 1.2]])
    assert state_at(grid.states(), points).tolist() == [UNKNOWN, OCCUPIED, EMPTY, UNKNOWN]
    assert not grid.cells[unknown, 0].any()  # beside occupied ones neither


def test_a_cell_that_is_unknown_and_occupied_counts_as_unknown() -> None:
    unknown, occupied = torch.tensor([True, True, False, False]), torch.tensor([True, False, True, False])
    assert cell_states(unknown, occupied).tolist() == [UNKNOWN, UNKNOWN, OCCUPIED, EMPTY]


def test_a_ray_that_misses_the_grid_is_unknown_as_a_whole() -> None:
    nowhere = torch.zeros(8**3, dtype=torch.bool)
    origins, directions = torch.tensor([[-2.0, 2.5, 0.0], [-2.0, 0.0, 0.0]]), torch.tensor([[1.0, 0, 0], [1, 0, 0]])
    distance = torch.full((2,), torch.nan)
    found = unknown_share(cell_states(nowhere, nowhere), False, origins, directions, distance)
    assert found.tolist() == [1.0, 0.0]


@pytest.mark.parametrize("contracted", [False, True], ids=["box", "contracted"])
def test_the_unknown_share_of_a_ray_is_its_way_through_unknown_cells(contracted: bool) -> None:
    n = 32
    unknown = torch.arange(n**3) % n >= n // 2  # the half x > 0
    states = cell_states(unknown, torch.zeros_like(unknown))
    origins = torch.tensor([[-1.0, 0.01, 0.01], [0.5, 0.01, 0.01], [-1.0, 0.01, 0.01], [-0.5, 0.01, 0.01]])
    directions = torch.tensor([[1.0, 0, 0], [1, 0, 0], [1, 0, 0], [-1, 0, 0]])
    distance = torch.tensor([2.0, torch.nan, 0.9, torch.nan])
    found = unknown_share(states, contracted, origins, directions, distance)
    assert found.tolist() == pytest.approx([0.5, 1.0, 0.0, 0.0], abs=0.03)


@pytest.fixture(scope="module")
def one_side(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ball, with only those photos of a whole ring taken from x > ½."""
    project = ball_project(tmp_path_factory.mktemp("unknown") / "ball", views=24, side=32, points=400)
    path = project / "poses" / "poses.json"
    poses = Poses.model_validate_json(path.read_text())
    poses.images = [image for image in poses.images if image.camera_to_world[0][3] > 0.5]
    path.write_text(poses.model_dump_json())
    settings = {**SMALL, "scene.contraction": "on", "loss.semantic_weight": "0"}
    params = TrainParams.model_validate({"project": project, "preset": "draft", "steps": 60, "set": settings})
    result = run_verb("train", params, Reporter())
    (project / "result.json").write_text(json.dumps(result))
    return project


def test_a_ray_into_unknown_space_says_so(one_side: Path) -> None:
    trained = load_trained(one_side, "main")
    assert trained.model.occupancy.unknown.any()
    camera = Camera(width=16, height=16, fx=16, fy=16, cx=8, cy=8)
    away = np.eye(4)  # from where the photos were taken, away from the ball
    away[:3, :3] = np.stack([[0, 1, 0], [0, 0, -1], [-1, 0, 0]], 1) @ np.diag([1, 1, -1]) @ np.diag([-1, 1, 1])
    away[:3, 3] = [3.0, 0, 0]
    assert np.allclose(away[:3, 2], [1, 0, 0])
    frame = render_view(trained.model, camera, away, 0.0, unknown=True)
    assert frame.unknown is not None
    assert float(frame.unknown.min()) > 0.9
    assert float(frame.opacity.max()) == 0
    assert np.isnan(frame.depth).all()
    towards = render_view(trained.model, camera, look_at(np.array([1.6, 0, 0]), np.zeros(3)), 0.0, unknown=True)
    assert towards.unknown is not None
    assert float(towards.unknown[6:10, 6:10].max()) < 0.5
    assert render_view(trained.model, camera, away, 0.0).unknown is None


def test_the_pass_of_unknown_space_is_in_the_exr(one_side: Path, tmp_path: Path) -> None:
    params = {"project": one_side, "out": tmp_path, "orbit": 1, "size": (16, 16), "passes": ["rgb", "unknown"]}
    result = run_verb("render", RenderParams.model_validate(params), Reporter())
    image = oiio.ImageBuf(next(path for path in result["frames"] if path.endswith(".exr")))
    assert "Unknown.V" in image.spec().channelnames
    assert any(path.endswith("_unknown.png") for path in result["frames"])


@pytest.mark.parametrize("resolution", ["16", "48"])
def test_a_cell_is_shown_where_photos_show_a_part_of_it(one_side: Path, resolution: str) -> None:
    """Coarser grids than that of the photos' views close nothing that a photo shows."""
    trainer = trainer_of(one_side, **{"sampling.resolution": resolution, "scene.contraction": "on"})
    space, grid = trainer.space, trainer.model.occupancy
    assert space is not None
    axis = (torch.arange(space.resolution) + 0.5) / space.resolution
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    centers = torch.stack([x, y, z], -1).view(-1, 3)
    side = int(resolution)
    cell = cell_index(centers, side)
    assert grid.seen[cell[space.views > 0]].all()
    assert not grid.unknown[cell[~space.unknown]].any()
    assert 0 < int(grid.unknown.sum()) < side**3


def test_training_shows_what_the_rules_closed(one_side: Path) -> None:
    result = json.loads((one_side / "result.json").read_text())
    path = Path(result["closed_picture"])
    assert path == one_side / "runs" / "main" / "closed.png"
    picture = oiio.ImageBuf(str(path))
    assert picture.spec().width > 400
    colored = np.ptp(picture.get_pixels(oiio.FLOAT)[..., :3], axis=-1) > 0.2
    assert colored.mean() > 0.005


def test_the_picture_shows_each_rule_in_its_colour_where_it_closed(tmp_path: Path) -> None:
    """Each rule closes a quarter of the box along an axis of its own; drawn at 75 % over white."""
    side, nothing, nowhere = 8, torch.zeros(8**3, dtype=torch.bool), torch.zeros(0, 3)
    cell = torch.arange(side**3)
    place = {NEAR: cell % side, SINGLE: cell // side % side, BETWEEN: cell // side**2}  # x, y, z
    found = {}
    for color, rule in zip(COLORS, place):
        closed = {name: place[name] < side // 4 if name == rule else nothing for name in place}
        known = KnownSpace(side, False, torch.ones(side**3), nothing, closed, 0.0)
        assert write_closed_picture(tmp_path / "closed.png", known, nowhere, nowhere)
        pixels = oiio.ImageBuf(str(tmp_path / "closed.png")).get_pixels(oiio.FLOAT)[..., :3]
        parts, _ = label((np.abs(pixels - (0.75 * np.array(to_rgb(color)) + 0.25)) < 0.02).all(-1))
        areas = [(p[1].start, p[1].stop, p[0].start, p[0].stop) for p in find_objects(parts)]
        found[rule] = sorted(area for area in areas if area[1] - area[0] > 50 and area[3] - area[2] > 50)
        assert len(found[rule]) == 2  # from above, from the side
    above, beside = found[BETWEEN][0], found[SINGLE][1]  # all of each view
    for view, name, across in ((above, SINGLE, 0), (beside, BETWEEN, 1)):
        assert found[name][across] == pytest.approx((*view[:2], (view[2] + 3 * view[3]) / 4, view[3]), abs=3)
    for view, area in zip((above, beside), found[NEAR]):
        assert area == pytest.approx((view[0], (3 * view[0] + view[1]) / 4, *view[2:]), abs=3)


def test_no_picture_where_no_rule_closed_anything(tmp_path: Path) -> None:
    nothing, nowhere = torch.zeros(8**3, dtype=torch.bool), torch.zeros(0, 3)
    known = KnownSpace(8, False, torch.ones(8**3), nothing, dict.fromkeys((NEAR, SINGLE, BETWEEN), nothing), 0.0)
    assert not write_closed_picture(tmp_path / "closed.png", known, nowhere, nowhere)
    assert not (tmp_path / "closed.png").exists()
