"""What the depth maps of a block say anything about, in few numbers: by these another block knows whether it needs the maps
themselves, and all blocks agree on the region in which surfaces are looked for.

A map speaks of the space between its camera and its hits, of a little behind them, and of the rays that meet nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch

from ..errors import ProjectError
from ..files import UNREADABLE_ARRAYS, atomic_path
from ..kernels.depth_arrays import FREE, MapArrays
from ..mesh.fusion import spread_of

MOST_HITS = 1 << 15  # points and pixel sizes that are kept of a block
PER_PIXEL = ("depth", "cosine", "spread", "certain")  # of MapArrays


@dataclass(frozen=True)
class Sights:
    """V maps in the frame that all blocks share.

    low, high (V, 3): corners around each camera and what it sees, (∞, −∞) where that is nothing; behind_low, behind_high
    (V, 3): bounds of the steps behind the hits by which the distance to their surface falls by one; free_low, free_high
    (V, 3): corners around the rays that meet nothing, up to where surfaces are looked for at most, or (∞, −∞); pixel (V,): the
    widest pixel at a hit; focal: the smallest focal length in pixels; spread (2,): what `fusion.spread_of` says; hits (N, 3)
    and sizes (N,): some of the points, and how wide a pixel is there.
    """

    low: np.ndarray
    high: np.ndarray
    behind_low: np.ndarray
    behind_high: np.ndarray
    free_low: np.ndarray
    free_high: np.ndarray
    pixel: np.ndarray
    focal: np.ndarray
    spread: np.ndarray
    hits: np.ndarray
    sizes: np.ndarray

    def speak_of(self, low: np.ndarray, high: np.ndarray, truncation: float, slack: float) -> np.ndarray:
        """Which maps (V,) bool may say something about the box between two corners (3,).

        Args:
            truncation: how far behind its surface a map is heard. slack: added to the box on all sides.
        """
        first = np.minimum(self.low + truncation * self.behind_low, self.free_low)
        last = np.maximum(self.high + truncation * self.behind_high, self.free_high)
        room = slack + self.pixel[:, None]
        return ((first - room <= high) & (last + room >= low)).all(1)


def sights_of(maps: MapArrays, limit: tuple[np.ndarray, np.ndarray]) -> Sights:
    """What the maps of a block speak of.

    Args:
        limit: corners (3,) of the space in which surfaces are looked for at most.
    """
    step = max(1, int(((maps.depth > 0) & (maps.depth < FREE)).sum()) // MOST_HITS)
    each = [_sight(maps, view, step, limit) for view in range(len(maps))]
    names = [field.name for field in fields(Sights)][:7]
    stacked = {name: np.stack([one[name] for one in each]) for name in names}
    together = {name: np.concatenate([one[name] for one in each]) for name in ("hits", "sizes")}
    return Sights(**stacked, focal=maps.lens[:, 0].min().cpu().numpy(), spread=spread_of(maps), **together)


def _sight(maps: MapArrays, view: int, step: int, limit: tuple[np.ndarray, np.ndarray]) -> dict[str, np.ndarray]:
    begin, (width, height) = int(maps.first[view]), maps.size[view].tolist()
    pixels = slice(begin, begin + width * height)
    depth, cosine = maps.depth[pixels].double(), maps.cosine[pixels].double()
    rotation, shift = maps.rotation[view].double(), maps.translation[view].double()
    fx, fy, cx, cy = maps.lens[view].double()
    place = torch.arange(width * height, device=depth.device)
    x, y = place % width + 0.5, torch.div(place, width, rounding_mode="floor") + 0.5
    rays = torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(depth)], 1) @ rotation
    center = -shift @ rotation
    solid, free = (depth > 0) & (depth < FREE), depth >= FREE
    hits = center + rays[solid] * depth[solid][:, None]
    unit = rays / rays.norm(dim=1, keepdim=True)
    steps = unit[solid] / cosine[solid].clamp(min=1e-3)[:, None]
    sizes = depth[solid] / fx
    silent = torch.full((1, 3), torch.inf, dtype=torch.float64, device=depth.device)
    corners = torch.cat([center[None], hits]) if len(hits) else silent
    none = torch.zeros(1, 3, dtype=torch.float64, device=depth.device)
    behind = torch.cat([none, steps])
    beyond, room = _ends(center, unit[free], limit) if free.any() else (silent, torch.zeros(()))
    room = room / fx  # beside a ray it is asked for too
    found = {
        "low": corners.amin(0),
        "high": corners.amax(0) if len(hits) else -corners.amax(0),
        "behind_low": behind.amin(0),
        "behind_high": behind.amax(0),
        "free_low": beyond.amin(0) - room,
        "free_high": beyond.amax(0) + room if free.any() else -beyond.amax(0),
        "pixel": sizes.amax() if len(sizes) else torch.zeros(()),
        "hits": hits[::step].float(),
        "sizes": sizes[::step].float(),
    }
    return {name: value.cpu().numpy() for name, value in found.items()}


def _ends(
    center: torch.Tensor, directions: torch.Tensor, limit: tuple[np.ndarray, np.ndarray]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where rays (N, 3) from a place leave a box, and that place itself (N + 1, 3); and the longest way."""
    low, high = (torch.from_numpy(np.asarray(corner, np.float64)).to(center.device) for corner in limit)
    along = torch.where(directions.abs() < 1e-12, torch.full_like(directions, 1e-12), directions)
    far = torch.maximum((low - center) / along, (high - center) / along).amin(1).clamp(min=0.0)
    longest = far.amax() if len(far) else torch.zeros((), dtype=torch.float64, device=center.device)
    return torch.cat([center[None], center + directions * far[:, None]]), longest


def chosen(maps: MapArrays, keep: np.ndarray) -> MapArrays:
    """The maps (V,) bool that are kept, in their order."""
    views = np.flatnonzero(keep).tolist()
    counts = maps.size.long().prod(1).tolist()
    begins = [int(maps.first[view]) for view in views]
    pieces = [slice(begin, begin + counts[view]) for begin, view in zip(begins, views)]
    flat = {name: torch.cat([getattr(maps, name)[piece] for piece in pieces]) for name in PER_PIXEL}
    ends = np.cumsum([0, *[counts[view] for view in views[:-1]]])
    first = torch.tensor(ends, dtype=torch.int32, device=maps.first.device)
    rest = {name: getattr(maps, name)[views] for name in ("size", "lens", "rotation", "translation")}
    return MapArrays(**flat, first=first, **rest)


def save_sights(path: Path, sights: Sights) -> None:
    """Atomically write them. Raises DiskError."""
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **vars(sights))


def load_sights(path: Path) -> Sights:
    """Raises ProjectError: there are none, or the file is damaged."""
    try:
        with np.load(path, allow_pickle=False) as data:
            return Sights(**{field.name: data[field.name] for field in fields(Sights)})
    except FileNotFoundError as error:
        raise ProjectError(f"{path} is missing.", "Run `fieldwork blocks` again.") from error
    except (*UNREADABLE_ARRAYS, KeyError) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Remove it and run `fieldwork blocks` again.") from error
