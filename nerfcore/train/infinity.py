"""Whether photos show something infinitely far away, as the sky: it has the same colour in the same direction from everywhere,
no points of the reconstruction around it, and in captures from inside it is above the horizon and has no other name."""

from __future__ import annotations

import re

import numpy as np
import scipy

from ..data.box import looks_inward
from ..data.photo import photo_of
from ..data.pixels import training_size
from ..data.scene import Scene, View
from ..geometry.cameras import pixel_centers, project, rays
from ..images.picture import resized
from ..images.working import nearest, read_label

# Measured: docs/experiments.md, “Is there a sky?”.
MOST_PHOTOS, SIDE = 40, 120  # that are looked at, and their longest side in pixels
ALIKE = 4.0  # standard deviation of colours, of 255
BETWEEN = 0.5  # share of what looks infinitely far that may lie between points: plain floors and walls do, sky mostly does not
HIGHER = 3.0  # times as often directions above the horizon must look infinitely far as below: “White walls below the horizon”
# Not tuned: the next two.
CELL, CELL_PIXELS = 1.0, 3.0  # degrees, and pixels at least, in which directions count as the same
CAMERAS = 3  # that must look there
FEWEST = 20  # points in a photo, from which on they have a hull
# Words in names of classes that may be infinitely far away, in the languages of Blender's users, and of what is no thing.
WORDS = """
sky skies cloud clouds himmel wolke wolken ciel nuage nuages cielo nube nubes nuvola nuvole céu nuvem nuvens hemel lucht niebo
chmury небо облака gökyüzü trời 天空 天 空 雲 云 하늘 background backdrop hintergrund fond fondo sfondo fundo tło фон 背景 배경
void nothing none unknown unlabeled unlabelled other misc outside exterior
"""
SKY = frozenset(WORDS.split())


def share_at_infinity(scene: Scene) -> float:
    """Share of the training photos' pixels that lie infinitely far away: at least `CAMERAS` cameras look that way, and what
    all of them see there has one colour. Walls with a texture have several; plain ones have light that changes along them.
    Where that is too little, points tell: a plain floor lies between points of its joints and of what stands on it. Where cameras
    look around, so do names, as a ceiling's is none of a sky, and the horizon: white walls of a room are alike below it as well.
    The world's z axis is up.
    """
    chosen = np.unique(np.linspace(0, len(scene.train) - 1, MOST_PHOTOS).round().astype(int))
    views = [scene.views[scene.train[i]] for i in chosen]
    seen = [_colored_directions(view) for view in views]
    scales = [min(1.0, SIDE / max(view.camera.width, view.camera.height)) for view in views]
    focal = np.median([view.camera.pixels_per_radian * scale for view, scale in zip(views, scales)])
    directions, colors = (np.concatenate(part) for part in zip(*seen))
    photo = np.repeat(np.arange(len(seen)), [len(part) for part, _ in seen])
    usable = np.isfinite(directions).all(1)
    directions, colors, photo = directions[usable], colors[usable], photo[usable]
    side = max(np.radians(CELL), CELL_PIXELS / focal)
    _, cell = np.unique(np.floor(directions / side).astype(int), axis=0, return_inverse=True)
    pixels = np.bincount(cell)
    cameras = np.bincount(np.unique(np.stack([cell, photo], 1), axis=0)[:, 0])
    variance = np.zeros(len(pixels))
    for channel in colors.T:
        mean = np.bincount(cell, channel) / pixels
        variance += np.bincount(cell, (channel - mean[cell]) ** 2) / pixels / 3
    looked = (cameras >= CAMERAS)[cell]
    far = looked & (variance < ALIKE**2)[cell]
    around = not looks_inward(scene.views)
    if around:
        far &= ~np.concatenate([named_things(view, scene) for view in views])[usable]
    between = np.concatenate([between_points(view, scene.points.xyz) for view in views])[usable]
    if (far & between).sum() > BETWEEN * far.sum():
        return 0.0
    up = directions[:, 2] > 0
    above, below = (far[half].sum() / max(int(looked[half].sum()), 1) for half in (up, ~up))
    if around and above < HIGHER * below:
        return 0.0
    return float(far.mean())


def _colored_directions(view: View) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (N, 3) in the world of a small version of a photo, NaN where the lens does not see, and its colours
    (N, 3) in [0, 255]."""
    camera = view.camera.resized(*training_size(view.camera, SIDE))
    small = resized(photo_of(view), camera.width, camera.height).pixels[..., :3].reshape(-1, 3)
    directions, _ = rays(camera, pixel_centers(camera.width, camera.height).reshape(-1, 2))
    directions = directions @ view.camera_to_world[:3, :3].T
    return directions / np.linalg.norm(directions, axis=1, keepdims=True), small.astype(np.float64)


def named_things(view: View, scene: Scene) -> np.ndarray:
    """Which pixels (N,) bool of a small version of a photo its label map gives a class that is no sky by its name."""
    camera = view.camera.resized(*training_size(view.camera, SIDE))
    if view.label is None:
        return np.zeros(camera.width * camera.height, bool)
    named = [kind for kind in scene.classes if kind.id != scene.ignore_id]
    things = [kind.id for kind in named if not SKY & set(re.findall(r"\w+", kind.name.casefold()))]
    return np.isin(nearest(read_label(view.label), camera.width, camera.height), things).reshape(-1)


def between_points(view: View, points: np.ndarray, longest: float = np.inf) -> np.ndarray:
    """Which pixels (N,) bool of a small version of a photo lie in the convex hull of those of the points (P, 3) that are in
    its picture; `longest`: only between points that are no farther from each other, as a share of its width."""
    camera = view.camera.resized(*training_size(view.camera, SIDE))
    local = (points - view.camera_to_world[:3, 3]) @ view.camera_to_world[:3, :3]
    with np.errstate(invalid="ignore"):
        pixel = project(camera, local)
        inside = ((pixel >= 0) & (pixel < [camera.width, camera.height])).all(1)
    if camera.model != "EQUIRECTANGULAR":
        inside &= local[:, 2] > 0
    centers = pixel_centers(camera.width, camera.height).reshape(-1, 2)
    if inside.sum() < FEWEST:
        return np.zeros(len(centers), bool)
    seen = pixel[inside]
    triangles = scipy.spatial.Delaunay(seen, qhull_options="QJ")  # they may lie in a line
    corners = seen[triangles.simplices]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    triangle = triangles.find_simplex(centers)
    return (triangle >= 0) & (edges[triangle] <= longest * camera.width)
