"""What the pixels of a photo hit in the trained field: places, and where they lie at the edge of something nearer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy
import torch

from ..data.camera_rays import CameraRays
from ..geometry.cameras import Camera
from ..kernels.march import sample
from ..kernels.runtime import run_parallel
from ..kernels.surface import depth_quantiles
from ..render.model import Model

RAYS = 8192  # at once
# Not tuned: the next three.
OPAQUE = 0.5  # opacity of a ray that hits something
TWO_PEAKS = 0.2  # share of the distance between transmittance 3/4 and 1/4 beyond which a ray meets two surfaces
JUMP = 0.06  # share by which the distances of neighbouring pixels differ at an edge


@dataclass(frozen=True)
class Hits:
    """What the pixels of one picture hit, (H, W): distance along the ray in normalised units, 0 where nothing is; places
    (H, W, 3) in the normalised frame; edge: whether the ray meets two surfaces, or a neighbour's hit is far behind it."""

    distance: np.ndarray
    places: np.ndarray
    edge: np.ndarray

    @property
    def hit(self) -> np.ndarray:
        return self.distance > 0


def hits_of(model: Model, camera: Camera, pose: np.ndarray, share: float, check: Callable[[], None]) -> Hits:
    """What the pixels of a camera (pose (4, 4) in the normalised frame) hit, from rays of a picture of `share` of its size:
    distances in between are interpolated within a surface, those of the nearest ray at edges.

    `check` is called before every tile of rays and may raise to stop.
    """
    width, height = max(1, round(camera.width * share)), max(1, round(camera.height * share))
    distance, spread = ray_distances(model, camera.resized(width, height), pose, check)
    edge = (distance > 0) & ((spread > TWO_PEAKS * distance) | beside_jump(distance))
    row, column = (np.arange(n) + 0.5 for n in (camera.height, camera.width))
    place = np.meshgrid(row * height / camera.height - 0.5, column * width / camera.width - 0.5, indexing="ij")
    nearest = tuple(np.clip(np.round(p), 0, n - 1).astype(int) for p, n in zip(place, (height, width)))
    smooth = scipy.ndimage.minimum_filter((distance > 0) & ~edge, 3, mode="nearest")[nearest]
    between = scipy.ndimage.map_coordinates(distance, place, order=1, mode="nearest")
    found = np.where(smooth, between, distance[nearest])
    through = CameraRays([camera], pose[None], torch.device("cpu"))
    pixels = torch.arange(camera.width * camera.height)
    origins, directions = (part.numpy() for part in through(torch.zeros_like(pixels), pixels))
    places = origins + np.nan_to_num(directions) * found.reshape(-1, 1)
    found = np.where(np.isnan(directions[:, 0]).reshape(found.shape), 0, found)
    return Hits(found, places.reshape(*found.shape, 3).astype(np.float32), edge[nearest])


@torch.no_grad()
def ray_distances(
    model: Model, camera: Camera, pose: np.ndarray, check: Callable[[], None]
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (H, W) along the rays of a camera at which they become half opaque, 0 where they do not, and how far it is
    there from transmittance 3/4 to 1/4 (H, W); both in normalised units."""
    device, grid = model.priorities.device, model.render_grid()
    through = CameraRays([camera], pose[None], device)
    count = model.config.render.samples or model.config.sampling.samples
    axis = through.rotation[0, :, 2]

    @torch.no_grad()
    def tile(pixel: torch.Tensor) -> torch.Tensor:
        check()
        origins, directions = through(torch.zeros_like(pixel), pixel)
        valid = ~directions[:, 0].isnan()
        directions = torch.where(valid[:, None], directions, axis.expand_as(directions)).contiguous()
        s = sample(origins, directions, grid.cells, grid.skip_distance, grid.settings, count)
        density = model.field.density_along(s.points, s.deltas, s.packed_info)
        near, middle, far, opacity = depth_quantiles(density, s.deltas, s.t, s.packed_info)
        # A ray that stays more transparent than 1/4 has no third quantile: it is unsure as well.
        spread = torch.where(far > 0, far - near, middle)
        return torch.stack([torch.where(valid & (opacity >= OPAQUE), middle, 0.0), spread], 1)

    pixels = torch.arange(camera.width * camera.height, device=device)
    found = torch.cat(run_parallel([partial(tile, some) for some in pixels.split(RAYS)], device)).cpu().numpy()
    return found[:, 0].reshape(camera.height, camera.width), found[:, 1].reshape(camera.height, camera.width)


def beside_jump(distance: np.ndarray) -> np.ndarray:
    """Pixels (H, W) that have a neighbour (of four) whose distance (H, W) differs by more than a share of the nearer one."""
    found = np.zeros(distance.shape, bool)
    for axis in (0, 1):
        step = np.abs(np.diff(distance, axis=axis))
        nearer = np.minimum(*_pairs(distance, axis))
        jump = (step > JUMP * nearer) & (nearer > 0)
        before, behind = _pairs(found, axis)
        before |= jump
        behind |= jump
    return found


def _pairs(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Views of all values that have a next one along an axis, and of these next ones."""
    count = values.shape[axis]
    first, second = [slice(None)] * 2, [slice(None)] * 2
    first[axis], second[axis] = slice(0, count - 1), slice(1, count)
    return values[tuple(first)], values[tuple(second)]
