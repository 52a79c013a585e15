"""How large a texture has to be to hold what the photos show, and no larger."""

from __future__ import annotations

import numpy as np

from ..progress import Reporter
from .facelets import small_pieces
from .photo_texture import fits
from .photos import Photo
from .uv import COVERED, PADDING
from .visibility import DepthBuffers, PosedCamera, observe

TEXELS = 1.6  # along a pixel of the photo that shows a place largest, at least: more show nothing more
SMALLEST, LARGEST = 512, 8192
LOOK = 400  # pixels: longest side, of most photos, of the pictures in which it is looked up what each of them sees


def texture_size(texels: float, charts: int) -> int:
    """The smallest power of two for a texture that has a surface of `texels` (see `texels_needed`) in so many charts; less where
    the memory is short."""
    # Charts that cover a share c of a square of side s lose their padding: √c·s − padding·√charts texels are left.
    wanted = (texels + PADDING * np.sqrt(charts)) / np.sqrt(COVERED)
    size = int(2 ** np.ceil(np.log2(np.clip(wanted, SMALLEST, LARGEST))))
    while size > SMALLEST and not fits(size):
        size //= 2
    return size


def texels_needed(vertices: np.ndarray, faces: np.ndarray, photos: list[Photo], report: Reporter) -> float:
    """Side, in texels, of a square as large as a mesh (V, 3), (F, 3) in the photos' frame, if it has `TEXELS` a pixel; 0 where
    no photo shows it.
    """
    pieces = small_pieces(vertices, faces)
    seen = observe(DepthBuffers(_smaller([photo.view for photo in photos]), pieces), report, most=1)
    pixels = area = 0.0
    for number, photo in enumerate(photos):
        face, _ = seen.of(number)
        towards = photo.view.center - pieces.centers[face]
        distance = np.maximum(np.linalg.norm(towards, axis=1), 1e-12)
        cosine = np.einsum("ij,ij->i", towards, pieces.normals[face]) / distance
        depth = photo.view.depth(photo.view.local(pieces.centers[face]))
        # Off the optical axis a pixel is a smaller angle.
        pixels += float((pieces.areas[face] * cosine * distance / depth / photo.view.footprint(depth) ** 2).sum())
        area += float(pieces.areas[face].sum())
    return TEXELS * float(np.sqrt(pixels / max(area, 1e-30) * pieces.areas.sum()))


def _smaller(views: list[PosedCamera]) -> list[PosedCamera]:
    """The same views in smaller pictures, all by one factor, so that the one that shows a place largest still does."""
    cameras = [view.camera for view in views]
    scale = min(1.0, LOOK / np.median([max(camera.width, camera.height) for camera in cameras])) if views else 1.0
    sizes = [(max(1, round(camera.width * scale)), max(1, round(camera.height * scale))) for camera in cameras]
    return [PosedCamera(view.camera.resized(*size), view.pose) for view, size in zip(views, sizes)]
