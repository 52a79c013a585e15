"""Image-space initialisation of the grid: what the photos show of a vertex is written into its features.

After a short coarse stage each vertex of the dense levels is projected into the training photos. Where the coarse
field leaves it in view (a depth map of every photo, rendered from the field, tells), the photo's colour there counts;
mean and variance over the photos, standardised, are added to what the vertex has learned so far (`field.voxel_init`).
Instead of colours a small convolutional network may look at the photos; its weights come from a file, or are learned
here by descending the field's own loss through what they write.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from ..config import FieldConfig
from ..data.camera_rays import CameraRays
from ..data.pixels import PixelStore, training_size
from ..errors import InputError
from ..field.grid import VertexGrid
from ..files import atomic_path
from ..geometry.cameras import project
from ..geometry.contraction import uncontract
from ..kernels.encode import FEATURES
from ..kernels.runtime import run_parallel
from ..render.model import Model

# Not tuned, but for the gain: five times as much was no better (docs/experiments.md, “A start of the grid from the photos”).
SIDE = 96  # longest side of the reduced photos
VIEWS = 48  # photos that are looked at, evenly spread
RAYS = 2048
CELLS = 1.5  # how far behind the depth map a vertex still counts as seen, in cells of its level
GAIN = 0.1  # of the standardised statistics
COLORS = FEATURES - 1  # a mean for each, and one variance
LEARNING = 40  # steps of the convolutional network
LEARNING_RATE = 3e-3


@dataclass(frozen=True)
class Reduced:
    """A photo at reduced size: color (3, H, W) in [0, 1] on black, distance (H·W,) along the ray to the coarse field's
    surface (infinite where there is none), with its camera."""

    color: torch.Tensor
    distance: torch.Tensor
    rays: CameraRays


@dataclass(frozen=True)
class Sighting:
    """Vertices (P,) that one photo sees, and the flat pixels (P,) of the reduced photo that show them."""

    vertex: torch.Tensor
    pixel: torch.Tensor


class PixelFeatures(nn.Module):
    """Three convolutions: (3, H, W) → COLORS features a pixel, (COLORS, H, W)."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(3, 16, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(16, 16, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(16, COLORS, 1),
        )

    def forward(self, color: torch.Tensor) -> torch.Tensor:
        return self.layers(color[None])[0]


def load_features(path: Path) -> PixelFeatures:
    """A network with weights from a file. Raises InputError when it is missing or not of this network."""
    network = PixelFeatures()
    try:
        network.load_state_dict(load_file(path))
    except (OSError, SafetensorError, RuntimeError) as error:
        raise InputError(
            f"{path} cannot be used as field.voxel_init_weights: {error}.",
            "Give the voxel_init.safetensors of a run, or leave the setting out.",
        ) from error
    return network


def save_features(path: Path, network: PixelFeatures) -> None:
    """Write a network's weights. Raises DiskError."""
    with atomic_path(path) as temporary:
        save_file(network.state_dict(), temporary)


def dense_levels(grid: VertexGrid) -> list[tuple[int, int]]:
    """Resolution and first row of the levels in which every vertex has a row of its own."""
    return [(resolution, first) for resolution, first, rows in grid.levels if rows == resolution**3]


def why_without_effect(config: FieldConfig, grid: VertexGrid | None, steps: int | None) -> str | None:
    """Why `field.voxel_init` does nothing in a training of so many steps (None: as many as its time allows); None where it
    is not asked for or does something."""
    if config.voxel_init == "none":
        return None
    if grid is None or not dense_levels(grid):
        return "no level of the grid has a row for each vertex"
    if steps is not None and steps <= config.voxel_init_step:
        return f"training ends after {steps} steps, before step {config.voxel_init_step} (field.voxel_init_step)"
    return None


def vertex_positions(resolution: int, contracted: bool, device: torch.device) -> torch.Tensor:
    """Normalised positions (resolution³, 3) of a level's vertices, in the order of their rows."""
    axis = torch.linspace(0, 1, resolution, device=device)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    u = torch.stack([x, y, z], -1).reshape(-1, 3)
    return uncontract(u) if contracted else u * 2 - 1


@torch.no_grad()
def reduce_photos(model: Model, store: PixelStore, check: Callable[[], None]) -> list[Reduced]:
    """Small versions of the photos of a store, with what the coarse field shows to be in them."""
    views = np.unique(np.linspace(0, len(store.views) - 1, VIEWS).round().astype(int)).tolist()
    poses = torch.eye(4, device=store.device).repeat(len(store.views), 1, 1)
    poses[:, :3, :3], poses[:, :3, 3] = store.rays.rotation, store.rays.center
    found = []
    for index in views:
        check()
        camera = store.cameras[index]
        small = camera.resized(*training_size(camera, SIDE))
        first = int(store.first[index])
        rgba = store.rgba[first : first + camera.width * camera.height].to(store.device).float() / 255
        image = (rgba[:, :3] * rgba[:, 3:]).T.reshape(1, 3, camera.height, camera.width)
        color = nn.functional.interpolate(image, (small.height, small.width), mode="area")[0]
        rays = CameraRays([small], poses[index : index + 1].cpu().numpy(), store.device)

        def distance(pixel: torch.Tensor, rays: CameraRays = rays) -> torch.Tensor:
            with torch.no_grad():
                origins, directions = rays(torch.zeros_like(pixel), pixel)
                valid = ~directions[:, :1].isnan()
                directions = torch.where(valid, directions, rays.rotation[:1, :, 2]).contiguous()
                out = model.render(origins, directions, model.config.sampling.samples, semantics=False)
                return torch.where(out.opacity > 0.5, out.depth / out.opacity.clamp(min=0.5), torch.inf)

        parts = torch.arange(small.width * small.height, device=store.device).split(RAYS)
        found.append(
            Reduced(color, torch.cat(run_parallel([partial(distance, part) for part in parts], store.device)), rays)
        )
    return found


def sightings(photos: list[Reduced], points: torch.Tensor, tolerance: torch.Tensor) -> list[Sighting]:
    """For each photo the vertices at `points` (N, 3, normalised) that it sees, at most `tolerance` (N,) behind its
    depth map."""
    found = []
    for photo in photos:
        camera, rays = photo.rays.cameras[0], photo.rays
        local = (points - rays.center[0]) @ rays.rotation[0]
        with np.errstate(invalid="ignore", over="ignore"):
            pixel_xy = torch.from_numpy(project(camera, local.cpu().numpy())).to(points)
        limit = torch.tensor([camera.width, camera.height], device=points.device)
        inside = ((pixel_xy >= 0) & (pixel_xy < limit)).all(1).nonzero()[:, 0]  # NaN is not
        x, y = pixel_xy[inside].long().unbind(1)
        pixel = y * camera.width + x
        length = local[inside].norm(dim=1)
        # A lens polynomial may fold over far outside of the photo: the pixel must look that way.
        cosine = (rays.camera_directions(torch.zeros_like(pixel), pixel) * local[inside]).sum(1) / length
        seen = (length < photo.distance[pixel] + tolerance[inside]) & (cosine > 0.99)
        found.append(Sighting(inside[seen], pixel[seen]))
    return found


def statistics(features: list[torch.Tensor], seen: list[Sighting], count: int) -> torch.Tensor:
    """Mean of each of the COLORS features and mean variance of `count` vertices, standardised over those that two
    photos or more see: (count, FEATURES); 0 for all others. `features`: (COLORS, H, W) of every photo."""
    device = features[0].device
    total, square = (torch.zeros(count, COLORS, device=device) for _ in range(2))
    views = torch.zeros(count, 1, device=device)
    for value, sighting in zip(features, seen):
        value_at = value.flatten(1).T[sighting.pixel]
        total = total.index_add(0, sighting.vertex, value_at)
        square = square.index_add(0, sighting.vertex, value_at * value_at)
        views = views.index_add(0, sighting.vertex, torch.ones_like(value_at[:, :1]))
    mean = total / views.clamp(min=1)
    variance = (square / views.clamp(min=1) - mean * mean).clamp(min=0).mean(1, keepdim=True)
    statistic, seen_twice = torch.cat([mean, variance], 1), views[:, 0] > 1
    if not bool(seen_twice.any()):
        return statistic * 0
    middle, spread = statistic[seen_twice].mean(0), statistic[seen_twice].std(0, correction=0)
    return torch.where(seen_twice[:, None], (statistic - middle) / (spread + 1e-6), 0.0)


def initialise(
    model: Model,
    store: PixelStore,
    learn: Callable[[], None],
    check: Callable[[], None],
) -> PixelFeatures | None:
    """Write what the photos show into the dense levels of a model's grid, as `field.voxel_init` says.

    Args:
        learn: leaves the gradient of the training loss of some rays in the grid.
        check: called often, may raise to stop; the grid is then as it was.
    Returns:
        The network whose features were written, if any.
    Raises:
        InputError: `field.voxel_init_weights` cannot be read.
    """
    grid, config = model.field.grid, model.config.field
    if grid is None or not (levels := dense_levels(grid)):
        return None
    photos = reduce_photos(model, store, check)
    rows, seen = [], []
    for resolution, first in levels:
        check()
        points = vertex_positions(resolution, model.contracted, store.device)
        # A cell's side grows with the distance from the cube where space is contracted.
        scale = points.abs().amax(1).clamp(min=1) ** 2 * 2 if model.contracted else torch.ones_like(points[:, 0])
        seen.append(sightings(photos, points, CELLS * 2 / (resolution - 1) * scale))
        rows.append(slice(first, first + resolution**3))

    def residual(features: list[torch.Tensor]) -> list[torch.Tensor]:
        return [GAIN * statistics(features, s, r.stop - r.start) for r, s in zip(rows, seen)]

    if config.voxel_init == "rgb_stats":
        for span, value in zip(rows, residual([photo.color for photo in photos])):
            grid.table[span] += value
        return None
    if config.voxel_init_weights is not None:
        network = load_features(Path(config.voxel_init_weights)).to(store.device)
        with torch.no_grad():
            for span, value in zip(rows, residual([network(photo.color) for photo in photos])):
                grid.table[span] += value
        return network
    return _train_features(grid, rows, photos, residual, learn, check)


def _train_features(
    grid: VertexGrid,
    rows: list[slice],
    photos: list[Reduced],
    residual: Callable[[list[torch.Tensor]], list[torch.Tensor]],
    learn: Callable[[], None],
    check: Callable[[], None],
) -> PixelFeatures:
    """Train a network on what the field's loss says about the features that it writes; they stay in the grid."""
    network = PixelFeatures().to(grid.table.device)
    optimizer = torch.optim.Adam(network.parameters(), LEARNING_RATE)
    before = [grid.table[span].clone() for span in rows]

    def write(values: list[torch.Tensor]) -> None:
        for span, own, value in zip(rows, before, values):
            grid.table[span] = own + value.detach()

    try:
        for _ in range(LEARNING):
            check()
            values = residual([network(photo.color) for photo in photos])
            write(values)
            grid.clear()
            learn()
            optimizer.zero_grad(set_to_none=True)
            torch.autograd.backward(values, [grid.gradient[span].clone() for span in rows])
            optimizer.step()
        with torch.no_grad():
            write(residual([network(photo.color) for photo in photos]))
    except BaseException:
        write([torch.zeros_like(own) for own in before])
        raise
    finally:
        grid.clear()
    return network
