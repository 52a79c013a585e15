"""Planes of a scene: walls, floors and grounds, found where views confirm depths and continued to where photos do not.

A white wall shows nothing that photos could be compared by, and a field that few cameras saw is off there by more than a
pixel. But where a wall is known at one end, it mostly goes on: a depth that photos do not confirm is moved onto a plane
of the scene, provided that the plane is known close by and the field's depth agrees with it as far as the field is sure.
Where all that is known of a class lies on one plane, with nothing behind it, as of a floor, what label maps give this class lies
on it too.
No wall is a perfect plane: depths are moved onto the mean height above it of what is known around.

Sources: planes by random samples, Schnabel, Wahl and Klein, "Efficient RANSAC for point-cloud shape detection", 2007; floors and
walls from labels, Guo et al., "Neural 3D scene reconstruction with the Manhattan-world assumption", 2022.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from ..data.pixels import VOID
from ..progress import Reporter
from .depth_maps import DepthMap, FlatView, averaged, cosines, normals, pixel_directions

POINTS = 400_000  # that heights are of, and
LOOKED_AT = 40_000  # among which planes are looked for
MOST = 12  # planes
SHARE = 0.01  # of the area known that a plane must hold
GROUND = 0.001  # share of the area known that must face up, and
UPRIGHT = 0.5  # length of the mean of the cameras' directions up, for a ground to be looked for
SHARP = 3.0  # footprints of a pixel by which a point may be wrong: what a soft field takes for a wall may be round
SOFT = 0.5  # share of its spread by which a depth may be wrong, but at least a footprint of a pixel
TRIES, KEPT = 400, 48  # points whose tangent plane is tried, and the best of them that are fitted
WIDTHS = (3.0, 2.0, 1.5, 1.5)  # errors around a plane in which points are its own, from fit to fit
AT_ONCE = 16  # tangent planes that are compared with all points together
BESIDE = 4.0  # errors from a plane that was found, within which no other plane takes points
TILTED = np.cos(np.radians(25))  # between the normal of a point and that of its plane
SMOOTH = 9  # pixels over which normals are averaged: a plain wall's depths are noisy
FEWEST = 20  # points of a plane
CELL, REACH = 8.0, 12.0  # footprints along a cell of a plane, and cells by which a plane goes on beyond its points
MOST_CELLS = 1024  # along a side
AGREES, SPREADS, OFF = (
    0.01,
    1.5,
    0.1,
)  # share by which depths may be off a plane: at least, spreads of the field, at most
FLAT_CLASS = 0.75  # share of what is known of a class that lies on one plane, from which on all of it does
PARTLY = 0.1  # share of what is known of a class that lies on a plane, from which on it may go on there
LABELLED_OFF = 0.5  # share by which the field's depth may be off the plane of its class
BEHIND = 0.01  # share of what is known that may lie behind such a plane: a floor bounds a scene, a table top does not
SMOOTHED = 12.0  # cells over which heights above a plane are averaged
UNEVEN = 2.0  # footprints by which the heights of cells differ, so that many points of one say no more than some
INNER = 7  # pixels a side of the window in which a label map must give the same class, not to be at an outline
STEEPEST = 0.05  # cosine under which a plane is not looked at
FITTED_PIXELS = 3.0  # spread of a depth on a plane, in footprints


@dataclass(frozen=True)
class Known:
    """Points (N, 3) that views confirm, their unit normals (N, 3) towards the camera, the footprint (N,) of a pixel there, by
    how much their depth may be wrong (N,), and their class (N,) uint8, VOID where label maps do not say it."""

    points: np.ndarray
    normals: np.ndarray
    footprint: np.ndarray
    error: np.ndarray
    kind: np.ndarray

    def at(self, rows: np.ndarray | slice) -> Known:
        """Those of some rows: numbers, bool (N,) or a slice."""
        return Known(*(values[rows] for values in vars(self).values()))


@dataclass(frozen=True)
class ScenePlane:
    """Part of a plane: a point of it (3,), its unit normal (3,) towards the cameras, two axes (2, 3) in it, and which cells
    (X, Y) bool it reaches into, of size `cell` from `low` (2,) on along the axes; height (X, Y) of what is known above the
    plane, and which classes (256,) bool lie on it wholly, and which in part, VOID too."""

    point: np.ndarray
    normal: np.ndarray
    axes: np.ndarray
    low: np.ndarray
    cell: float
    reached: np.ndarray
    height: np.ndarray
    classes: np.ndarray
    partly: np.ndarray

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Whether points (N, 3) of the plane lie in what is reached."""
        place = np.floor(((points - self.point) @ self.axes.T - self.low) / self.cell)
        inside = ((place >= 0) & (place < self.reached.shape)).all(1)
        found = np.zeros(len(points), bool)
        found[inside] = self.reached[tuple(place[inside].astype(int).T)]
        return found

    def height_at(self, points: np.ndarray) -> np.ndarray:
        """Height (N,) above the plane near points (N, 3) of it, beyond its cells that of the nearest one."""
        place = np.floor(((points - self.point) @ self.axes.T - self.low) / self.cell)
        return self.height[tuple(place.clip(0, np.array(self.height.shape) - 1).astype(int).T)]


def known_points(
    views: Sequence[FlatView],
    maps: Sequence[DepthMap],
    confirmed: Sequence[np.ndarray],
    labels: Sequence[np.ndarray | None] | None = None,
) -> Known:
    """What views confirm, `confirmed` (H, W) bool of each map, thinned evenly; labels: class (H, W) uint8 of each view's
    pixels, None for views without."""
    step = max(1, -(-sum(int(there.sum()) for there in confirmed) // POINTS))
    parts = []
    for view, map_, there, label in zip(views, maps, confirmed, labels or [None] * len(views)):
        rows, columns = (part[::step] for part in np.nonzero(there & map_.hit))
        normal = averaged(normals(view.camera, map_.depth), SMOOTH)[rows, columns]
        facing = (normal != 0).any(1)
        rows, columns, normal = rows[facing], columns[facing], normal[facing]
        depth = map_.depth[rows, columns]
        local = pixel_directions(view.camera)[rows, columns] * depth[:, None]
        points = local @ view.pose[:3, :3].T + view.pose[:3, 3]
        footprint = depth / view.camera.fx
        error = np.maximum(SOFT * map_.spread[rows, columns], footprint)
        kind = np.full(len(rows), VOID, np.uint8) if label is None else label[rows, columns]
        parts.append((points, normal @ view.pose[:3, :3].T, footprint, error, kind))
    return Known(*(np.concatenate(part) for part in zip(*parts)))


def scene_planes(known: Known, report: Reporter, most: int = MOST) -> list[ScenePlane]:
    """The `most` largest planes among known points, by area: found in what is known well, and reaching as far as the rest
    says."""
    everything, step = known, max(1, -(-len(known.points) // LOOKED_AT))
    known = known.at(np.s_[::step])
    least = SHARE * (known.footprint**2).sum()
    sharp = known.at(known.error <= SHARP * known.footprint)
    area, rng = sharp.footprint**2, np.random.default_rng(0)
    left, found = np.ones(len(area), bool), []
    for _ in range(most):
        report.check()
        if area[left].sum() < least or not left.any():
            break
        best = _largest(sharp, area, left, rng)
        if best is None or area[best].sum() < least:
            break
        point, normal = _fit(sharp, area, best)
        plane = _reaching(known, np.flatnonzero(near_plane(known, point, normal, WIDTHS[-1])), point, normal)
        found.append(replace(plane, height=_heights(everything, plane)))
        left &= ~near_plane(sharp, point, normal, BESIDE)
    return found


def ground(
    known: Known, views: Sequence[FlatView], planes: Sequence[ScenePlane], report: Reporter
) -> ScenePlane | None:
    """The largest plane among what faces up, as most cameras are held, though there is little of it; None without any, or where
    most of it lies on one of the `planes` known."""
    up = -np.mean([view.pose[:3, 1] for view in views], axis=0)
    if np.linalg.norm(up) < UPRIGHT:
        return None
    facing, area = known.normals @ (up / np.linalg.norm(up)) > TILTED, known.footprint**2
    if area[facing].sum() < GROUND * area.sum():
        return None
    found = scene_planes(known.at(facing), report, 1)
    if not found:
        return None
    on = np.flatnonzero(near_plane(known, found[0].point, found[0].normal, WIDTHS[-1]))
    own = known.at(on)
    if any(near_plane(own, plane.point, plane.normal, BESIDE).mean() > 0.5 for plane in planes):
        return None
    return replace(found[0], partly=partly(known, on))


def _largest(known: Known, area: np.ndarray, left: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """The points, of those that are left, on the largest plane that was met; None where there is none."""
    rows, best = np.flatnonzero(left), None
    known, area = known.at(rows), area[rows]
    starts = rng.choice(len(rows), min(TRIES, len(rows)), replace=False, p=area / area.sum())
    held = _area_near(known, area, starts)
    for start in starts[np.argsort(-held, kind="stable")[:KEPT]]:
        point, normal = known.points[start], known.normals[start]
        for width in WIDTHS:
            on = np.flatnonzero(near_plane(known, point, normal, width))
            if len(on) < FEWEST:
                break
            point, normal = _fit(known, area, on)
        if len(on) >= FEWEST and (best is None or area[on].sum() > area[best].sum()):
            best = on
    return None if best is None else rows[best]


def _area_near(known: Known, area: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """The area (S,) of the points near the tangent plane of each of some points, by number (S,); in single precision."""
    points, normals, limit = (
        values.astype(np.float32) for values in (known.points, known.normals, WIDTHS[0] * known.error)
    )
    found = []
    for part in np.array_split(starts, -(-len(starts) // AT_ONCE)):
        off = points @ normals[part].T - np.einsum("ij,ij->i", points[part], normals[part])
        near = (np.abs(off, out=off) < limit[:, None]) & (normals @ normals[part].T > TILTED)
        found.append(area.astype(np.float32) @ near)
    return np.concatenate(found)


def near_plane(known: Known, point: np.ndarray, normal: np.ndarray, width: float) -> np.ndarray:
    """Which points lie within `width` times their error of a plane and face as it does."""
    off = np.abs((known.points - point) @ normal)
    return (off < width * known.error) & (known.normals @ normal > TILTED)


def _fit(known: Known, area: np.ndarray, on: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A point and the normal of the plane through points, by least squares weighted with their area over their error."""
    weight = area[on] / known.error[on] ** 2
    middle = np.average(known.points[on], axis=0, weights=weight)
    around = (known.points[on] - middle) * np.sqrt(weight)[:, None]
    normal = np.linalg.svd(around, full_matrices=False)[2][2]
    return middle, normal * np.sign(normal @ known.normals[on].mean(0) or 1.0)


def _reaching(known: Known, on: np.ndarray, point: np.ndarray, normal: np.ndarray) -> ScenePlane:
    """The plane through points, as far as it reaches; its heights are 0."""
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(normal, first)])
    place = (known.points[on] - point) @ axes.T
    cell = max(CELL * float(np.median(known.footprint[on])), float(np.ptp(place, axis=0).max()) / MOST_CELLS)
    rim = int(REACH) + 1
    low = place.min(0) - rim * cell
    index = ((place - low) / cell).astype(int)
    there = np.zeros(index.max(0) + rim + 1, bool)
    there[tuple(index.T)] = True
    reached = np.asarray(scipy.ndimage.distance_transform_edt(~there)) <= REACH
    flat = _flat_classes(known, point, normal)
    return ScenePlane(point, normal, axes, low, cell, reached, np.zeros(there.shape), flat, partly(known, on))


def bounds(known: Known, point: np.ndarray, normal: np.ndarray) -> bool:
    """Whether nothing that is known lies behind a plane."""
    area, off = known.footprint**2, (known.points - point) @ normal / known.error
    return bool(area[off < -BESIDE].sum() <= BEHIND * area.sum())


def _flat_classes(known: Known, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Which classes (256,) bool have nearly all of their known area within the errors of a plane behind which nothing lies."""
    if not bounds(known, point, normal):
        return np.zeros(256, bool)
    area, off = known.footprint**2, (known.points - point) @ normal / known.error
    own = np.bincount(known.kind, area * (off < BESIDE), 256)
    flat = own >= FLAT_CLASS * np.maximum(np.bincount(known.kind, area, 256), FEWEST * np.median(area))
    flat[VOID] = False
    return flat


def partly(known: Known, on: np.ndarray) -> np.ndarray:
    """Which classes (256,) bool have a good part of their known area among the points `on` of a plane; VOID may have."""
    area = known.footprint**2
    found = np.bincount(known.kind[on], area[on], 256)
    some = (found > 0) & (found >= PARTLY * np.bincount(known.kind, area, 256))
    some[VOID] = True
    return some


def _heights(known: Known, plane: ScenePlane) -> np.ndarray:
    """Mean height (X, Y) above a plane of what is known beside it, around each of its cells, weighted as in `_fit` but for
    cells that hold much, as a paving that photos know well beside a meadow: none counts more than one whose height is known
    to `UNEVEN` footprints. Cells far from all that is known have the height of the nearest."""
    near = np.flatnonzero(near_plane(known, plane.point, plane.normal, BESIDE))
    away = known.points[near] - plane.point
    place = np.floor((away @ plane.axes.T - plane.low) / plane.cell)
    inside = ((place >= 0) & (place < plane.reached.shape)).all(1)
    near, away, index = near[inside], away[inside], tuple(place[inside].astype(int).T)
    weight = known.footprint[near] ** 2 / known.error[near] ** 2
    total, amount = np.zeros(plane.reached.shape), np.zeros(plane.reached.shape)
    np.add.at(total, index, weight * (away @ plane.normal))
    np.add.at(amount, index, weight)
    bounded = 1 / (1 + UNEVEN**2 * amount)
    total, amount = (
        scipy.ndimage.gaussian_filter(bounded * grid, SMOOTHED, mode="constant") for grid in (total, amount)
    )
    known_there = amount > 1e-6 * amount.max()
    nearest = np.asarray(
        scipy.ndimage.distance_transform_edt(~known_there, return_distances=False, return_indices=True)
    )
    return np.where(known_there, total / np.where(known_there, amount, 1), 0)[tuple(nearest)]


def away_from_outlines(labels: np.ndarray) -> np.ndarray:
    """Where (H, W) bool a label map (H, W) gives one class all around."""
    return np.asarray(scipy.ndimage.maximum_filter(labels, INNER) == scipy.ndimage.minimum_filter(labels, INNER))


def on_scene_planes(
    view: FlatView,
    field: DepthMap,
    sure: np.ndarray,
    map_: DepthMap,
    planes: list[ScenePlane],
    labels: np.ndarray | None = None,
) -> tuple[DepthMap, np.ndarray]:
    """A depth map whose depths that are not `sure` (H, W) bool lie on a plane of the scene, where the field's own depth
    agrees with one: the one closest to it. With the plane of its class it need not agree much, however far it reaches.
    And which depths (H, W) bool lie on the plane of their class, away from outlines: a label map may have a wire thinner than
    it is.

    Args:
        field: the field's depths and spreads where it is not sure; map_: what becomes of them without such a plane.
        labels: class (H, W) uint8 of each pixel.
    """
    rows, columns = np.nonzero(field.hit & ~sure)
    ray = pixel_directions(view.camera)[rows, columns] @ view.pose[:3, :3].T
    eye, depth = view.pose[:3, 3], field.depth[rows, columns]
    allowed = np.clip(SPREADS * field.spread[rows, columns] / depth, AGREES, OFF)
    moved, by_class = np.zeros(len(rows), np.float32), np.zeros(len(rows), bool)
    kind = np.full(len(rows), VOID, np.uint8) if labels is None else labels[rows, columns]
    for plane in planes:
        towards, of_class = np.negative(ray @ plane.normal), plane.classes[kind]
        above, facing = (eye - plane.point) @ plane.normal, towards > STEEPEST
        reached = np.where(facing, above / np.where(facing, towards, 1), 0)
        limit = np.where(of_class & (moved == 0), LABELLED_OFF, allowed)
        close = np.flatnonzero((np.abs(reached - depth) < limit * depth) & (reached > 0))
        place = eye + ray[close] * reached[close, None]
        there = plane.holds(place) | of_class[close]
        close, place = close[there], place[there]
        reached = (above - plane.height_at(place)) / towards[close]
        off = np.abs(reached - depth[close]) / depth[close]
        better = off < limit[close]
        close = close[better]
        moved[close], allowed[close], by_class[close] = reached[better], off[better], of_class[close]
    new, spread = map_.depth.copy(), map_.spread.copy()
    found = moved > 0
    new[rows[found], columns[found]] = moved[found]
    spread[rows[found], columns[found]] = FITTED_PIXELS / view.camera.fx * moved[found]
    named = np.zeros(new.shape, bool)
    named[rows, columns] = by_class
    if labels is not None:
        named &= away_from_outlines(labels)
    return replace(map_, depth=new, spread=spread, cosine=cosines(view.camera, new)), named
