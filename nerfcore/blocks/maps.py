"""Depth maps of blocks in one frame: moved, cut to what their block knows well, put together, kept on disk."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import torch

from ..errors import ProjectError
from ..files import UNREADABLE_ARRAYS, atomic_path
from ..geometry.similarity import similarity_scale
from ..kernels.depth_arrays import FREE, MapArrays
from ..kernels.device import kernel_device

EDGE = 1e-4  # of a box's size: rays that touch its side are inside


def moved(maps: MapArrays, similarity: np.ndarray) -> MapArrays:
    """The maps in another frame; `similarity` (4, 4) maps theirs to it."""
    scale = similarity_scale(similarity)
    device = maps.depth.device
    turn = torch.from_numpy(similarity[:3, :3] / scale).to(device)
    shift = torch.from_numpy(similarity[:3, 3]).to(device)
    rotation = maps.rotation.double() @ turn.T
    translation = scale * maps.translation.double() - rotation @ shift
    solid = (maps.depth > 0) & (maps.depth < FREE)
    return replace(
        maps,
        depth=torch.where(solid, maps.depth * scale, maps.depth),
        spread=maps.spread * scale,
        rotation=rotation.float(),
        translation=translation.float(),
    )


def cut_maps(maps: MapArrays, reach: tuple[np.ndarray, np.ndarray], whole: tuple[np.ndarray, np.ndarray]) -> MapArrays:
    """The maps without what they show outside of `reach`, which other blocks know better; and without rays that meet
    nothing, where these cross another block's part of `whole`.

    Args:
        reach, whole: corners (3,) in the maps' frame, infinite where a side is open.
    """
    depth = maps.depth.clone()
    low, high = (torch.from_numpy(corner).to(depth.device) for corner in reach)
    for view in range(len(maps)):
        begin, (width, height) = int(maps.first[view]), maps.size[view].tolist()
        own = depth[begin : begin + width * height]  # a view of it
        place = torch.arange(width * height, device=depth.device)
        fx, fy, cx, cy = maps.lens[view].double()
        x, y = place % width + 0.5, torch.div(place, width, rounding_mode="floor") + 0.5
        local = torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(x, dtype=torch.float64)], 1)
        rotation, translation = maps.rotation[view].double(), maps.translation[view].double()
        directions, origin = local @ rotation, -translation @ rotation
        point = origin + directions * torch.where(own < FREE, own, 0.0).double()[:, None]
        inside = ((point >= low) & (point <= high)).all(1)
        stays = _stays(origin, directions, reach, whole)
        own[torch.where(own < FREE, ~inside, ~stays)] = 0.0
    return replace(maps, depth=depth)


def _stays(
    origin: torch.Tensor,
    directions: torch.Tensor,
    reach: tuple[np.ndarray, np.ndarray],
    whole: tuple[np.ndarray, np.ndarray],
) -> torch.Tensor:
    """Which rays (N,) are in `reach` as long as they are in `whole`."""
    enters, leaves = _span(origin, directions, whole)
    first, last = _span(origin, directions, reach)
    slack = EDGE * float(np.max(whole[1] - whole[0]))
    return (leaves <= enters) | ((enters >= first - slack) & (leaves <= last + slack))


def _span(
    origin: torch.Tensor, directions: torch.Tensor, box: tuple[np.ndarray, np.ndarray]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where rays (N, 3) from `origin` enter and leave a box, not before they begin."""
    low, high = (torch.from_numpy(corner).to(origin.device) for corner in box)
    along = torch.where(directions.abs() < 1e-12, torch.full_like(directions, 1e-12), directions)
    one, other = (low - origin) / along, (high - origin) / along
    enters = torch.minimum(one, other).amax(1).clamp(min=0.0)
    return enters, torch.maximum(one, other).amin(1)


def joined_maps(parts: list[MapArrays]) -> MapArrays:
    """The maps of all parts, one after the other."""
    pixels = np.cumsum([0, *[len(part.depth) for part in parts[:-1]]])
    firsts = [part.first + int(before) for part, before in zip(parts, pixels)]
    together = {field.name: torch.cat([getattr(part, field.name) for part in parts]) for field in fields(MapArrays)}
    return MapArrays(**{**together, "first": torch.cat(firsts).int()})


def save_maps(path: Path, maps: MapArrays) -> None:
    """Atomically write the maps. Raises DiskError."""
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **{name: value.cpu().numpy() for name, value in vars(maps).items()})


def load_maps(path: Path, device: torch.device) -> MapArrays:
    """The maps as kernels read them, on the host where the device has no Warp. Raises ProjectError: there are none, or the
    file is damaged."""
    device = kernel_device(device)
    try:
        with np.load(path, allow_pickle=False) as data:
            return MapArrays(**{f.name: torch.from_numpy(data[f.name]).to(device) for f in fields(MapArrays)})
    except FileNotFoundError as error:
        raise ProjectError(f"{path} is missing.", "Run `fieldwork blocks` again.") from error
    except (*UNREADABLE_ARRAYS, KeyError) as error:
        raise ProjectError(f"{path} is damaged: {error}.", "Remove it and run `fieldwork blocks` again.") from error
