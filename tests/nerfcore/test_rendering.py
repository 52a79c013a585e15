"""The renderer against a scene with a closed form: a ball of constant density, colour and class."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
import pytest
import torch
from fieldwork.nerfcore.config import RunConfig
from fieldwork.nerfcore.errors import Cancelled
from fieldwork.nerfcore.field.hybrid import Geometry
from fieldwork.nerfcore.geometry.cameras import Camera
from fieldwork.nerfcore.geometry.orbit import orbit_angles
from fieldwork.nerfcore.kernels.runtime import worker_count
from fieldwork.nerfcore.render import image
from fieldwork.nerfcore.render.image import Frame, render_view
from fieldwork.nerfcore.render.model import Model
from fieldwork.nerfcore.render.verb import look_at

RADIUS, DENSITY = 0.6, 4.0
COLOR = torch.tensor([0.9, 0.4, 0.1])


class BallField(torch.nn.Module):
    """A field with known values; stands in for the trained one."""

    dtype = torch.float32
    grid = blend = appearance = None
    classes = 2
    semantic_head = object()
    strength = DENSITY

    def geometry(self, points: torch.Tensor, known: torch.Tensor | None = None) -> Geometry:
        inside = ((points * 2 - 1).norm(dim=1) < RADIUS).float()
        return Geometry(inside * self.strength, inside[:, None], None, None)

    def color(self, geometry: Geometry, directions: torch.Tensor, codes: torch.Tensor | None = None) -> torch.Tensor:
        return COLOR.expand(len(geometry.density), 3)

    def logits(self, geometry: Geometry) -> torch.Tensor:
        return torch.tensor([0.0, 20.0]).expand(len(geometry.density), 2)

    def class_probabilities(self, geometry: Geometry) -> torch.Tensor:
        return torch.softmax(self.logits(geometry), 1)


def ball_model(samples: int, pdf: str = "default", resolution: int = 64) -> Model:
    config = RunConfig.model_validate(
        {
            "sampling": {"samples": samples, "pdf": pdf, "resolution": resolution},
            "render": {"cull": 0, "samples": None},
            "field": {"levels": 1},
        }
    )
    model = Model(config, 2, 0, contracted=False).eval()
    model.field = BallField()  # type: ignore[assignment]
    occupancy = model.occupancy
    cells = torch.arange(resolution**3)
    corner = torch.stack([cells % resolution, cells // resolution % resolution, cells // resolution**2], 1)
    center = (corner + 0.5) / resolution * 2 - 1
    occupancy.density = torch.where(center.norm(dim=1) < RADIUS + 2 / resolution, DENSITY, 0.0)
    occupancy.mean = occupancy.density.clone()
    occupancy.rebuild()
    return model


def closed_form(camera: Camera, pose: np.ndarray, background: float) -> tuple[np.ndarray, np.ndarray]:
    """Colour (H, W, 3) and opacity (H, W): 1 − exp(−σ · chord)."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    directions = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    directions = directions @ pose[:3, :3].T
    middle = -(directions @ pose[:3, 3])
    closest = np.linalg.norm(pose[:3, 3]) ** 2 - middle**2
    chord = 2 * np.sqrt(np.maximum(RADIUS**2 - closest, 0))
    opacity = 1 - np.exp(-DENSITY * chord)
    return opacity[..., None] * COLOR.numpy() + background * (1 - opacity[..., None]), opacity


def view() -> tuple[Camera, np.ndarray]:
    camera = Camera(width=48, height=40, fx=70, fy=70, cx=24, cy=20)
    return camera, look_at(np.array([1.8, -1.9, 1.2]), np.zeros(3))


def rendered(samples: int, pdf: str = "default") -> tuple[Frame, np.ndarray, np.ndarray]:
    camera, pose = view()
    return render_view(ball_model(samples, pdf), camera, pose, 1.0), *closed_form(camera, pose, 1.0)


@pytest.mark.parametrize("pdf", ["default", "uniform"])
def test_a_ball_of_constant_density_renders_to_its_closed_form(pdf: str) -> None:
    frame, color, opacity = rendered(192, pdf)
    assert np.abs(frame.opacity - opacity).mean() < 0.01
    assert np.abs(frame.color - color).mean() < 0.01
    # the rim is where a cell of the grid is coarse; the middle must be exact
    solid = opacity > 0.9
    assert solid.sum() > 100
    assert np.abs(frame.color - color)[solid].max() < 0.02


def test_depth_labels_and_normals_of_the_ball() -> None:
    frame, _, opacity = rendered(192)
    _, pose = view()
    middle = frame.depth[20, 24]
    distance = np.linalg.norm(pose[:3, 3])
    # expected depth of an exponential absorber over the chord 2R
    tau = DENSITY * 2 * RADIUS
    expected = distance - RADIUS + (1 / DENSITY) * (1 - (1 + tau) * math.exp(-tau)) / (1 - math.exp(-tau))
    assert middle == pytest.approx(expected, abs=0.03)
    assert np.isnan(frame.depth[0, 0])
    label = frame.label([3, 7])
    assert label[20, 24] == 7
    assert label[0, 0] == 0
    assert np.array_equal(label[opacity > 0.6] == 7, np.full((opacity > 0.6).sum(), True))
    toward = pose[:3, 3] / distance
    assert frame.normal()[20, 24] @ toward > 0.97


def test_depths_of_a_panorama_are_distances() -> None:
    """From the middle of the ball all is as far, also what is behind the camera."""
    camera = Camera(model="EQUIRECTANGULAR", width=40, height=20, fx=20, fy=20, cx=20, cy=10)
    frame = render_view(ball_model(96), camera, np.eye(4), 1.0)
    assert frame.opacity.min() > 0.8
    middle = (1 - math.exp(-DENSITY * RADIUS) * (1 + DENSITY * RADIUS)) / DENSITY / (1 - math.exp(-DENSITY * RADIUS))
    assert frame.depth == pytest.approx(np.full((20, 40), middle), rel=0.2)  # a ray has 96 samples in coarse cells


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (48, 1)])
def test_a_picture_may_have_one_row_or_column(size: tuple[int, int]) -> None:
    camera, pose = view()
    frame = render_view(ball_model(32), camera.reframed(*size), pose, 1.0)
    assert frame.normal().shape == (size[1], size[0], 3)
    assert not frame.normal().any()


def test_an_empty_field_is_background() -> None:
    camera, pose = view()
    model = ball_model(8)
    model.occupancy.density.zero_()
    model.occupancy.rebuild()
    frame = render_view(model, camera, pose, 0.25)
    assert np.allclose(frame.color, 0.25)
    assert not frame.label([1, 2]).any()


def test_a_picture_stops_as_soon_as_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(image, "CPU_RAYS", 16)
    camera, pose = view()
    model = ball_model(8)
    asked, tiles, render = threading.Event(), [], model.render

    def rendering(*arguments: Any, **settings: Any) -> Any:
        tiles.append(1)
        asked.set()
        return render(*arguments, **settings)

    def check() -> None:
        if asked.is_set():
            raise Cancelled

    monkeypatch.setattr(model, "render", rendering)
    with pytest.raises(Cancelled):
        render_view(model, camera, pose, 1.0, check=check)
    assert 0 < len(tiles) <= worker_count()


def test_the_pdf_puts_samples_where_the_light_is_absorbed() -> None:
    """Few samples place an opaque surface better when they follow the density than when they are spread evenly."""
    camera, pose = view()
    distance = np.linalg.norm(pose[:3, 3])
    errors = {}
    for pdf in ("default", "uniform"):
        model = ball_model(8, pdf)
        model.field.strength = 400.0  # type: ignore[assignment]
        model.occupancy.density *= 100
        model.occupancy.mean *= 100
        model.occupancy.rebuild()
        frame = render_view(model, camera, pose, 1.0)
        errors[pdf] = abs(frame.depth[20, 24] - (distance - RADIUS))
    assert errors["default"] < 0.5 * errors["uniform"]


def test_an_orbit_goes_once_around_what_was_photographed_from_all_sides():
    angles = orbit_angles(np.radians(np.arange(0, 360, 45) + 7.0), 8)
    assert np.allclose(np.degrees(angles), np.arange(8) * 45)


@pytest.mark.parametrize("middle", [-90.0, 0.0, 178.0])
def test_an_orbit_before_a_facade_stays_where_photos_were_taken(middle: float):
    shots = np.random.default_rng(3).permutation(np.linspace(middle - 50, middle + 50, 15))
    away = (np.degrees(orbit_angles(np.radians(shots), 10)) - middle + 180) % 360 - 180
    assert np.allclose(away, np.linspace(-45, 45, 10))


def test_an_orbit_of_one_photo_stays_with_it():
    assert np.allclose(orbit_angles(np.radians([30.0]), 3) % (2 * math.pi), math.radians(30))


@pytest.mark.parametrize("up", [None, np.array([0.0, 0.0, -2.0]), np.array([1.0, 0.0, 0.0])])
def test_a_camera_straight_above_looks_down(up: np.ndarray | None) -> None:
    pose = look_at(np.array([0.5, 1.0, 3.0]), np.array([0.5, 1.0, -1.0]), up)
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    assert np.allclose(pose[:3, 2], [0, 0, -1])
