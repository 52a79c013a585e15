"""Pixels to viewing directions for many cameras at once, on the device: `geometry.cameras.rays` for a batch."""

from __future__ import annotations

import torch

from ..geometry.cameras import Camera
from ..kernels.device import backend_of

MODELS = ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "EQUIRECTANGULAR")
STEPS = 25  # of Newton's method; it doubles the correct digits in each, near the solution
CHUNK = 1 << 18  # pixels that are worked on at once


class Lenses:
    """The lenses of V cameras. Works in float64, on the host for devices without it."""

    def __init__(self, cameras: list[Camera], device: torch.device) -> None:
        self.device = device if backend_of(device).has_float64 else torch.device("cpu")
        self.models = sorted({c.model for c in cameras}, key=MODELS.index)
        self.model = torch.tensor([MODELS.index(c.model) for c in cameras], device=self.device)

        def table(rows: list[tuple[float, ...]]) -> torch.Tensor:
            return torch.tensor(rows, dtype=torch.float64, device=self.device)

        self.size = table([(c.width, c.height) for c in cameras])
        self.focal = table([(c.fx, c.fy) for c in cameras])
        self.middle = table([(c.cx, c.cy) for c in cameras])
        self.distortion = table([(*c.distortion, *(0.0,) * (8 - len(c.distortion))) for c in cameras])

    def directions(self, image: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
        """Unit viewing directions (N, 3) float32 in camera axes of pixel coordinates `places` (N, 2) of cameras `image`
        (N,); NaN where the distortion cannot be inverted."""
        parts = zip(image.split(CHUNK), places.split(CHUNK))
        found = [self._part(i.to(self.device), p.to(self.device, torch.float64)).float() for i, p in parts]
        return (torch.cat(found) if found else places.new_zeros(0, 3)).to(image.device, torch.float32)

    def _part(self, image: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
        uv = (places - self.middle[image]) / self.focal[image]
        model = self.model[image]
        out = torch.zeros(len(image), 3, dtype=torch.float64, device=self.device)
        for name in self.models:
            if name == "EQUIRECTANGULAR":
                found = _equirectangular(places / self.size[image])
            elif name == "OPENCV_FISHEYE":
                found = _fisheye(uv, self.distortion[image])
            else:
                found = _perspective(uv, self.distortion[image] if name == "OPENCV" else None)
            out = torch.where((model == MODELS.index(name))[:, None], found, out)
        return out


def _equirectangular(share: torch.Tensor) -> torch.Tensor:
    longitude, latitude = (share[:, 0] - 0.5) * 2 * torch.pi, (0.5 - share[:, 1]) * torch.pi
    return torch.stack(
        [latitude.cos() * longitude.sin(), -latitude.sin(), latitude.cos() * longitude.cos()],
        1,
    )


def _fisheye(uv: torch.Tensor, k: torch.Tensor) -> torch.Tensor:
    """r = θ(1 + k1θ² + k2θ⁴ + k3θ⁶ + k4θ⁸) inverted by Newton."""
    radius = uv.norm(dim=1)
    theta = radius.clamp(0, torch.pi)

    def value_and_slope(t: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        terms = [k[:, n - 1] * t ** (2 * n) for n in range(1, 5)]
        odd = [(2 * n + 1) * term for n, term in enumerate(terms, 1)]
        return t * (1 + torch.stack(terms).sum(0)), 1 + torch.stack(odd).sum(0)

    for _ in range(STEPS):
        value, slope = value_and_slope(theta)
        theta = (theta - (value - radius) / torch.where(slope.abs() < 1e-9, 1e-9, slope)).clamp(0, torch.pi)
    value, slope = value_and_slope(theta)
    valid = ((value - radius).abs() < 1e-9) & (slope > 0)
    scale = torch.where(radius > 1e-12, theta.sin() / radius.clamp(min=1e-12), 1.0)
    direction = torch.cat([uv * scale[:, None], theta.cos()[:, None]], 1)
    return torch.where(valid[:, None], direction, torch.nan)


def _distort(u: torch.Tensor, v: torch.Tensor, k: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Distorted coordinates and their derivatives x_u, x_v = y_u, y_v; see `geometry.cameras._opencv_slopes`."""
    k1, k2, p1, p2, k3, k4, k5, k6 = k.unbind(1)
    r2 = u * u + v * v
    top, bottom = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = top / bottom
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2) - radial * (k4 + r2 * (2 * k5 + 3 * k6 * r2))) / bottom
    x = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    y = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
    xu = radial + u * u * slope + 2 * p1 * v + 6 * p2 * u
    xv = u * v * slope + 2 * p1 * u + 2 * p2 * v
    yv = radial + v * v * slope + 6 * p1 * v + 2 * p2 * u
    return x, y, xu, xv, yv


def _perspective(target: torch.Tensor, k: torch.Tensor | None) -> torch.Tensor:
    """Directions through normalised coordinates (N, 2), with OpenCV's distortion inverted by damped Newton."""
    u, v = target.unbind(1)
    valid = torch.ones_like(u, dtype=torch.bool)
    if k is not None:
        for _ in range(STEPS):
            x, y, xu, xv, yv = _distort(u, v, k)
            determinant = xu * yv - xv * xv
            determinant = torch.where(determinant.abs() < 1e-9, 1e-9, determinant)
            dx, dy = x - target[:, 0], y - target[:, 1]
            step_u, step_v = (yv * dx - xv * dy) / determinant, (xu * dy - xv * dx) / determinant
            # A step longer than half the image plane means the lens polynomial has folded over: keep it damped.
            length = (torch.hypot(step_u, step_v) / 0.5).clamp(min=1.0)
            u, v = u - step_u / length, v - step_v / length
        x, y, xu, xv, yv = _distort(u, v, k)
        error = torch.maximum((x - target[:, 0]).abs(), (y - target[:, 1]).abs())
        # Without distortion the pinhole's direction is exact, and always valid.
        valid = (k == 0).all(1) | ((error < 1e-9) & (xu * yv - xv * xv > 0))
    direction = torch.stack([u, v, torch.ones_like(u)], 1)
    direction = direction / direction.norm(dim=1, keepdim=True)
    return torch.where(valid[:, None], direction, torch.nan)
