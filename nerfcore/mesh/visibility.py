"""Which photos see which part of a mesh: depth buffers of the mesh in each photo."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
import torch

from ..geometry.cameras import Camera, project
from ..kernels.runtime import run_parallel, worker_count
from ..kernels.triangles import nearest_triangle
from ..progress import Reporter
from .facelets import Facelets

CPU = torch.device("cpu")  # a thread draws one photo's buffer: there is one photo a core, and the rest is numpy
STEEPEST = np.cos(np.radians(75))  # what is seen at a smaller cosine is not taken from a photo
FLATTEST = np.cos(np.radians(85))  # and at a smaller one than this a photo does not even say what it is
SLACK_PIXELS = 2.0  # how much nearer something may be before it hides a point, in footprints of a pixel
PARTLY = 0.3  # weight of a facelet that something hides in part


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("ij,ij->i", vectors, vectors))


def within(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Whether pixel coordinates (N, 2) lie in a picture: (N,); not a number does not."""
    x, y = pixels.T
    with np.errstate(invalid="ignore"):
        return (x >= 0) & (y >= 0) & (x < width) & (y < height)


@dataclass(frozen=True)
class PosedCamera:
    """A camera and where it stands: camera-to-mesh (4, 4), OpenCV axes. shows: → which pixels (H, W) bool a mask leaves to be
    taken from, None for all."""

    camera: Camera
    pose: np.ndarray
    shows: Callable[[], np.ndarray | None] | None = None

    @property
    def center(self) -> np.ndarray:
        return self.pose[:3, 3]

    def local(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the mesh's frame in camera axes."""
        return (points - self.pose[:3, 3]) @ self.pose[:3, :3]

    def depth(self, local: np.ndarray) -> np.ndarray:
        """Depth (N,) of points (N, 3) in camera axes: along the optical axis, or the distance for lenses that look
        sideways."""
        wide = self.camera.model in ("EQUIRECTANGULAR", "OPENCV_FISHEYE")
        return _length(local) if wide else local[:, 2]

    def footprint(self, depth: np.ndarray) -> np.ndarray:
        """Width of a pixel at a depth (N,), in units of the mesh."""
        return depth / self.camera.pixels_per_radian

    def pixels(self, local: np.ndarray) -> np.ndarray:
        """Pixel coordinates (N, 2) of points (N, 3) in camera axes; NaN where the lens does not see."""
        return project(self.camera, local)


@dataclass(frozen=True)
class DepthBuffer:
    """What a camera sees of a mesh: `face` (H, W) int32, −1 for nothing; `depth` (H, W) float32, inf there, and
    `nearest` (H, W), the smallest depth among a pixel and its eight neighbours."""

    view: PosedCamera
    face: np.ndarray
    depth: np.ndarray
    nearest: np.ndarray

    def sees(self, pixels: np.ndarray, depth: np.ndarray, cosine: np.ndarray) -> np.ndarray:
        """Whether points are in the picture and nothing of the mesh is in front of them or of the pixels beside: (N,).

        Args:
            pixels: (N, 2) where they project; depth: (N,) theirs; cosine: (N,) of the angle at which they are seen.
        """
        height, width = self.depth.shape
        inside = within(pixels, width, height) & (depth > 0)
        x, y = np.where(inside[:, None], pixels, 0).astype(np.int32).T
        # Across the pixels that are looked at, a slanted surface has different depths itself.
        slope = np.sqrt(np.maximum(1 - cosine**2, 0)) / np.maximum(cosine, 0.1)
        slack = self.view.footprint(depth) * (SLACK_PIXELS + 3 * slope)
        return inside & (self.nearest[y, x] > depth - slack)


def depth_buffer(view: PosedCamera, vertices: np.ndarray, faces: np.ndarray, device: torch.device = CPU) -> DepthBuffer:
    """The mesh (V, 3), (F, 3) as a camera sees it, at one depth a pixel, drawn on `device`.

    Triangles are drawn with straight edges between their projected corners, so with a distorting lens they should be
    small. Those that reach behind the camera, or around a panorama's pole, are left out.
    """
    local = view.local(vertices)
    pixel, depth, size = view.pixels(local), view.depth(local), (view.camera.width, view.camera.height)
    widest, drawn, across = 1e9, faces, np.zeros(0, int)
    if view.camera.model == "EQUIRECTANGULAR":
        widest = size[0] / 2
        pixel, depth, drawn, across = _at_both_edges(pixel, depth, faces, size[0])
    face, nearest = nearest_triangle(pixel, depth, drawn, *size, device, widest)
    copies = face >= len(faces)
    if copies.any():
        face[copies] = across[(face[copies] - len(faces)) % len(across)]
    return DepthBuffer(view, face, nearest, scipy.ndimage.minimum_filter(nearest, 3, mode="nearest"))


def _at_both_edges(
    pixel: np.ndarray, depth: np.ndarray, faces: np.ndarray, width: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 2), (V,) of a panorama `width` wide and triangles (F, 3), with those across its edge once more beside the left
    and beside the right one; and the numbers of these triangles, in the order of either copy."""
    x = pixel[:, 0]
    across = np.flatnonzero(np.ptp(x[faces], axis=1) >= width / 2)
    if not len(across):
        return pixel, depth, faces, across
    corner, new = np.unique(faces[across], return_inverse=True)
    left = x[corner] < width / 2
    beyond = [pixel[corner] + np.stack([np.where(side, shift, 0), np.zeros(len(corner))], 1)
              for side, shift in ((left, width), (~left, -width))]  # fmt: skip
    copies = [len(pixel) + number * len(corner) + new.reshape(-1, 3) for number in (0, 1)]
    return (
        np.concatenate([pixel, *beyond]),
        np.concatenate([depth, depth[corner], depth[corner]]),
        np.concatenate([faces, *copies]).astype(faces.dtype),
        across,
    )


class DepthBuffers:
    """Depth buffers of the same mesh in several views, kept as long as they take less than `most` bytes together."""

    def __init__(self, views: Sequence[PosedCamera], pieces: Facelets, most: int = 1 << 30) -> None:
        self.views, self.pieces, self.left = views, pieces, most
        self._kept: dict[int, DepthBuffer] = {}

    def __getitem__(self, number: int) -> DepthBuffer:
        """The buffer of view `number`; may be called from several threads."""
        kept = self._kept.get(number)
        if kept is None:
            kept = depth_buffer(self.views[number], self.pieces.vertices, self.pieces.faces)
            size = kept.face.nbytes + kept.depth.nbytes + kept.nearest.nbytes
            if size <= self.left:
                self.left -= size
                self._kept[number] = kept
        return kept


@dataclass(frozen=True)
class Observations:
    """The best views of each of F facelets: view (F, K) int16, −1 for none; weight (F, K) float32: cosine² / footprint
    of a pixel, less where a part is hidden; whole (F, K) bool: all its corners are seen too."""

    view: np.ndarray
    weight: np.ndarray
    whole: np.ndarray

    def of(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Facelets (N,) that view `number` is among the best for, and the column (N,) where it stands."""
        face, column = np.nonzero(self.view == number)
        return face, column


def observe(
    buffers: DepthBuffers,
    report: Reporter,
    most: int = 8,
    steepest: float = STEEPEST,
    asked: np.ndarray | None = None,
) -> Observations:
    """Find the `most` best views of each facelet among all that see its middle, and whose masks leave it, at a cosine above
    `steepest`; `asked` (F,) bool: only of these."""
    count = len(buffers.pieces)
    best = np.full((count, most), -1, np.int16), np.zeros((count, most), np.float32), np.zeros((count, most), bool)
    for number, (face, weight, whole) in in_parallel(
        lambda number: _seen_by(buffers, number, steepest, asked), range(len(buffers.views)), report, "views"
    ):
        worst = best[1][face].argmin(1)
        better = weight > best[1][face, worst]
        place = face[better], worst[better]
        best[0][place], best[1][place], best[2][place] = number, weight[better], whole[better]
    return Observations(*best)


def with_flat_views(seen: Observations, buffers: DepthBuffers, report: Reporter) -> Observations:
    """Observations in which facelets that no view sees well enough for their colour have those that see them at a flatter
    angle: enough to read a class."""
    unseen = (seen.view < 0).all(1)
    flat = observe(buffers, report, seen.view.shape[1], FLATTEST, unseen)
    pairs = ((flat.view, seen.view), (flat.weight, seen.weight), (flat.whole, seen.whole))
    return Observations(*(np.where(unseen[:, None], new, old) for new, old in pairs))


def in_parallel(work, items: Sequence, report: Reporter, noun: str, device: torch.device = CPU) -> Iterator[tuple]:
    """(number, work(item)) of every item, which computes on a device, as many at once as there are threads for it; progress
    after each round."""
    step = max(worker_count(), 1)
    for begin in range(0, len(items), step):
        report.progress(begin / len(items), f"{begin} of {len(items)} {noun}")
        part = items[begin : begin + step]
        yield from enumerate(run_parallel([lambda item=item: work(item) for item in part], device), begin)


def _seen_by(
    buffers: DepthBuffers, number: int, steepest: float, asked: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Facelets (N,), of those `asked` (F,) bool, that a view sees at a cosine above `steepest`, their weight (N,) and whether
    they are seen as a whole (N,)."""
    view, pieces = buffers.views[number], buffers.pieces
    towards = view.center - pieces.centers
    distance = _length(towards)
    cosine = np.einsum("ij,ij->i", towards, pieces.normals) / np.maximum(distance, 1e-12)
    face = np.flatnonzero(cosine > steepest if asked is None else asked & (cosine > steepest))
    local = view.local(pieces.centers[face])
    pixel, depth = view.pixels(local), view.depth(local)
    shown = within(pixel, view.camera.width, view.camera.height)
    face, pixel, depth = face[shown], pixel[shown], depth[shown]
    mask = view.shows() if view.shows is not None and len(face) else None
    if mask is not None:
        x, y = pixel.astype(int).T
        face, pixel, depth = face[mask[y, x]], pixel[mask[y, x]], depth[mask[y, x]]
    if not len(face):
        return face, np.zeros(0, np.float32), np.zeros(0, bool)
    buffer = buffers[number]
    seen = buffer.sees(pixel, depth, cosine[face])
    face, depth = face[seen], depth[seen]
    corner = np.unique(pieces.faces[face])
    where = view.local(pieces.vertices[corner])
    # The angle of the steepest facelet around a corner is what its slack has to allow for.
    flattest = np.ones(len(pieces.vertices))
    np.minimum.at(flattest, pieces.faces[face], cosine[face, None])
    clear = np.zeros(len(pieces.vertices), bool)
    clear[corner] = buffer.sees(view.pixels(where), view.depth(where), flattest[corner])
    whole = clear[pieces.faces[face, 0]] & clear[pieces.faces[face, 1]] & clear[pieces.faces[face, 2]]
    weight = cosine[face] ** 2 / view.footprint(depth) * np.where(whole, 1, PARTLY)
    return face, weight.astype(np.float32), whole
