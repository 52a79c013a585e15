"""Texture and classes of a finished surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from ..data.box import box_poses
from ..data.scene import Scene
from ..files import atomic_path
from ..images.encode import write_picture
from ..progress import Reporter
from .facelets import facelets
from .photo_texture import Fill, Prepared, check_memory, field_texture, photo_texture, prepare
from .photos import Photo, posed_photo
from .surface_labels import (
    ClassField,
    ClassMaps,
    SurfaceClasses,
    class_evidence,
    class_maps,
    class_picture,
    surface_classes,
)
from .texture_size import texels_needed, texture_size
from .uv import UvMap, unwrap
from .visibility import DepthBuffers, observe, with_flat_views

LONGEST = (
    1 / 100
)  # of the surface's size: edges of the pieces that are seen or not, where no texture asks for finer ones
# What is written beside texture.png; see `write_maps`.
MAPS = ("texture_unseen.png", "class_id.png", "class_confidence.png", "class_color.png")


@dataclass(frozen=True)
class Painted:
    """uv, image (S, S, 3) uint8 sRGB and maps: None without a texture; unseen (S, S) uint8, 255 where no photo painted,
    and seen, the share of the surface that one did: None unless it is made of photos."""

    classes: SurfaceClasses
    uv: UvMap | None = None
    image: np.ndarray | None = None
    unseen: np.ndarray | None = None
    seen: float | None = None
    maps: ClassMaps | None = None


def training_photos(scene: Scene, box_from_world: np.ndarray) -> list[Photo]:
    """The photos that a surface may be painted from: those that were trained with, posed in the normalised frame."""
    views = [scene.views[i] for i in scene.train]
    return [posed_photo(view, pose) for view, pose in zip(views, box_poses(views, box_from_world))]


def paint_surface(
    vertices: np.ndarray,
    faces: np.ndarray,
    colors: np.ndarray,
    photos: list[Photo],
    size: int | Literal["auto"] | None,
    kind: Literal["photo", "field"],
    class_ids: list[int],
    void: int,
    field_color: Fill,
    field_classes: ClassField | None,
    report: Reporter,
    continued: bool = False,
) -> Painted:
    """Texture and classes of a mesh in the frame of the photos.

    Args:
        vertices (V, 3), faces (F, 3), colors (V, 3) uint8 sRGB. size: of the texture; "auto" for what the photos need, None for none.
        kind: what the texture shows. void: id of what nothing says anything about.
        continued: whether what no photo sees has the classes around it; see `class_evidence`.
        field_color, field_classes: points (N, 3) and normals (N, 3) → colours (N, 3) uint8, probabilities (N, C).
    Raises:
        SettingError: no memory for the texture. TrainingError: the mesh cannot be unwrapped.
    """
    uv = None
    if size is None:
        report.stage("Finding what the photos see")
        pieces = facelets(vertices, faces, limit=float(np.ptp(vertices, axis=0).max()) * LONGEST)
        buffers = DepthBuffers([photo.view for photo in photos], pieces)
        made = Prepared(photos, pieces, buffers, observe(buffers, report), 0)
    else:
        uv = unwrapped(vertices, faces, photos, size, report)
        made = prepare(vertices, faces, uv.corners, photos, uv.size, report)
    report.stage("Reading classes")
    pieces = made.pieces
    contrast = colors[faces].mean(1)[pieces.parent] / 255
    seen = with_flat_views(made.seen, made.buffers, report)
    evidence = class_evidence(photos, pieces, seen, class_ids, field_classes, contrast, report, continued)
    classes = surface_classes(len(vertices), faces, pieces, evidence, class_ids, void)
    if uv is None:
        return Painted(classes)
    maps = None
    if class_ids:
        report.stage("Painting the classes")
        maps = class_maps(photos, made.buffers, seen, evidence, class_ids, void, uv.size, report)
    if kind == "field":
        return Painted(classes, uv, field_texture(vertices, faces, uv.corners, uv.size, field_color, report), maps=maps)
    texture = photo_texture(made, field_color, report)
    return Painted(classes, uv, texture.image, texture.unseen, texture.seen, maps)


def unwrapped(
    vertices: np.ndarray, faces: np.ndarray, photos: list[Photo], size: int | Literal["auto"], report: Reporter
) -> UvMap:
    """UV of a mesh in the frame of the photos for a texture of `size`, or of the size that they need.

    Raises:
        SettingError: no memory for the texture. TrainingError: the mesh cannot be unwrapped.
    """
    if size != "auto":
        check_memory(size)
        report.stage("Unwrapping")
        return unwrap(vertices, faces, size, report)
    report.stage("Choosing the size of the texture")
    texels = texels_needed(vertices, faces, photos, report)
    report.stage("Unwrapping")
    return unwrap(vertices, faces, partial(texture_size, texels), report)


def write_maps(
    folder: Path, painted: Painted, colors: dict[int, tuple[float, float, float]], check: Callable[[], None]
) -> list[Path]:
    """Write texture.png and the maps that belong to it.

    texture_unseen.png: 255 where no photo painted; class_id.png: grey, the ids themselves; class_confidence.png: 255 for
    certain; class_color.png: the classes in their colours (sRGB in [0, 1] by id).

    Returns:
        the files written.
    Raises:
        DiskError: one cannot be written.
    """
    pictures = {"texture.png": painted.image, "texture_unseen.png": painted.unseen}
    if painted.maps is not None:
        pictures["class_id.png"], pictures["class_confidence.png"] = painted.maps.ids, painted.maps.confidence
        pictures["class_color.png"] = class_picture(painted.maps.ids, colors)
    written = []
    for name in ("texture.png", *MAPS):
        picture = pictures.get(name)
        if picture is None:
            continue
        with atomic_path(folder / name) as temporary:
            write_picture(temporary, picture if picture.ndim == 3 else picture[..., None], check)
        written.append(folder / name)
    return written
