"""Directions that drawings look in, and parallel pictures of a surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import SettingError
from ..images.picture import linear_to_srgb, to_bytes
from ..kernels.raycast import FrontFaces
from ..mesh.parts import Texture
from ..mesh.photos import LINEAR
from ..mesh.surface import Surface
from ..progress import Reporter

# What is to the right and what is up in the drawing, in a world with z up and y to the back.
DIRECTIONS = {
    "top": ((1, 0, 0), (0, 1, 0)),
    "bottom": ((1, 0, 0), (0, -1, 0)),
    "front": ((1, 0, 0), (0, 0, 1)),
    "back": ((-1, 0, 0), (0, 0, 1)),
    "right": ((0, 1, 0), (0, 0, 1)),
    "left": ((0, -1, 0), (0, 0, 1)),
}
SEEN_FROM = {"z": "top", "y": "front", "x": "right"}  # planes across an axis
SAMPLES = 2  # rays a pixel, along each side
BAND = 1 << 20  # rays at once


@dataclass(frozen=True)
class Projection:
    """A parallel projection: the rows of `axes` (3, 3) point right, up and towards the eye; a right-handed frame."""

    name: str
    axes: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points (…, 3) of the world: to the right, upwards and towards the eye."""
        return np.asarray(points, np.float64) @ self.axes.T


@dataclass(frozen=True)
class Window:
    """A rectangle of a drawing: its corners low and high (2,) to the right and upwards, and the size of a pixel."""

    low: np.ndarray
    high: np.ndarray
    pixel: float

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        width, height = np.maximum(np.ceil((self.high - self.low) / self.pixel - 1e-6), 1).astype(int)
        return int(width), int(height)


@dataclass(frozen=True)
class Picture:
    """A parallel picture: color (H, W, 3) uint8 sRGB, face (H, W) int, −1 where there is no surface."""

    color: np.ndarray
    face: np.ndarray


def projection(name: str, turn: float = 0.0) -> Projection:
    """The view from `top`, `front`, …, the world turned by degrees about z against it."""
    right, up = (np.array(axis, np.float64) for axis in DIRECTIONS[name])
    angle = np.radians(turn)
    around = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return Projection(name, np.stack([around @ right, around @ up, around @ np.cross(right, up)]))


def plane(text: str, turn: float) -> tuple[Projection, float]:
    """A section plane such as “z=1.2”: the projection that looks at it, and where along its third axis it lies.

    Raises:
        SettingError: it is of another form.
    """
    axis, _, value = text.replace(" ", "").partition("=")
    try:
        place = float(value)
    except ValueError:
        place = np.nan
    if axis not in SEEN_FROM or not np.isfinite(place):
        raise SettingError(f"{text} is no plane.", "Give x=…, y=… or z=… in the aligned world, such as z=1.2.")
    view = projection(SEEN_FROM[axis], turn)
    # The axis that is named points away from the eye in views from the front.
    return view, -place if axis == "y" else place


def picture(
    surface: Surface, texture: Texture | None, view: Projection, window: Window, before: float, report: Reporter
) -> Picture:
    """What a parallel view shows of a surface (only faces turned to the eye, as one looks into a room).

    Args:
        before: nothing nearer to the eye than this, along the third axis, is shown.
    """
    width, height = window.size
    mesh = FrontFaces(surface.vertices, surface.faces)
    color, face = np.full((height, width, 3), 255, np.uint8), np.full((height, width), -1, np.int64)
    rows = max(1, BAND // (width * SAMPLES**2))
    for top in range(0, height, rows):
        report.progress(top / height)
        band = slice(top, min(height, top + rows))
        tall = band.stop - band.start
        u = window.low[0] + (np.arange(width * SAMPLES) + 0.5) * window.pixel / SAMPLES
        v = window.high[1] - (np.arange(top * SAMPLES, band.stop * SAMPLES) + 0.5) * window.pixel / SAMPLES
        place = np.stack([*np.meshgrid(u, v), np.full((len(v), len(u)), before)], -1).reshape(-1, 3)
        found, corner = mesh.cast(place @ view.axes, np.broadcast_to(-view.axes[2], place.shape))
        hit = found >= 0
        light = np.ones((len(place), 3), np.float32)
        light[hit] = surface_light(surface, texture, found[hit], corner[hit])
        shape = (tall, SAMPLES, width, SAMPLES)
        color[band] = to_bytes(linear_to_srgb(light.reshape(*shape, 3).mean((1, 3))))
        face[band] = found.reshape(shape)[:, SAMPLES // 2, :, SAMPLES // 2]
    return Picture(color, face)


def surface_light(surface: Surface, texture: Texture | None, face: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Linear light (N, 3) of places in triangles (N,), given by the weights (N, 2) of their first two corners."""
    weights = np.concatenate([corner, 1 - corner.sum(1, keepdims=True)], 1)[..., None]
    if texture is None:
        return (LINEAR[surface.colors[surface.faces[face]]] * weights).sum(1)
    uv = (texture.unwrapped.uv[texture.unwrapped.faces[face]] * weights).sum(1)
    size = texture.image.shape[0]
    x, y = np.clip((uv * [1, -1] + [0, 1]) * size, 0, size - 1).astype(int).T
    return LINEAR[texture.image[y, x]]
