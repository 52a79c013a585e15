"""Depth maps of the field moved to where the photos agree best.

A field of few steps is soft: its surfaces are right to a few pixels, and what its views share is wrong in all of them, so
that fusing cannot average it away. Photos tell more where they have texture (kernels/patches.py); elsewhere the field's
depth stays, or gives way to the plane through what is known around it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy
import torch

from ..data.pixels import VOID, PixelStore
from ..geometry.cameras import pixel_centers, project, rays
from ..kernels.depth_arrays import FREE, MapArrays
from ..kernels.patch_sums import quads
from ..kernels.patches import refine
from ..progress import Reporter
from .completion import moved_as_around
from .depth_maps import (
    DepthMap,
    FlatView,
    averaged,
    certain_slopes,
    confirmed_maps,
    cosines,
    map_arrays,
    neighbours,
    normals,
)
from .plane_starts import PLANES, from_planes
from .planes import with_planes
from .scene_planes import away_from_outlines, ground, known_points, on_scene_planes, scene_planes
from .sky import FAR, backdrop, confirmed_share, farthest, labels_tell, named_things, nothing
from .walls import any_plain, backdrops, on_walls, picture_of, plain_places, walls

VIEWS = 5  # neighbours whose photos are compared
LEAST, GAIN = 0.6, 0.05  # correlation that is believed, and by how much it must exceed that of the field's depth
FIELD_AGREES, FIELD_RETURNS = 0.05, 6.0  # share and pixels to which views must confirm depths of the field in holes
SMOOTH = (5, 21)  # pixels over which normals are averaged: what is curved needs few, what the field has in steps many
SURE = 2.0  # pixels: the spread of a depth that photos confirm
LUMA = np.array([0.299, 0.587, 0.114], np.float32)


def grey_pictures(views: list[FlatView], store: PixelStore, report: Reporter) -> list[np.ndarray]:
    """What each flat view shows of its photo, (H, W) float32 grey in [0, 1]."""
    made = []
    rgba, first = store.rgba.cpu().numpy(), store.first.cpu().numpy()
    for number, view in enumerate(views):
        report.progress(number / len(views))
        photo, flat = store.cameras[view.photo], view.camera
        pixels = rgba[first[view.photo] : first[view.photo + 1], :3].reshape(photo.height, photo.width, 3)
        grey = pixels @ (LUMA / 255)
        shrunk = flat.fx / photo.pixels_per_radian  # what is made smaller is smoothed before
        if shrunk < 0.7:
            grey = scipy.ndimage.gaussian_filter(grey, 0.5 / shrunk)
        place = np.nan_to_num(photo_pixels(view, store), nan=-1.0) - 0.5
        shown = scipy.ndimage.map_coordinates(grey, place[:, ::-1].T, order=1, mode="nearest")
        made.append(shown.reshape(flat.height, flat.width).astype(np.float32))
    return made


def photo_pixels(view: FlatView, store: PixelStore) -> np.ndarray:
    """Pixel coordinates (H·W, 2) in its photo of what a flat view shows; NaN where the lens does not see."""
    turn = store.rays.rotation[view.photo].cpu().numpy().T @ view.pose[:3, :3]
    directions, _ = rays(view.camera, pixel_centers(view.camera.width, view.camera.height).reshape(-1, 2))
    return project(store.cameras[view.photo], directions @ turn.T)


def label_picture(view: FlatView, store: PixelStore) -> np.ndarray | None:
    """Class (H, W) uint8 that the label map of its photo gives each pixel of a flat view, VOID for none; None without a
    label map."""
    camera, shape = store.cameras[view.photo], (view.camera.height, view.camera.width)
    begin, end = int(store.first[view.photo]), int(store.first[view.photo + 1])
    label = store.label[begin:end].cpu().numpy().reshape(camera.height, camera.width)
    if (label == VOID).all():
        return None
    x, y = np.nan_to_num(photo_pixels(view, store)).clip(0, [camera.width - 1, camera.height - 1]).astype(int).T
    return label[y, x].reshape(shape)


def refined_maps(
    views: list[FlatView],
    maps: list[DepthMap],
    store: PixelStore,
    device: torch.device,
    report: Reporter,
    *,
    outward: bool = False,
) -> tuple[MapArrays, float]:
    """Confirmed maps (see `depth_maps.confirmed_maps`) whose depths photos have moved, from the field's or from a plane of the
    scene (plane_starts.py), and the share of their depths that views do confirm. Where views do not confirm a moved depth, the
    field's is asked again, the plane through what is known around (planes.py), or that of a wall or floor that goes on from
    elsewhere (scene_planes.py); where label maps say that it is this floor, one view suffices. Where they do not confirm that either, but roughly the field's own depth, moved as the
    known ones around were (completion.py), it is taken, as far away as photos confirm depths. What label maps say is nothing,
    and backdrops without the name of a thing (sky.py), have an unknown depth. `outward`: cameras look around, so that what is plain
    is mostly a wall (walls.py) and not the thing that they surround; else it is one only where label maps tell.
    """
    arrays = map_arrays(views, maps, device)
    greys = grey_pictures(views, store, report)
    plain = [plain_places(grey) for grey in greys]
    photos = torch.cat([quads(torch.from_numpy(grey)) for grey in greys]).to(arrays.depth.device)
    around = neighbours(views, maps)
    near = [torch.tensor(others[:VIEWS], dtype=torch.int32, device=photos.device) for others in around]
    moved, agreed = [], []
    for number, (view, map_) in enumerate(zip(views, maps)):
        report.progress(number / len(views))
        depth, score = where_photos_agree(photos, view, map_, arrays, number, near[number])
        moved.append(_with_depth(view, map_, depth.cpu().numpy().reshape(map_.depth.shape)))
        agreed.append(score.cpu().numpy().reshape(map_.depth.shape))

    def confirmed_moves(moved: list[DepthMap]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Which depths (H, W) bool of moved maps views confirm, and which of these photos have moved."""
        # What one other view has moved to the same place as well may be wrong, and planes are put through what is known here.
        kept = hits(confirmed_maps(views, moved, device, report, around, few_suffice=False), maps)
        return kept, [a & (new.depth != old.depth) & ~even for a, old, new, even in zip(kept, maps, moved, plain)]

    _, sure = confirmed_moves(moved)
    sharp = [with_spread(*parts) for parts in zip(views, maps, moved, sure)]
    labels = [label_picture(view, store) for view in views]
    left_out = [None if label is None else label == VOID for label in labels]
    things: list[np.ndarray | None] = [None] * len(views)
    if labels_tell(sure, left_out):
        things = named_things(labels, *confirmed_share([map_.hit for map_ in maps], sure, labels))
    points = known_points(views, sharp, sure, things)
    starts = scene_planes(points, report)[:PLANES]
    floor = ground(points, views, starts, report)
    starts = starts if floor is None else [*starts, floor]
    moved = from_planes(photos, views, moved, agreed, sure, arrays, near, starts, things, report)
    kept, sure = confirmed_moves(moved)
    told = labels_tell(sure, left_out)
    confirmed, usual = confirmed_share([map_.hit for map_ in maps], sure, labels)
    labels = named_things(labels, confirmed, usual)
    known, fields = [], []
    for number, (view, old, new, label, unnamed) in enumerate(zip(views, maps, moved, labels, left_out)):
        safe = sure[number]
        depth = np.where(safe, new.depth, old.depth)
        empty = nothing(unnamed, safe, usual) if told and unnamed is not None else np.zeros(depth.shape, bool)
        depth, safe = np.where(empty & old.hit, 0, depth), safe & ~empty
        sure[number] = safe
        behind = backdrop(depth, safe)
        if label is not None:
            behind &= label == VOID
        depth = np.where(behind, 0, depth)
        fields.append(trusted_field(old, depth, safe, empty))
        known.append(with_spread(view, old, replace(old, depth=depth), safe))
    planes = scene_planes(known_points(views, known, [a & ~b for a, b in zip(kept, plain)], labels), report)
    mixed, named = [], []
    for view, map_, safe, label in zip(views, known, sure, labels):
        report.check()
        on_planes, by_class = on_scene_planes(view, map_, safe, with_planes(view, map_, safe), planes, label)
        mixed.append(on_planes)
        named.append(by_class)
    told_apart = any(label is not None for label in labels)
    pictures = [picture_of(*parts) for parts in zip(views, known, sure, plain)] if outward or told_apart else []
    if any_plain(pictures):
        inner = [None if label is None else np.where(away_from_outlines(label), label, VOID) for label in labels]
        points = known_points(views, known, sure, inner)
        made = walls(points, report)
        mixed = on_walls(pictures, around, made if outward else backdrops(points, made), mixed, labels, report)
    final = confirmed_maps(views, mixed, device, report, around, one_suffices=named)
    carried = [moved_as_around(*parts) for parts in zip(views, fields, depths(final, maps))]
    filling = confirmed_maps(views, carried, device, report, around, agree=FIELD_AGREES, round_trip=FIELD_RETURNS)
    final = with_holes_filled(final, filling)
    final = replace(final, certain=relied_on(views, maps, sure).to(final.depth.device))
    asked = sum(int(map_.hit.sum()) for map_ in mixed)
    return final, sum(int(part.sum()) for part in hits(final, mixed)) / max(asked, 1)


def with_spread(view: FlatView, field: DepthMap, map_: DepthMap, sure: np.ndarray) -> DepthMap:
    """A map with the spreads of the field's depths, but where photos confirm them, `sure` (H, W) bool."""
    sharp = np.minimum(field.spread, SURE * map_.depth / view.camera.fx)
    return replace(map_, spread=np.where(sure, sharp, field.spread).astype(np.float32))


def where_photos_agree(
    photos: torch.Tensor, view: FlatView, map_: DepthMap, arrays: MapArrays, number: int, near: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Depths (H·W,) of the map `number` moved to where its photo agrees best with those of the maps `near` (K,) int32, by
    patches turned as normals say that are averaged over few pixels, or over many; and how well (H·W,) they agree there."""
    tried, faced = [], normals(view.camera, map_.depth)
    for size in SMOOTH:
        facing = torch.from_numpy(averaged(faced, size).reshape(-1, 3)).to(photos.device)
        tried.append(refine(photos, facing, arrays, number, near, LEAST, GAIN))
    found, agreement = (torch.stack(part) for part in zip(*tried))
    best, which = agreement.max(0, keepdim=True)
    return found.gather(0, which)[0], best[0]


def relied_on(views: list[FlatView], fields: list[DepthMap], sure: list[np.ndarray]) -> torch.Tensor:
    """Which slopes (P,) float32 of corrected maps can be relied on: where photos confirm the depth, `sure` (H, W) bool of
    each, or the field's own is sharp; planes put through unsure depths are guesses."""
    parts = [(safe | certain_slopes(view, map_)).reshape(-1) for view, map_, safe in zip(views, fields, sure)]
    return torch.from_numpy(np.concatenate(parts).astype(np.float32))


def trusted_field(field: DepthMap, depth: np.ndarray, sure: np.ndarray, empty: np.ndarray) -> DepthMap:
    """The field's own depths that may fill holes: not where `depth` (H, W) is unknown, nor much farther away than photos
    confirm it, `sure` (H, W) bool, nor where label maps say that there is nothing, `empty` (H, W) bool."""
    doubtful = (depth == 0) | (field.depth > FAR * farthest(depth, sure)) | empty
    return replace(field, depth=np.where(field.hit & doubtful, 0, field.depth))


def with_holes_filled(maps: MapArrays, others: MapArrays) -> MapArrays:
    """Maps that show what other maps of the same pictures do where they know nothing themselves."""
    hole = (maps.depth == 0) & (others.depth > 0) & (others.depth < FREE)
    return replace(
        maps,
        depth=torch.where(hole, others.depth, maps.depth),
        cosine=torch.where(hole, others.cosine, maps.cosine),
        spread=torch.where(hole, others.spread, maps.spread),
    )


def depths(arrays: MapArrays, maps: list[DepthMap]) -> list[np.ndarray]:
    """Depths (H, W) of each of the maps as they are in the arrays."""
    ends = np.cumsum([m.depth.size for m in maps])
    return [part.reshape(m.depth.shape) for part, m in zip(np.split(arrays.depth.cpu().numpy(), ends[:-1]), maps)]


def hits(arrays: MapArrays, maps: list[DepthMap]) -> list[np.ndarray]:
    """Where (H, W) each of the maps shows something."""
    return [(depth > 0) & (depth < FREE) for depth in depths(arrays, maps)]


def _with_depth(view: FlatView, map_: DepthMap, depth: np.ndarray) -> DepthMap:
    return replace(map_, depth=depth, cosine=cosines(view.camera, depth))
