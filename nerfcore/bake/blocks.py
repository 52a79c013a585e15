"""Which blocks of a field hold something, how opaque their vertices are, and which cameras see them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial, reduce

import numpy as np
import scipy
import torch

from ..data.camera_rays import CameraRays
from ..geometry.contraction import uncontract
from ..kernels.runtime import run_parallel, worker_count
from ..kernels.traversal import MarchSettings
from ..kernels.voxel_field import CELLS, SLOT_BITS, VERTICES, VIEWS, cell_length, occupied_octants
from ..kernels.voxel_march import add_views
from ..render.model import Model
from ..sampling.render_grid import RenderGrid

Check = Callable[[], None]
CHUNK = 1 << 14  # points read at once
CHUNK_BLOCKS = 64  # blocks whose vertices are made at once
CHUNK_RAYS = 1 << 15
FOOTPRINTS, LEAST_WIDE = 20_000, 0.05  # places at which pixels' widths are taken; not tuned; quantile that counts
MOST_PARTS = 4  # of the cameras that threads ask side by side: each needs 12 kB a block
# Measured (docs/experiments.md, “How fine must a baked field be?”):
FINEST_CELL = 0.25  # of a pixel's width: what is finer no photo shows, and haze is lost in it
LEAST_OPACITY = 0.03  # of a cell; what is thinner is haze
GROWTH = 2.3  # power of the side with which the number of occupied blocks grows: surfaces, but thick ones


@dataclass(frozen=True)
class Blocks:
    """S occupied blocks among side³ over grid coordinates: places (S, 3) int64, x first, roots (S · 9³,) uint8, the
    root of the opacity of a cell at each vertex, x fastest."""

    side: int
    places: torch.Tensor
    roots: torch.Tensor

    def __len__(self) -> int:
        return len(self.places)

    def index(self) -> torch.Tensor:
        """As in `VoxelField`."""
        n, device = self.side, self.places.device
        empty = np.ones((n, n, n), bool)
        x, y, z = self.places.cpu().numpy().T
        empty[z, y, x] = False
        away = scipy.ndimage.distance_transform_cdt(empty, "chessboard") if len(self) else np.full(empty.shape, n)
        index = torch.from_numpy(-np.asarray(away, np.int32)).reshape(-1)
        entries = occupied_octants(self.roots.cpu()) << SLOT_BITS
        index[torch.from_numpy((z * n + y) * n + x)] = entries + torch.arange(1, len(self) + 1, dtype=torch.int32)
        return index.to(device)

    def kept(self, which: torch.Tensor) -> Blocks:
        """Some of the blocks, `which` (S,) bool."""
        return Blocks(self.side, self.places[which], self.roots.view(-1, VERTICES**3)[which].reshape(-1))


def vertex_points(places: torch.Tensor, side: int) -> torch.Tensor:
    """Grid coordinates (S · 9³, 3) of the vertices of blocks (S, 3), x fastest."""
    axis = torch.arange(VERTICES, device=places.device)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    local = torch.stack([x, y, z], -1).view(1, -1, 3)
    return ((places[:, None] * CELLS + local) / (side * CELLS)).reshape(-1, 3).float()


def march_settings(model: Model, side: int, step: float) -> MarchSettings:
    """How rays march through blocks of the model, in steps of so many cells."""
    asked = model.occupancy.march_settings()
    return MarchSettings(
        resolution=side * CELLS,
        step=step * cell_length(side, model.contracted),
        near=asked.near,
        far=asked.far,
        contracted=model.contracted,
        empty_distance=asked.empty_distance,
    )


def growth(places: torch.Tensor) -> torch.Tensor:
    """How many times as long (N,) cells and bins are at places (N, 3) as in the cube [−1, 1]³, where space is contracted: as in
    `kernels.traversal.bin_length`."""
    return places.abs().amax(1).clamp(min=1) ** 1.5


def candidates(grid: RenderGrid, side: int) -> torch.Tensor:
    """Places (S, 3) of the blocks that an occupied cell of the grid reaches into."""
    n = grid.settings.resolution
    occupied = grid.cells[:, 0].view(n, n, n) > 0
    for axis in range(3):
        spans = [(block * n // side, -(-(block + 1) * n // side)) for block in range(side)]
        occupied = torch.stack([occupied.narrow(axis, a, b - a).any(axis) for a, b in spans], axis)
    return occupied.nonzero().flip(1).contiguous()


def _beside_occupied(points: torch.Tensor, grid: RenderGrid) -> torch.Tensor:
    """Whether one of the cells around points (N, 3) in grid coordinates is occupied, (N,)."""
    n = grid.settings.resolution
    found = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for corner in range(8):
        shift = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2], device=points.device) * 2e-4 - 1e-4
        cell = (points * n + shift).long().clamp(0, n - 1)
        found |= grid.cells[(cell[:, 2] * n + cell[:, 1]) * n + cell[:, 0], 0] > 0
    return found


@torch.no_grad()
def visible_grid(model: Model, grid: RenderGrid, rays: CameraRays, check: Check) -> RenderGrid:
    """The grid without the cells that no camera sees by the grid's own densities: nothing need be read there.

    Its cells are taken as those of blocks, with vertices as dense as the cells around them are on average.
    """
    n = grid.settings.resolution
    if n % CELLS:
        return grid
    side = n // CELLS
    density = grid.cells[:, 0].view(n, n, n)
    dense = torch.nn.functional.avg_pool3d(density[None], 2, 1, 1, count_include_pad=True)[0]
    roots = ((1 - torch.exp(-dense * grid.settings.step * model.config.sampling.bins_per_cell)).sqrt() * 255).round()
    places = candidates(grid, side)
    corner = (vertex_points(places, side) * n).round().long()
    row = (corner[:, 2] * (n + 1) + corner[:, 1]) * (n + 1) + corner[:, 0]
    blocks = Blocks(side, places, roots.view(-1)[row].to(torch.uint8))
    seen = (seen_by(blocks, rays, march_settings(model, side, 1.0), True, check) > 0).any(1)
    there = torch.zeros((n + 1) ** 3, device=density.device)
    there[row[seen]] = 1
    visible = torch.nn.functional.max_pool3d(there.view(1, n + 1, n + 1, n + 1), 2, 1)[0] > 0
    cells = torch.where(visible.view(-1, 1), grid.cells, 0.0)
    return replace(grid, cells=cells)


@torch.no_grad()
def read_blocks(model: Model, grid: RenderGrid, side: int, check: Check) -> Blocks:
    """All blocks in which the field has something.

    Vertices all of whose cells are empty in the grid have no opacity: the field says nothing there.
    """
    places = candidates(grid, side)
    cell = cell_length(side, model.contracted)

    @torch.no_grad()
    def read(some: torch.Tensor) -> torch.Tensor:
        check()
        points = vertex_points(some, side)
        roots = torch.zeros(len(points), device=points.device)
        used = _beside_occupied(points, grid).nonzero()[:, 0]
        for part in used.split(CHUNK):
            check()
            there = points[part].contiguous()
            length = torch.full((len(part),), cell, device=points.device)
            if model.contracted:
                length = length * growth(uncontract(there))
            opacity = 1 - torch.exp(-model.field.density(there) * length)
            roots[part] = torch.where(opacity > LEAST_OPACITY, opacity.sqrt(), 0.0)
        return (roots * 255).round().to(torch.uint8)

    parts = run_parallel([partial(read, some) for some in places.split(CHUNK_BLOCKS)], places.device)
    roots = torch.cat(parts) if parts else torch.zeros(0, dtype=torch.uint8, device=places.device)
    blocks = Blocks(side, places, roots)
    return blocks.kept((roots.view(-1, VERTICES**3) > 0).any(1))


@torch.no_grad()
def seen_by(blocks: Blocks, rays: CameraRays, settings: MarchSettings, by_vertex: bool, check: Check) -> torch.Tensor:
    """Which cameras see the blocks (S, VIEWS), or their vertices (S · 9³, VIEWS): codes of `voxel_march.add_views`."""
    device = blocks.roots.device
    index = blocks.index()

    def noted(cameras: range) -> torch.Tensor:
        rows = len(blocks.roots) if by_vertex else len(blocks)
        views = torch.zeros(rows, VIEWS, dtype=torch.int32, device=device)
        for number in cameras:
            camera = rays.cameras[number]
            for pixels in torch.arange(camera.width * camera.height, device=device).split(CHUNK_RAYS):
                check()
                image = torch.full_like(pixels, number)
                origins, directions = rays(image, pixels)
                valid = ~directions[:, 0].isnan()
                some = image[valid].to(torch.int32)
                add_views(views, origins[valid], directions[valid], some, index, blocks.roots, settings)
        return views

    # Threads of the CPU have no atomic operations: each notes what its own cameras see.
    parts = min(worker_count(), MOST_PARTS) if device.type == "cpu" else 1
    noting = [partial(noted, range(part, len(rays.cameras), parts)) for part in range(parts)]
    return reduce(torch.maximum, run_parallel(noting, device))


def weights_and_cameras(views: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Weight in [0, 1] and number of the cameras in the codes of `seen_by`, of their shape."""
    return (views >> 16).float() / 32767, views & 0xFFFF


@torch.no_grad()
def finest_side(grid: RenderGrid, centers: torch.Tensor, angles: torch.Tensor) -> int:
    """How many blocks along a side make cells of blocks `FINEST_CELL` of a pixel wide, in nearly all occupied cells.

    `centers` (V, 3): of the cameras; `angles` (V,): the width of a pixel over its distance; that of the camera whose pixel
    is the smallest counts, whether or not it sees the cell.
    """
    n, contracted = grid.settings.resolution, grid.settings.contracted
    occupied = (grid.cells[:, 0] > 0).nonzero()[:, 0]
    if len(occupied) == 0:
        return 1
    occupied = occupied[:: max(1, len(occupied) // FOOTPRINTS)]
    points = (torch.stack([occupied % n, occupied // n % n, occupied // n**2], 1) + 0.5) / n
    places = uncontract(points) if contracted else points * 2 - 1
    width = (torch.cdist(places, centers) * angles).amin(1)
    if contracted:
        width = width / growth(places)
    return max(1, round(cell_length(1, contracted) / (FINEST_CELL * float(width.quantile(LEAST_WIDE)))))


def side_for(seen: int, side: int, most: int) -> int:
    """Blocks along a side so that about `most` are left of what are `seen` blocks with `side`."""
    return max(1, math.floor(0.97 * side * (most / max(seen, 1)) ** (1 / GROWTH)))
