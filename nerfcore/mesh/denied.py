"""Parts and pieces of a surface that photos deny: what lies on them looks otherwise in each photo.

What cameras see far away, a meadow at the horizon, comes out near them in some fields, as scraps in the air that every
view of the field shows; and ground that few photos show, at a flat angle, at a wrong height, in one with what is right. Photos
tell: their grey values on a true surface go up and down together from place to place. What is lighter towards one side says
little, as much of the world is lighter towards the horizon.
Measured: docs/experiments.md, “Scraps that photos deny”, “Plain scraps”, “Ground at a wrong height”.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import scipy

from ..data.photo import photo_of
from ..data.pixels import training_size
from ..data.scene import View
from ..geometry.cameras import project
from ..images.picture import resized
from ..images.working import nearest, read_image
from ..kernels.raycast import FrontFaces
from ..progress import Reporter
from .triangles import areas, components, cross, unit

SAMPLES = 300  # places on a part, drawn by area
AGREE = 0.18  # correlation of two photos' grey values there, less an even slope, below which they disagree
PLAIN = 1.0  # of 255: standard deviation of grey values on a part up to which photos tell nothing: noise
AROUND = (
    0.4  # mean of that of the pieces beside, below which a piece on which photos disagree goes: edges have good ones
)
# Not tuned.
PIECE, PIECE_SAMPLES = 60.0, 100  # width of a piece, in pixels of photos of `PIECE_SIDE`, and places on it
PIECE_SIDE = 640  # longest side of the photos that a piece is as wide as said in
MOST_PIECES = 4000  # wider ones where a surface has more
MOSTLY = 0.5  # median of the pieces' agreement from which on the photos of a capture tell of pieces
MOST_PHOTOS = 12  # that are asked about a part, evenly spread over those that see it
COMMON = 0.2  # share of the places that two photos must both see
PAIRS = 3  # of photos that must
FACING = 0.1  # cosine of the angle at which a photo must see a place, at least
SIDE = 1024  # longest side of the photos, in pixels
BESIDE = 3  # pixels, of photos of `SIDE`, around what a mask takes away that are not compared
NEAR = 0.02  # of the distance: what a ray meets so close to a place is the place


def denied(
    vertices: np.ndarray, faces: np.ndarray, views: Sequence[View], report: Reporter, mask_mode: str = "empty"
) -> np.ndarray:
    """Triangles (F,) bool on which photos differ more than they agree: connected parts, but the largest, and pieces of the
    rest whose surroundings are hardly better.

    Args:
        vertices: (V, 3) in the world frame, faces (F, 3). views: photos the surface comes from. mask_mode: what black in their
            masks means; what is to be ignored is not compared.
    Raises:
        InputError: a photo or a mask cannot be read. What `report` raises to stop.
    """
    if mask_mode != "ignore":
        views = [replace(view, mask=None) for view in views]
    bad = np.zeros(len(faces), bool)
    for judge in (_denied_parts, _denied_pieces):
        kept = np.flatnonzero(~bad)
        if len(kept):
            bad[kept] = judge(vertices, faces[kept], views, report)
    return bad


def _denied_parts(vertices: np.ndarray, faces: np.ndarray, views: Sequence[View], report: Reporter) -> np.ndarray:
    """Which triangles (F,) bool lie in connected parts, but the largest, on which photos disagree."""
    part = components(faces, len(vertices))
    largest = np.bincount(part, areas(vertices, faces)).argmax()
    others = np.setdiff1d(part, [largest])
    return np.isin(part, others[agreements(vertices, faces, part, others, SAMPLES, views, report) < AGREE])


def _denied_pieces(vertices: np.ndarray, faces: np.ndarray, views: Sequence[View], report: Reporter) -> np.ndarray:
    """Which triangles (F,) bool lie in pieces on which photos disagree, and hardly agree on those beside; none where photos
    agree on less than most pieces: then they or their poses say nothing of single ones."""
    size = PIECE * _pixel_size(vertices[faces].mean(1), views)
    if size <= 0:  # no photo shows any of it
        return np.zeros(len(faces), bool)
    piece = pieces(vertices, faces, size)
    extent = float(np.ptp(vertices[faces].reshape(-1, 3), axis=0).max())
    while piece.max() >= MOST_PIECES and size < extent:  # wider ones join no parts
        size *= 1.5
        piece = pieces(vertices, faces, size)
    agreed = agreements(vertices, faces, piece, np.arange(piece.max() + 1), PIECE_SAMPLES, views, report)
    told = np.isfinite(agreed)
    if not told.any() or np.median(agreed[told]) < MOSTLY:
        return np.zeros(len(faces), bool)
    beside = beside_pieces(faces, piece)
    weight = beside @ told.astype(float)
    around = beside @ np.where(told, agreed, 0) / np.maximum(weight, 1e-9)
    return ((agreed < AGREE) & (weight > 0) & (around < AROUND))[piece]


def pieces(vertices: np.ndarray, faces: np.ndarray, size: float) -> np.ndarray:
    """Number (F,) of the piece of each triangle: connected ones whose middles lie in the same cube of side `size`."""
    _, cube = np.unique(np.floor(vertices[faces].mean(1) / size).astype(int), axis=0, return_inverse=True)
    corner = np.stack([faces.reshape(-1), np.repeat(cube.reshape(-1), 3)], 1)
    _, own = np.unique(corner, axis=0, return_inverse=True)
    return components(own.reshape(-1, 3), len(corner))


def beside_pieces(faces: np.ndarray, piece: np.ndarray) -> scipy.sparse.csr_matrix:
    """How many vertices each of P pieces shares with each other one, (P, P); piece (F,): of each triangle (F, 3)."""
    vertex, of_piece = np.unique(np.stack([faces.reshape(-1), np.repeat(piece, 3)], 1), axis=0).T
    touches = scipy.sparse.csr_matrix((np.ones(len(vertex)), (of_piece, vertex)))
    shared = (touches @ touches.T).tocsr()
    shared.setdiag(0)
    return shared


def _pixel_size(points: np.ndarray, views: Sequence[View]) -> float:
    """Median width of a pixel of photos of `PIECE_SIDE` at some of the points (N, 3) that they show; 0 where they show none."""
    some, sizes = points[:: max(1, len(points) // 500)], []
    for view in views:
        local = (some - view.camera_to_world[:3, 3]) @ view.camera_to_world[:3, :3]
        with np.errstate(all="ignore"):
            place = project(view.camera, local)
            inside = ((place >= 0) & (place < [view.camera.width, view.camera.height])).all(1)
        inside &= (local[:, 2] > 0) | (view.camera.model == "EQUIRECTANGULAR")
        shrunk = training_size(view.camera, PIECE_SIDE)[0] / view.camera.width
        sizes.append(np.linalg.norm(local[inside], axis=1) / (view.camera.pixels_per_radian * shrunk))
    found = np.concatenate(sizes)
    return float(np.median(found)) if len(found) else 0.0


def agreements(
    vertices: np.ndarray,
    faces: np.ndarray,
    part: np.ndarray,
    chosen: np.ndarray,
    samples: int,
    views: Sequence[View],
    report: Reporter,
) -> np.ndarray:
    """How well photos agree (P,) on each of the `chosen` parts (P,), see `agreement`, at that many places on it; part (F,): of
    each triangle."""
    if not len(chosen):
        return np.zeros(0)
    face = np.concatenate(list(_drawn(areas(vertices, faces), part, chosen, samples)))
    places = _on_triangles(vertices[faces[face]])
    grey = _grey_values(vertices, faces, places, face, samples, views, report)
    grey, places = grey.reshape(len(views), len(chosen), samples), places.reshape(len(chosen), samples, 3)
    return np.array([agreement(grey[:, number], places[number]) for number in range(len(chosen))])


def _drawn(area: np.ndarray, part: np.ndarray, chosen: np.ndarray, samples: int) -> Iterator[np.ndarray]:
    """Triangles (samples,) of each of the chosen parts, drawn by area."""
    rng, order = np.random.default_rng(0), np.argsort(part, kind="stable")
    ends = np.searchsorted(part[order], chosen, "right")
    for begin, end in zip(np.searchsorted(part[order], chosen), ends):
        own = order[begin:end]
        total = area[own].sum()
        yield rng.choice(own, samples, p=area[own] / total if total > 0 else None)


def _on_triangles(corners: np.ndarray) -> np.ndarray:
    """A place (N, 3) on each of the triangles (N, 3, 3), drawn evenly."""
    share = np.random.default_rng(1).dirichlet(np.ones(3), len(corners))
    return np.einsum("nk,nkc->nc", share, corners.astype(np.float64))


def agreement(grey: np.ndarray, places: np.ndarray) -> float:
    """Median correlation of two photos on a part whose places (S, 3) have these grey values (N, S) in [0, 255] in them, NaN
    where a photo does not show a place; of what is left of them when an even slope is taken off. NaN where too few photos share
    places, or these are plain."""
    grey = grey[np.isfinite(grey).sum(1) >= COMMON * len(places)].astype(np.float64)
    shown = np.isfinite(grey)
    first, second = np.triu_indices(len(grey), 1)
    both = shown[first] & shown[second]
    enough = both.sum(1) >= COMMON * len(places)
    if enough.sum() < PAIRS:
        return np.nan
    first, second, both = first[enough], second[enough], both[enough]
    away = places - places.mean(0)
    even = np.concatenate([away / max(np.abs(away).max(), 1e-12), np.ones((len(places), 1))], 1)
    squares = (both @ (even[:, :, None] * even[:, None]).reshape(-1, 16)).reshape(-1, 4, 4)
    inverse = np.linalg.pinv(squares, 1e-6, hermitian=True)  # of places in a plane there are many slopes
    left, spread = [], []
    for number in (first, second):
        values = np.where(both, grey[number], 0)
        values = np.where(both, values - (values.sum(1) / both.sum(1))[:, None], 0)
        spread.append(np.sqrt((values**2).sum(1) / both.sum(1)))
        slope = np.einsum("pij,pj->pi", inverse, values @ even)
        left.append(np.where(both, values - slope @ even.T, 0))
    if np.median(np.minimum(*spread)) <= PLAIN:
        return np.nan
    lengths = np.linalg.norm(left[0], axis=1) * np.linalg.norm(left[1], axis=1)
    return float(np.median((left[0] * left[1]).sum(1) / np.maximum(lengths, 1e-9)))


def _grey_values(
    vertices: np.ndarray,
    faces: np.ndarray,
    places: np.ndarray,
    face: np.ndarray,
    samples: int,
    views: Sequence[View],
    report: Reporter,
) -> np.ndarray:
    """Grey values (N, P) in [0, 255] of `places` (P, 3) on triangles `face` (P,), `samples` of each part, in the photos; NaN where
    a photo does not show it, or is not asked."""
    normals = unit(cross(vertices, faces[face]))
    front = FrontFaces(vertices, faces)
    seen = np.zeros((len(views), len(places)), bool)
    for number, view in enumerate(views):
        report.check()
        pose = view.camera_to_world
        toward = places - pose[:3, 3]
        away = np.linalg.norm(toward, axis=1)
        with np.errstate(all="ignore"):
            place = project(view.camera, toward @ pose[:3, :3])
            inside = ((place >= 0) & (place < [view.camera.width, view.camera.height])).all(1)
        inside &= -(normals * toward).sum(1) > FACING * away
        if view.camera.model != "EQUIRECTANGULAR":
            inside &= toward @ pose[:3, 2] > 0
        rows = np.flatnonzero(inside)
        if view.mask is not None and len(rows):
            left = _left(view)
            size = np.array(left.shape[::-1])
            x, y = np.minimum(place[rows] * (size / [view.camera.width, view.camera.height]), size - 1).astype(int).T
            rows = rows[left[y, x]]
        if len(rows):
            origins = np.broadcast_to(pose[:3, 3], (len(rows), 3))
            met, share = front.cast(origins, toward[rows] / away[rows, None])
            weights = np.concatenate([share, 1 - share.sum(1, keepdims=True)], 1)
            reached = np.einsum("nk,nkc->nc", weights, vertices[faces[met]])
            apart = np.linalg.norm(reached - places[rows], axis=1)
            rows = rows[(met >= 0) & (apart < NEAR * away[rows])]
        seen[number, rows] = True
    asked = seen.reshape(len(views), -1, samples)
    for part in range(asked.shape[1]):
        enough = np.flatnonzero(asked[:, part].sum(1) >= COMMON * samples)
        kept = enough[np.unique(np.linspace(0, len(enough) - 1, MOST_PHOTOS).astype(int))] if len(enough) else enough
        asked[np.setdiff1d(np.arange(len(views)), kept), part] = False
    grey = np.full(seen.shape, np.nan, np.float32)
    for number, view in enumerate(views):
        report.check()
        rows = np.flatnonzero(seen[number])
        if not len(rows):
            continue
        width, height = training_size(view.camera, SIDE)
        picture = resized(photo_of(view), width, height).pixels[..., :3].mean(2, dtype=np.float32)
        place = project(view.camera, (places[rows] - view.camera_to_world[:3, 3]) @ view.camera_to_world[:3, :3])
        place = place * [width / view.camera.width, height / view.camera.height] - 0.5
        smooth = scipy.ndimage.gaussian_filter(picture, 1.0)
        grey[number, rows] = scipy.ndimage.map_coordinates(smooth, place[:, ::-1].T, order=1, mode="nearest")
    return grey


def _left(view: View) -> np.ndarray:
    """Which pixels (H, W) bool of a photo, as large as it is compared, its mask leaves, but for those beside what it takes away."""
    assert view.mask is not None
    mask = nearest(read_image(view.mask)[..., 0], *training_size(view.camera, SIDE)) > 127
    return scipy.ndimage.binary_erosion(mask, iterations=BESIDE, border_value=1)
