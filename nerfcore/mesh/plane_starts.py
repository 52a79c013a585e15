"""Depths that photos agree on near the planes of a scene, where they agree on none near the field's own depths.

A lawn that few photos show, at a flat angle, is wrong in the field by more than photos can move it: they compare a few
pixels on either side, with patches on the slope that the field has there. But grounds and walls go on: from the plane of what is
known, with its slope, photos find the depth, or they do not agree there either.
Measured: docs/experiments.md, “Ground at a wrong height” and “The ground, of which little is known”.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ..kernels.depth_arrays import MapArrays
from ..kernels.patches import refine
from ..progress import Reporter
from .depth_maps import DepthMap, FlatView, cosines, pixel_directions
from .scene_planes import STEEPEST, ScenePlane

PLANES = 8  # of the scene, the largest, from which depths are tried beside the ground
LEAST = 0.6  # correlation that is believed
GAIN = 0.1  # by which it must exceed that of the depth near the field's
# Not tuned.
OFF = 2.0  # times as far or as near as the field's depth a plane may be
STEP_GAIN = 0.05  # see `patches.refine`: by how much a depth must be better than the plane's to leave it


def from_planes(
    photos: torch.Tensor,
    views: list[FlatView],
    moved: list[DepthMap],
    agreed: list[np.ndarray],
    sure: list[np.ndarray],
    arrays: MapArrays,
    around: list[torch.Tensor],
    planes: list[ScenePlane],
    labels: list[np.ndarray | None],
    report: Reporter,
) -> list[DepthMap]:
    """The maps with other depths where photos agree better near a plane of the scene.

    Args:
        photos: see `patch_sums.quads`. moved: maps whose depths photos have moved, and how well they agree there, `agreed`
            (H, W) of each. sure: where (H, W) bool they stay. around: the maps (K,) int32 that each is compared with. labels:
            class (H, W) uint8 of each pixel, None for maps without: what label maps name lies only on planes on which some of its
            class is known, as what stands before a wall may look like it.
    """
    own = replace(arrays, depth=torch.zeros_like(arrays.depth), spread=torch.zeros_like(arrays.spread))
    made = []
    for number, (view, map_, score, safe, label) in enumerate(zip(views, moved, agreed, sure, labels)):
        report.progress(number / len(views))
        begin = int(arrays.first[number])
        some = slice(begin, begin + map_.depth.size)
        depth, best = map_.depth.copy(), np.maximum(score + GAIN, LEAST)
        asked = map_.hit & ~safe & (best < 1)  # nothing agrees better than that
        for plane in planes if asked.any() else []:
            start = depth_of(view, plane)
            near = asked & (start > map_.depth / OFF) & (start < map_.depth * OFF)
            if label is not None:
                near &= plane.partly[label]
            if not near.any():
                continue
            start = torch.from_numpy(np.where(near, start, 0).astype(np.float32).reshape(-1))
            own.depth[some], own.spread[some] = start.to(own.depth.device), start.to(own.depth.device)
            facing = (view.pose[:3, :3].T @ plane.normal).astype(np.float32)
            normal = torch.from_numpy(np.tile(facing, (len(start), 1))).to(own.depth.device)
            found, well = refine(photos, normal, own, number, around[number], LEAST, STEP_GAIN)
            found, well = (part.cpu().numpy().reshape(depth.shape) for part in (found, well))
            better = near & (well > best)
            depth[better], best[better] = found[better], well[better]
        made.append(replace(map_, depth=depth, cosine=cosines(view.camera, depth)))
    return made


def depth_of(view: FlatView, plane: ScenePlane) -> np.ndarray:
    """Depth (H, W) at which a view sees a plane of the scene and what is known to stand out of it, 0 where it does not."""
    ray = pixel_directions(view.camera) @ view.pose[:3, :3].T
    towards, eye = np.negative(ray @ plane.normal), view.pose[:3, 3]
    above, facing = (eye - plane.point) @ plane.normal, towards > STEEPEST
    towards = np.where(facing, towards, 1)
    reached = above / towards
    height = plane.height_at((eye + ray * reached[..., None]).reshape(-1, 3)).reshape(reached.shape)
    return np.where(facing & (reached > 0), np.maximum((above - height) / towards, 0), 0)
