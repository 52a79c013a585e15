"""Walls without texture: planes found where photos do show something, and continued over what they show as plain.

Correlation knows no contrast: the faint shades of a white wall agree at many depths, in photos and in a field that was trained on
them. All that tells where the wall is are its outlines, what hangs on it, and that walls are planes, mostly at right angles. So
planes are put through confirmed points of places that are not plain alone, turned to common directions where their points permit
it, and sought along these directions where only edges show a wall. A plain region of a picture lies on such a plane where the
plane holds part of what is known around the region, and where other photos are plain where they would show the region. Where
cameras surround what they look at, it does so only behind all else, and where a label map gives it the class of what is known there.

Source: planes at right angles, Coughlan and Yuille, "Manhattan world", 1999.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from ..data.pixels import VOID
from ..images.texture import left_of_slopes
from ..progress import Reporter
from .depth_maps import DepthMap, FlatView, cosines, pixel_directions
from .scene_planes import BESIDE, FITTED_PIXELS, STEEPEST, WIDTHS, Known, bounds, near_plane, partly, scene_planes

REACH = 4  # pixels that a window reaches from its middle, as patches that are compared do (kernels/patches.py)
# Standard deviation of grey, less its slope, from which a window shows something: rounding makes 0.3 to 0.5.
SHOWS = 0.6 / 255
RIGHT = np.radians(6)  # by which a plane may be turned to stand at right angles to others
STAYS = 0.7  # share of a plane's points that must lie on it when it is turned
BIN, LOCAL, PEAK, EDGES = 3.0, 21, 3.0, 0.003  # an offset's bin in footprints; bins around it; times these, and of all
WITHIN = (0.1, 99.9)  # percentiles of offsets that are looked at
PLAIN = 0.02  # share of what pictures show, from which on walls are looked for
REGION = 0.002  # share of a picture that a plain region must have
RIM = 6  # pixels around a region in which what is known tells of it
ROUNDS = 2  # a third changes nothing
HELD, FEWEST = 0.08, 30  # share of what is known there that the region's plane must hold, and pixels
OFF = 0.3  # share by which the field's depth of a plain place may be wrong
ASKED, EVERY = 5, 4  # other views that are asked whether a region is plain, and at every how many-th pixel
DENIED = 0.5  # share of what they see of a region that may not be plain there
AGREED, SAME = 0.5, 0.005  # share of a region that others must have on the same wall, and of its depth
HIDES = 0.03  # share of a depth by which what hides a place is nearer


@dataclass(frozen=True)
class Wall:
    """A plane: a point (3,) of it and its unit normal (3,) towards the cameras; classes (256,) bool: which of them may lie on it,
    None for all."""

    point: np.ndarray
    normal: np.ndarray
    classes: np.ndarray | None = None

    def depth(self, view: FlatView, ray: np.ndarray) -> np.ndarray:
        """Depth (H, W) along the rays (H, W, 3) of a view, 0 where the wall does not face them."""
        towards = np.negative(ray @ self.normal)
        facing = towards > STEEPEST
        depth = ((view.pose[:3, 3] - self.point) @ self.normal) / np.where(facing, towards, 1)
        return np.where(facing & (depth > 0), depth, 0)


@dataclass(frozen=True)
class Picture:
    """What is known of one picture: its view and depths, and which pixels (H, W) bool have a depth that photos confirm, `sure`,
    which are plain, and which are plain or beside such pixels, `even`."""

    view: FlatView
    field: DepthMap
    sure: np.ndarray
    plain: np.ndarray
    even: np.ndarray


def picture_of(view: FlatView, field: DepthMap, sure: np.ndarray, plain: np.ndarray) -> Picture:
    """What is known of a picture: its depths, and which pixels (H, W) bool have one that photos confirm and are plain."""
    return Picture(view, field, sure, plain, np.asarray(scipy.ndimage.binary_dilation(plain, iterations=REACH)))


def plain_places(grey: np.ndarray) -> np.ndarray:
    """Where (H, W) bool a picture (H, W) in [0, 1] shows nothing but an even slope of grey."""
    return left_of_slopes(grey, 2 * REACH + 1) < SHOWS**2


def any_plain(pictures: list[Picture]) -> bool:
    """Whether enough of what pictures show is plain for walls to be looked for."""
    plain, all_ = (sum(int((p.field.hit & (p.plain | whole)).sum()) for p in pictures) for whole in (False, True))
    return plain > PLAIN * all_


def walls(known: Known, report: Reporter) -> list[Wall]:
    """Walls among points that views confirm, at right angles where the points permit it, and those that only edges show."""
    found = scene_planes(known, report)
    found.sort(key=lambda plane: -plane.reached.sum() * plane.cell**2)
    axes: list[np.ndarray] = []
    made = []
    for plane in found:
        wall = _turned(known, Wall(plane.point, plane.normal), axes)
        made.append(wall)
        if len(axes) < 3 and all(abs(wall.normal @ axis) < 1e-6 for axis in axes):
            axes.append(wall.normal)
    return made + _from_edges(known, made, axes)


def backdrops(known: Known, made: list[Wall]) -> list[Wall]:
    """Those of the walls behind which nothing lies, for classes only of which a good part is known to lie there: behind what
    cameras surround, a thing that has no class may be as plain as what it stands before."""
    found = []
    for wall in made:
        on = np.flatnonzero(near_plane(known, wall.point, wall.normal, BESIDE))
        classes = partly(known, on) & (np.arange(256) != VOID)
        if classes.any() and bounds(known, wall.point, wall.normal):
            found.append(replace(wall, classes=classes))
    return found


def _turned(known: Known, wall: Wall, axes: list[np.ndarray]) -> Wall:
    """A wall parallel or at right angles to axes (3,) that it nearly is so to, if most of its points still lie on it."""
    normal = wall.normal
    for axis in axes:
        along = float(normal @ axis)
        if abs(along) > np.cos(RIGHT):
            normal = axis * np.sign(along)
            break
        if abs(along) < np.sin(RIGHT):
            normal = normal - along * axis
            normal /= np.linalg.norm(normal)
    area = known.footprint**2
    on = near_plane(known, wall.point, wall.normal, WIDTHS[1])
    if not on.any():
        return wall
    point = np.average(known.points[on], axis=0, weights=area[on] / known.error[on] ** 2)
    still = near_plane(known, point, normal, WIDTHS[1])
    if area[still].sum() < STAYS * area[on].sum():
        return wall
    return Wall(np.average(known.points[still], axis=0, weights=area[still] / known.error[still] ** 2), normal)


def _from_edges(known: Known, made: list[Wall], axes: list[np.ndarray]) -> list[Wall]:
    """Walls at right angles to an axis (3,) where more points lie than beside them: edges, whatever normal they seem to have."""
    area, width = known.footprint**2, BIN * float(np.median(known.footprint)) if len(known.footprint) else 1.0
    more = []
    for axis in axes:
        offset = known.points @ axis
        low, high = np.percentile(offset, WITHIN) + [-width, width]
        index = np.where((offset > low) & (offset < high), (offset - low) / width + 1, 0).astype(int)
        total = np.bincount(index, area)
        total[0] = 0  # far away
        usual = scipy.ndimage.median_filter(total, LOCAL)
        peak = (total == scipy.ndimage.maximum_filter(total, LOCAL)) & (total > PEAK * usual)
        for number in np.flatnonzero(peak & (total > EDGES * area.sum())):
            on = index == number
            point = axis * float(np.average(offset[on], weights=area[on]))
            if any(abs(w.normal @ axis) > 1 - 1e-6 and abs((point - w.point) @ axis) < 2 * width for w in made):
                continue
            more.append(Wall(point, axis * np.sign((known.normals[on] @ axis * area[on]).sum() or 1.0)))
    return more


def on_walls(
    pictures: list[Picture],
    around: Sequence[Sequence[int]],
    made: list[Wall],
    maps: list[DepthMap],
    labels: Sequence[np.ndarray | None],
    report: Reporter,
) -> list[DepthMap]:
    """Depth maps whose plain regions lie on walls: of those that may hold a region, on the one closest to the field. In a second
    round those also hold it on which other pictures have what it shows.

    Args:
        around: of each picture, numbers of others that show much the same.
        maps: what becomes of their depths otherwise; labels: class (H, W) uint8 of each pixel.
    """
    if not made:
        return maps
    found: list[DepthMap] = []
    for _ in range(ROUNDS):
        before, found = found, []
        for number, (map_, label) in enumerate(zip(maps, labels)):
            report.check()
            found.append(_on_walls(pictures, number, around[number], made, map_, label, before))
    return found


def _on_walls(
    pictures: list[Picture],
    number: int,
    around: Sequence[int],
    made: list[Wall],
    map_: DepthMap,
    label: np.ndarray | None,
    found: list[DepthMap],
) -> DepthMap:
    """One of the maps; found: all of them after the first round."""
    own = pictures[number]
    ray = pixel_directions(own.view.camera) @ own.view.pose[:3, :3].T
    others = [(pictures[other], found[other] if found else None) for other in around[:ASKED]]
    depths = [wall.depth(own.view, ray) for wall in made]
    depth, best = map_.depth.copy(), np.full(map_.depth.shape, OFF)
    for part, region, grown, kind in _regions(own, label):
        field, near = own.field.depth[part], best[part]
        ring = scipy.ndimage.binary_dilation(region, iterations=RIM) & own.sure[part]
        for there in (all_[part] for wall, all_ in zip(made, depths) if wall.classes is None or wall.classes[kind]):
            on = ring & (np.abs(there - field) < WIDTHS[0] / own.view.camera.fx * there)
            held = on.sum() >= max(FEWEST, HELD * ring.sum())
            if not held and not found:
                continue
            off = np.abs(there - field) / np.where(grown, field, 1)
            taken = grown & (there > 0) & (off < near)
            sample = np.flatnonzero(region & taken)[::EVERY]
            points = own.view.pose[:3, 3] + ray[part].reshape(-1, 3)[sample] * there.reshape(-1, 1)[sample]
            same, shows = _asked(points, others)
            if shows <= DENIED and (held or same > AGREED):
                depth[part][taken], near[taken] = there[taken], off[taken]
    moved = best < OFF
    spread = np.where(moved, FITTED_PIXELS / own.view.camera.fx * depth, map_.spread)
    return replace(map_, depth=depth, spread=spread.astype(np.float32), cosine=cosines(own.view.camera, depth))


def _regions(
    own: Picture, label: np.ndarray | None
) -> Iterator[tuple[tuple[slice, slice], np.ndarray, np.ndarray, int]]:
    """Connected plain regions of one class each: the part of the picture that holds a region and its rim, its pixels there,
    those together with what lies as close to them as windows reach and is not sure, and the class, VOID without labels."""
    free = own.field.hit & ~own.sure
    for kind in [None] if label is None else np.unique(label[free & own.plain]):
        of_kind = free if kind is None else free & (label == kind)
        numbered, _ = scipy.ndimage.label(of_kind & own.plain)
        sizes = np.bincount(numbered.ravel())
        for index, box in enumerate(scipy.ndimage.find_objects(numbered), 1):
            if sizes[index] >= REGION * numbered.size:
                rows, columns = (slice(max(0, side.start - RIM), side.stop + RIM) for side in box)
                region = numbered[rows, columns] == index
                grown = scipy.ndimage.binary_dilation(region, iterations=REACH) & of_kind[rows, columns]
                yield (rows, columns), region, grown, VOID if kind is None else int(kind)


def _asked(points: np.ndarray, others: list[tuple[Picture, DepthMap | None]]) -> tuple[float, float]:
    """Of what other pictures see of points (N, 3), the share that they have there after the first round; and of what nothing
    nearer hides from them, the share where they show something."""
    asked, same, visible, shows = 0, 0, 0, 0
    for other, found in others:
        camera, pose = other.view.camera, other.view.pose
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        local = local[local[:, 2] > 0]
        column, row = np.floor(local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]).T
        inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        place, depth = (row[inside].astype(int), column[inside].astype(int)), local[inside, 2]
        open_ = ~(other.field.hit[place] & (other.field.depth[place] < (1 - HIDES) * depth))
        asked, visible = asked + len(depth), visible + int(open_.sum())
        shows += int((~other.even[place] & open_).sum())
        if found is not None:
            same += int((np.abs(found.depth[place] - depth) < SAME * depth).sum())
    return same / max(asked, 1), shows / max(visible, 1)
