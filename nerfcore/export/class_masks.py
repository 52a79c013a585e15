"""Masks of the classes of a mesh, as photos and its texture have them: white is the class."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from ..data.scene import ClassInfo, View
from ..files import staged
from ..images.encode import write_picture
from ..images.names import file_names
from ..mesh.facelets import small_pieces
from ..mesh.surface import Surface
from ..mesh.visibility import PosedCamera, depth_buffer
from ..progress import Reporter


def write_masks(
    out: Path,
    surface: Surface,
    texture_ids: np.ndarray | None,
    views: Sequence[View],
    classes: Sequence[ClassInfo],
    report: Reporter,
) -> list[Path]:
    """OUT/photos/CLASS/PHOTO.png, what of a class each photo shows by the mesh, and OUT/texture/CLASS.png: 8 bits, 255 for
    the class. They are all written, or none.

    Args:
        surface: in the world, as the views. texture_ids: (S, S) class of each texel, where there is a texture.
        classes: those that get masks.
    Returns:
        the files written.
    Raises:
        DiskError: a file cannot be written.
    """
    names = dict(zip((c.id for c in classes), file_names([c.name for c in classes])))
    pieces = small_pieces(surface.vertices, surface.faces)
    piece_class = surface.face_class[pieces.parent]
    written: list[Path] = []
    with ExitStack() as stack:
        places = {number: stack.enter_context(staged(out / "photos" / name)) for number, name in names.items()}
        for done, view in enumerate(views):
            report.progress(done / len(views))
            camera = PosedCamera(view.camera, np.asarray(view.camera_to_world, np.float64))
            face = depth_buffer(camera, pieces.vertices, pieces.faces).face
            shown = np.where(face >= 0, piece_class[face], -1)
            for number, place in places.items():
                report.check()
                write_picture(place / f"{view.name}.png", _mask(shown == number), report.check)
                written.append(out / "photos" / names[number] / f"{view.name}.png")
        if texture_ids is not None:
            place = stack.enter_context(staged(out / "texture"))
            for number, name in names.items():
                write_picture(place / f"{name}.png", _mask(texture_ids == number), report.check)
                written.append(out / "texture" / f"{name}.png")
    return written


def _mask(chosen: np.ndarray) -> np.ndarray:
    return np.where(chosen, np.uint8(255), np.uint8(0))
