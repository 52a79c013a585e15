"""Launching the fused renderer: the coarse march of rays, and the fused kernels on those that meet something."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from . import march
from .blocks import launch_blocks
from .device import backend_of
from .fused_encoding import half_feature
from .fused_field import FieldArrays
from .fused_kernel import (
    BLOCKS_PER_MULTIPROCESSOR,
    RayQueue,
    RenderedArrays,
    VisibleSamples,
    class_kernel,
    color_kernel,
    density_kernel,
)
from .fused_network import padded
from .fused_shape import FusedShape
from .runtime import array, init
from .traversal import MarchSettings, grid_arrays, march_params

MOST_CLASSES = 64
CAPACITY = 1 << 22  # visible samples between two kernels; 44 bytes each with 16 features for the heads


def lanes_of(architecture: int) -> int:
    """Threads of a block on a GPU of compute capability `architecture` / 10: as many as leave room for two blocks in a
    multiprocessor's shared memory, or for one where that is 64 KB."""
    return 128 if architecture < 80 else 256


@dataclass(frozen=True)
class FusedField:
    """A field as the fused kernel reads it; `render.fused.pack` makes it.

    table (rows, 4) and weights (W,) float16; layout (L, 3) int32: resolution, first row, rows of each
    level; gains (L,) and code (A,) float32; evidence (E³,) float32 or a single 0 where w is 1 everywhere.
    """

    shape: FusedShape
    table: torch.Tensor
    layout: torch.Tensor
    gains: torch.Tensor
    weights: torch.Tensor
    code: torch.Tensor
    evidence: torch.Tensor
    evidence_side: int
    blend_floor: float
    blend_rate: float
    density_shift: float
    thinning: bool
    class_count: int


@dataclass(frozen=True)
class FusedRays:
    """Of R rays, as `render.model.Rendered`: color (R, 3), opacity (R,), depth (R,), probabilities (R, K) or None;
    evaluated: () int64 on the device, samples at which the field was read."""

    color: torch.Tensor
    opacity: torch.Tensor
    depth: torch.Tensor
    probabilities: torch.Tensor | None
    evaluated: torch.Tensor


@dataclass(frozen=True)
class CoarseRays:
    """What the coarse march tells: total weight, distance of the first occupied bin and number of occupied bins (R,), the rays that meet
    something in `queue` (R,) int32 and their number `ray_count` (1,) int32, all on the device."""

    origins: torch.Tensor
    directions: torch.Tensor
    total_weight: torch.Tensor
    t_first: torch.Tensor
    bin_counts: torch.Tensor
    queue: torch.Tensor
    ray_count: torch.Tensor


def coarse_march(
    origins: torch.Tensor,
    directions: torch.Tensor,
    cells: torch.Tensor,
    skip_distance: torch.Tensor,
    settings: MarchSettings,
) -> CoarseRays:
    """March rays (R, 3) of the normalised frame through the occupancy grid; see `march.sample` for the arguments.

    Nothing is read back from the device.
    """
    device, rays = origins.device, len(origins)
    total_weight, t_first, _, bin_counts = march.coarse_march(origins, directions, cells, skip_distance, settings)
    hit = total_weight > 0
    rank = torch.cumsum(hit, 0)
    # Rays that miss are written behind the queue.
    queue = torch.empty(rays + 1, dtype=torch.int32, device=device)
    queue.scatter_(0, torch.where(hit, rank - 1, rays), torch.arange(rays, dtype=torch.int32, device=device))
    return CoarseRays(origins, directions, total_weight, t_first, bin_counts, queue, rank[-1:].to(torch.int32))


def render_coarse(
    field: FusedField,
    rays: CoarseRays,
    cells: torch.Tensor,
    skip_distance: torch.Tensor,
    settings: MarchSettings,
    count: int,
    cull: float,
    lanes: int | None = None,
    capacity: int = CAPACITY,
) -> FusedRays:
    """Colour, opacity, depth and class probabilities of rays after their coarse march, at most `count` samples a ray.

    `lanes`: samples a block, by default `lanes_of` on CUDA and 1 on the CPU, where more need Warp's `enable_cpu_blocks`;
    `capacity`: visible samples there is room for at a time; what does not fit is rendered in further rounds.
    """
    init()
    device, number = rays.origins.device, len(rays.origins)
    cuda = backend_of(device).fused
    resident = 2  # blocks at a time; more than one on the CPU only to test that they share
    if cuda:
        properties = torch.cuda.get_device_properties(device)
        resident = properties.multi_processor_count * BLOCKS_PER_MULTIPROCESSOR
    lanes = lanes or (lanes_of(10 * properties.major + properties.minor) if cuda else 1)
    counts = march.sample_counts(rays.bin_counts, count, settings.per_bin)
    room = min(capacity, number * count)
    # Threads promise room for the rays that they follow: half of it, so that a launch fills the other half at least.
    groups = max(1, min(-(-number // lanes), room // (2 * count * lanes), resident))
    pixels = torch.zeros(number, 5, device=device)
    classes = field.class_count
    probabilities = torch.zeros(number, max(classes, 1), device=device)
    evaluated = torch.zeros(groups * lanes, dtype=torch.int32, device=device)
    out = RenderedArrays()
    out.pixels, out.probabilities, out.evaluated = array(pixels), array(probabilities), array(evaluated)
    marched = march.marched_rays(rays.origins, rays.directions, rays.total_weight, rays.t_first, counts)
    grid, params, arrays = grid_arrays(cells, skip_distance), march_params(settings), _field_arrays(field)
    visible, places = _visible_samples(room, field.shape.geometry, device)
    heads = max(1, min(-(-room // lanes), resident))
    stride = heads * lanes
    next_ray, promised = (torch.zeros(1, dtype=torch.int32, device=device) for _ in range(2))
    queue = RayQueue()
    queue.indices, queue.next_ray, queue.ray_count = array(rays.queue), array(next_ray), array(rays.ray_count)
    queue.promised, queue.most, queue.capacity = array(promised), count, room
    while True:
        places.zero_()
        promised.zero_()
        inputs = [marched, queue, grid, params, arrays, cull, visible, out]
        launch_blocks(density_kernel(field.shape, lanes), groups, lanes, inputs, device)
        inputs = [marched, visible, stride, arrays, out]
        launch_blocks(color_kernel(field.shape, lanes), heads, lanes, inputs, device)
        if classes:
            inputs = [marched, visible, stride, params, arrays, out]
            launch_blocks(class_kernel(field.shape, lanes), heads, lanes, inputs, device)
        # Read back only where there may be rays left: launches for nothing take longer.
        if room == number * count or bool(next_ray >= rays.ray_count):
            break
    return FusedRays(pixels[:, :3], pixels[:, 3], pixels[:, 4], probabilities if classes else None, evaluated.sum())


def _visible_samples(capacity: int, features: int, device: torch.device) -> tuple[Any, torch.Tensor]:
    """Room for visible samples, and their number (1,) int32."""
    count = torch.zeros(1, dtype=torch.int32, device=device)
    out = VisibleSamples()
    out.rays = array(torch.empty(capacity, dtype=torch.int32, device=device))
    out.t, out.weights = (array(torch.empty(capacity, device=device)) for _ in range(2))
    out.features = array(torch.empty(capacity, padded(features), dtype=torch.float16, device=device))
    out.count = array(count)
    return out, count


def _field_arrays(field: FusedField) -> Any:
    out = FieldArrays()
    out.table, out.layout, out.gains = array(field.table, half_feature), array(field.layout), array(field.gains)
    out.evidence, out.evidence_side = array(field.evidence), field.evidence_side
    out.blend_floor, out.blend_rate = field.blend_floor, field.blend_rate
    out.weights, out.code = array(field.weights), array(field.code)
    out.density_shift, out.thinning, out.class_count = field.density_shift, int(field.thinning), field.class_count
    return out
