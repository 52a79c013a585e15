"""What it costs a texture that photos were exposed differently: painted once more from photos made brighter and darker."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..data.scene import View
from ..images.picture import linear_to_srgb, to_bytes
from ..mesh.painted import Painted
from ..mesh.photo_texture import photo_texture, prepare
from ..mesh.photos import LINEAR, Photo
from ..progress import Reporter
from .surface_figures import picture_figures

STOPS = 0.3  # by which photos are made brighter or darker


def exposed(photo: Photo, stops: float) -> Photo:
    """A photo as the same camera would have taken it with so many stops more light, white where that is too much."""
    table = to_bytes(linear_to_srgb(np.minimum(LINEAR * 2.0**stops, 1)))

    def read() -> np.ndarray:
        rgba = photo.read().copy()
        rgba[..., :3] = table[rgba[..., :3]]
        return rgba

    return replace(photo, read=read)


def exposure_cost(
    vertices: np.ndarray,
    faces: np.ndarray,
    photos: list[Photo],
    painted: Painted,
    held_out: tuple[Callable[[np.ndarray], np.ndarray], Sequence[View]],
    report: Reporter,
) -> float | None:
    """Decibels that the texture of a mesh (V, 3), (F, 3) loses against held-out photos where half of the photos that it is
    painted from, by chance, are `STOPS` brighter and the others darker; None without a texture or held-out photos.

    Args:
        photos: in the frame of the mesh. held_out: brings points (N, 3) of that frame into the frame of the views,
            and the views.
    """
    to_world, views = held_out
    if painted.uv is None or painted.image is None or not views:
        return None
    signs = np.random.default_rng(0).permutation(np.arange(len(photos)) % 2 * 2 - 1)
    changed = [exposed(photo, STOPS * float(sign)) for photo, sign in zip(photos, signs)]
    made = prepare(vertices, faces, painted.uv.corners, changed, len(painted.image), report)
    image = photo_texture(made, None, report).image
    mesh = to_world(vertices).astype(np.float64), faces
    before, after = (picture_figures(mesh, p, views)["mesh_psnr"] for p in (painted, replace(painted, image=image)))
    return None if before is None or after is None else before - after
