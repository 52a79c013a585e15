"""Levels of detail: the same surface with fewer triangles, its class borders as they are, and a texture of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..files import atomic_path
from ..images.encode import write_picture
from ..kernels.closest import ClosestPoints
from ..progress import Reporter
from .appearance import bilinear
from .decimate import decimate_patches
from .metrics import sample_surface
from .parts import Texture, texture_of
from .photo_texture import field_texture
from .stored import level_names
from .surface import Surface, vertex_normals
from .uv import unwrap

FEWER = 4  # times fewer triangles in each level: half as many along each way
SMALLEST = 256  # texels along a side of a texture
SAMPLES = 20_000  # points that the distance between two levels is measured at


@dataclass(frozen=True)
class Level:
    """A level of detail: `uv` (F, 3, 2) of its faces' corners and its texture, None without one; `deviation`: distance
    that 95 % of the full surface are within, in its units."""

    surface: Surface
    uv: np.ndarray | None
    texture: Texture | None
    deviation: float


def make_levels(surface: Surface, texture: Texture | None, count: int, report: Reporter) -> list[Level]:
    """The first `count` levels below the full surface, of a quarter of the triangles each where borders allow.

    Borders between classes, between instances and at the open edge keep all of their vertices.

    Raises:
        TrainingError: a level cannot be unwrapped. SettingError: no memory for a texture.
    """
    closest = ClosestPoints(surface.vertices, surface.faces)
    samples, _ = sample_surface(surface.vertices.astype(np.float64), surface.faces, SAMPLES)
    labels = np.stack([surface.face_class, _instances(surface)], 1)
    rows, patch = np.unique(labels, axis=0, return_inverse=True)
    # The world's origin may be far off.
    middle = (surface.vertices.min(0).astype(np.float64) + surface.vertices.max(0)) / 2
    vertices, faces, patch = surface.vertices - middle, surface.faces.astype(np.int64), patch.reshape(-1)
    levels = []
    for number in range(1, count + 1):
        report.stage(f"Simplifying, level {number}")
        vertices, faces, patch = decimate_patches(vertices, faces, patch, len(surface.faces) // FEWER**number, report)
        made = _dressed(surface, closest, vertices + middle, faces, rows[patch])
        deviation = float(np.quantile(ClosestPoints(made.vertices, faces).find(samples)[2], 0.95))
        uv = picture = None
        if texture is not None:
            size = max(min(SMALLEST, len(texture.image)), len(texture.image) >> number)
            uv = unwrap(made.vertices, made.faces, size, report).corners
            picture = texture_of(made.faces, uv, _repainted(closest, texture, made, uv, size, report))
        levels.append(Level(made, uv, picture, deviation))
    return levels


def write_level(folder: Path, number: int, level: Level, check: Callable[[], None]) -> list[Path]:
    """Write mesh_lod<number>.npz, as mesh.npz is, and texture_lod<number>.png if it has one. Raises DiskError."""
    arrays: dict[str, Any] = {name: value for name, value in vars(level.surface).items() if value is not None}
    if level.uv is not None:
        arrays["uv"] = level.uv
    mesh, texture = level_names(number)
    written = [folder / mesh]
    with atomic_path(written[0]) as temporary, open(temporary, "wb") as file:
        np.savez(file, **arrays)
    if level.texture is not None:
        written.append(folder / texture)
        with atomic_path(written[1]) as temporary:
            write_picture(temporary, level.texture.image, check)
    return written


def level_files(folder: Path) -> list[Path]:
    """The files of the levels of the mesh in a folder."""
    return [*folder.glob("mesh_lod*"), *folder.glob("texture_lod*.png")]


def _instances(surface: Surface) -> np.ndarray:
    return np.zeros(len(surface.faces), np.uint32) if surface.face_instance is None else surface.face_instance


def _dressed(
    full: Surface, closest: ClosestPoints, vertices: np.ndarray, faces: np.ndarray, labels: np.ndarray
) -> Surface:
    """Triangles with their (class, instance) (F, 2) as a surface with the colours of the full one."""
    face, weights, _ = closest.find(vertices)
    color = (full.colors[full.faces[face]] * weights[..., None]).sum(1)
    class_id = np.zeros(len(vertices), np.int32)
    class_id[faces] = labels[:, :1]
    return Surface(
        vertices.astype(np.float32),
        faces.astype(np.int32),
        vertex_normals(vertices, faces).astype(np.float32),
        (color + 0.5).clip(0, 255).astype(np.uint8),
        class_id,
        labels[:, 0].astype(full.face_class.dtype),
        None if full.face_instance is None else labels[:, 1].astype(np.uint32),
    )


def _repainted(
    closest: ClosestPoints, texture: Texture, level: Surface, uv: np.ndarray, size: int, report: Reporter
) -> np.ndarray:
    """A texture (S, S, 3) of a level with the colours that the full surface's texture has around the closest points: of detail
    finer than its own texels, the mean."""
    corners = texture.unwrapped.uv[texture.unwrapped.faces]
    image = np.asarray(Image.fromarray(texture.image).reduce(max(1, len(texture.image) // (2 * size))))
    side = len(image)

    def color(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        report.check()
        face, weights, _ = closest.find(points)
        place = (corners[face] * weights[..., None]).sum(1) * [1, -1] * side + [0, side]
        return (bilinear(image, place) * 255 + 0.5).astype(np.uint8)

    return field_texture(level.vertices, level.faces, uv, size, color, report)
