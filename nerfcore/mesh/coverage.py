"""How much of what photos show a mesh has: photos, above all held-out ones, against the mesh and the field's own depths.

What must be there is what a photo shows with some detail, where the field says that something is near: a dark room behind
an object, a sky or a white background have no detail, and hills are far. What is plain is not asked for in this way; where
it is missing in the middle of the mesh it is a hole.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
import torch

from ..data.box import box_poses
from ..data.scene import Scene, View
from ..geometry.cameras import Camera, pixel_centers, project, rays
from ..images.picture import resized
from ..images.working import nearest, read_picture
from ..kernels.depth_arrays import FREE
from ..kernels.raycast import FirstHits, FrontFaces
from ..render.model import Model
from .depth_maps import FlatView, flat_views, render_depth
from .region import outside
from .shown import cut_out

MOST_PHOTOS, ACROSS = 12, 96  # photos that are asked, evenly spread, and pixels along their longest side
DETAIL, WINDOW = 3.0, 5  # standard deviation, of 255, that is more than noise, within so many pixels
FAR = 2.5  # of the median depth of the mesh: what is farther is a background
FEWEST = 100  # pixels below which nothing is said
TRIANGULATED = 3  # training photos that must show a place, before its depth is more than a guess of the field
BEFORE = 0.97  # of a place's distance: what is nearer hides it
MOST_PLACES = 2000  # that are looked for in the training photos


@dataclass(frozen=True)
class Coverage:
    """Shares: `solid`, of the pixels that show something near with detail, how many hit the mesh, None where there are too few such
    pixels; `holes`, of what the mesh fills in the pictures, holes included, how much is holes through which
    the field sees something near; `overlapped`, as `solid`, of those pixels alone whose place three training photos show; `few`,
    how many of the pixels show a place that fewer do."""

    solid: float | None
    holes: float
    overlapped: float | None = None
    few: float = 0.0


def coverage(
    model: Model,
    scene: Scene,
    box_from_world: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray] | None,
    check: Callable[[], None],
    sides: np.ndarray | None = None,
) -> Coverage:
    """How much of the held-out photos (of all where none is held out) a mesh in the normalised frame fills.

    Args:
        bounds, sides: corners (3,) of the region that was asked for and, where it stands at an angle, its sides: what lies beside
            it need not be there.
    """
    chosen = [scene.views[i] for i in scene.test or scene.train]
    chosen = [chosen[i] for i in np.unique(np.linspace(0, len(chosen) - 1, MOST_PHOTOS).round().astype(int))]
    flats = flat_views(chosen, box_from_world, ACROSS)
    poses, mesh, seen = box_poses(chosen, box_from_world), FrontFaces(vertices, faces), []
    for flat in flats:
        check()
        directions = pixel_rays(flat) @ flat.pose[:3, :3].T
        face, _ = mesh.cast(np.broadcast_to(flat.pose[:3, 3], directions.shape), directions)
        hit = (face >= 0).reshape(flat.inside.shape)
        shown = detailed(chosen[flat.photo], scene.mask_mode, flat, poses[flat.photo])
        seen.append((hit, render_depth(model, flat, check).depth, shown))
    there = [depth[hit & (depth > 0) & (depth < FREE)] for hit, depth, _ in seen]
    middle = float(np.median(np.concatenate(there))) if sum(map(len, there)) else np.inf
    filled = missing = 0
    places, hits = [], []
    for flat, (hit, depth, shown) in zip(flats, seen):
        near = flat.inside & (depth > 0) & (depth < min(FAR * middle, FREE)) & within_bounds(flat, depth, bounds, sides)
        solid = near & shown
        places.append(points_of(flat, depth)[solid.reshape(-1)])
        hits.append(hit[solid])
        whole = np.asarray(scipy.ndimage.binary_fill_holes(hit))
        # A pixel beside the mesh may show its outline.
        holes = scipy.ndimage.minimum_filter(whole & ~hit, 3) & near
        filled, missing = filled + int(whole.sum()), missing + int(holes.sum())
    place, hit = np.concatenate(places), np.concatenate(hits)
    holes = missing / max(filled, 1)
    if len(place) < FEWEST:
        return Coverage(None, holes)
    some = np.unique(np.linspace(0, len(place) - 1, MOST_PLACES).round().astype(int))
    trained = [scene.views[i] for i in scene.train]
    by = shown_by(place[some], trained, box_poses(trained, box_from_world), FirstHits(vertices, faces), check)
    enough = by >= min(TRIANGULATED, len(trained))
    overlapped = float(hit[some][enough].mean()) if enough.sum() >= FEWEST else None
    return Coverage(float(hit.mean()), holes, overlapped, float(1 - enough.mean()))


def shown_by(
    places: np.ndarray, views: list[View], poses: np.ndarray, mesh: FirstHits, check: Callable[[], None]
) -> np.ndarray:
    """How many (N,) of the views, with camera-to-box poses (V, 4, 4), show each of the places (N, 3): inside of the picture, and
    nothing of the mesh before it."""
    count = np.zeros(len(places), int)
    for view, pose in zip(views, poses):
        check()
        apart = places - pose[:3, 3]
        with np.errstate(invalid="ignore"):
            pixel = project(view.camera, apart @ pose[:3, :3])
            inside = ((pixel >= 0) & (pixel <= [view.camera.width, view.camera.height])).all(1)
        away = np.linalg.norm(apart[inside], axis=1)
        origins = torch.from_numpy(np.broadcast_to(pose[:3, 3], (len(away), 3)).astype(np.float32))
        directions = torch.from_numpy((apart[inside] / away[:, None]).astype(np.float32))
        count[inside] += mesh.distances(origins, directions).numpy() >= BEFORE * away
    return count


def within_bounds(
    flat: FlatView, depth: np.ndarray, bounds: tuple[np.ndarray, np.ndarray] | None, sides: np.ndarray | None
) -> np.ndarray:
    """Which pixels (H, W) bool of a flat view with depths (H, W) show what lies between two corners, and within the sides of a
    box at an angle."""
    if bounds is None:
        return np.ones(depth.shape, bool)
    points = points_of(flat, depth)
    inside = ((points >= bounds[0]) & (points <= bounds[1])).all(1)
    if sides is not None:
        inside &= outside(sides, *points.T) <= 0
    return inside.reshape(depth.shape)


def points_of(flat: FlatView, depth: np.ndarray) -> np.ndarray:
    """Points (N, 3) of the box frame that the pixels of a flat view with depths (H, W) show, row by row."""
    local = pixel_rays(flat)
    return local / local[:, 2:] * depth.reshape(-1, 1) @ flat.pose[:3, :3].T + flat.pose[:3, 3]


def pixel_rays(flat: FlatView) -> np.ndarray:
    """Directions (N, 3) of the pixels of a flat view, row by row, in its camera's axes."""
    return rays(flat.camera, pixel_centers(flat.camera.width, flat.camera.height).reshape(-1, 2))[0]


def detailed(view: View, mask_mode: str, flat: FlatView, pose: np.ndarray) -> np.ndarray:
    """Which pixels (H, W) bool of a flat view its photo, with the pose (4, 4) of its camera, shows with detail and does not
    cut away."""
    small = view.camera.resized(*looked_at(view.camera))
    photo = resized(read_picture(view.image), small.width, small.height).pixels[..., :3].astype(np.float32).mean(2)
    detail = (
        scipy.ndimage.uniform_filter(photo**2, WINDOW) - scipy.ndimage.uniform_filter(photo, WINDOW) ** 2 > DETAIL**2
    )
    # An outline alone is none on either side.
    detail = scipy.ndimage.minimum_filter(detail, WINDOW, mode="nearest")
    cut = cut_out(view, mask_mode)
    pixel = project(small, pixel_rays(flat) @ flat.pose[:3, :3].T @ pose[:3, :3])
    x, y = (np.clip(np.nan_to_num(p), 0, n - 1).astype(int) for p, n in zip(pixel.T, (small.width, small.height)))
    shown = np.asarray(detail[y, x], bool)
    if cut is not None:
        shown = shown & (nearest(cut.astype(np.uint8), small.width, small.height)[y, x] > 0)
    return shown.reshape(flat.inside.shape)


def looked_at(camera: Camera) -> tuple[int, int]:
    """Width and height of a photo at which detail is looked for: four pixels for each that is asked."""
    share = min(1.0, 2 * ACROSS / max(camera.width, camera.height))
    return max(1, round(share * camera.width)), max(1, round(share * camera.height))
