"""The kernels of the fused renderer: second march, encodings, networks and compositing of whole rays.

The coarse march (`march_weight`) says which rays meet occupied cells and how much weight their bins have. `density_kernel`
takes those rays from a queue. Every thread follows one ray: it advances to the ray's next sample (`pdf_sampling`), the
warp reads the density of its samples together on the matrix units (`fused_field`), and the thread composites its own. A
ray that is used up, or opaque, makes room for the next one, so warps stay full. Samples whose weight is worth shading are
written one after the other, and `color_kernel` and `class_kernel` read colour and classes of those, full warps of them
again, and add them to their pixels. Samples are those of `march.sample` with all shifts ½; the unfused path in
`render/model.py` is the oracle (equal within half precision). `fused.py` launches them.

The same source runs on the CPU for tests, on one thread and slowly.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import warp as wp

from .fused_field import (
    FieldArrays,
    class_function,
    class_row,
    color_function,
    color_row,
    density_function,
    density_row,
    shape_name,
)
from .fused_network import WARP, any_of_warp, bring, keep_head, packed_size, read_head, thread_of_block
from .fused_shape import FusedShape
from .pdf_sampling import MarchedRays, Walk, advanced, ray_of, started
from .traversal import EARLY_STOP, GridArrays, MarchParams, grid_position, inside

MOST_UNROLLED = 64
BLOCKS_PER_MULTIPROCESSOR = 2


@wp.struct
class RayQueue:
    """The rays that meet something: their indices, their number `ray_count` (1,), and `next_ray` (1,), the place of the
    next one. A thread takes a ray only while there is room for `most` visible samples of it: `promised` (1,) of
    `capacity`."""

    indices: wp.array(dtype=int)
    next_ray: wp.array(dtype=int)
    ray_count: wp.array(dtype=int)
    promised: wp.array(dtype=int)
    most: int
    capacity: int


@wp.struct
class VisibleSamples:
    """Samples worth shading: their rays, distances and weights (N,), features for the heads (N, G padded), and their number
    `count` (1,). They stand in any order, those of a ray front to back."""

    rays: wp.array(dtype=int)
    t: wp.array(dtype=float)
    weights: wp.array(dtype=float)
    features: wp.array2d(dtype=wp.float16)
    count: wp.array(dtype=int)


@wp.struct
class RenderedArrays:
    """What is written: pixels (R, 5) red, green, blue, opacity and depth; probabilities (R, K); evaluated: samples of
    each thread."""

    pixels: wp.array2d(dtype=float)
    probabilities: wp.array2d(dtype=float)
    evaluated: wp.array(dtype=int)


def _named(function: object, kind: str, shape: FusedShape, lanes: int) -> wp.Kernel:
    module = f"fieldwork_fused_{kind}_{shape_name(shape, lanes)}"
    # So many blocks a multiprocessor leave a thread 65536 / (2 · 256) = 128 registers.
    bounds = (lanes, BLOCKS_PER_MULTIPROCESSOR)
    kernel = wp.kernel(function, name=f"fused_{kind}", module=module, launch_bounds=bounds, grid_stride=False)
    # Vectors indexed in loops that are not unrolled would live in local memory.
    kernel.module.options["max_unroll"] = MOST_UNROLLED
    return kernel


def _held(lanes: int, *networks: tuple[int, ...]) -> int:
    """Numbers that matrices take of a block's shared memory: on the CPU, whose blocks are smaller than a warp, none."""
    return sum(packed_size(sizes) for sizes in networks) if lanes >= WARP else 0


def density_kernel(shape: FusedShape, lanes: int) -> wp.Kernel:
    """The kernel that follows rays and finds their visible samples; `lanes` samples a block (1 on the CPU)."""
    # What only the heads know of does not make another kernel.
    return _density_kernel(replace(shape, color_layers=2, appearance=0, classes=0, logits=False), lanes)


@cache
def _density_kernel(shape: FusedShape, lanes: int) -> wp.Kernel:
    density_at, keep, length = density_function(shape), keep_head(shape.geometry), density_row(shape)
    networks = (shape.implicit, shape.density) if shape.octaves else (shape.density,)
    matrices, first = _held(lanes, *networks), shape.places()["implicit" if shape.octaves else "density"]
    size = (matrices + lanes * length) // 2

    def fused_density(
        rays: MarchedRays,
        queue: RayQueue,
        grid: GridArrays,
        m: MarchParams,
        field: FieldArrays,
        cull: float,
        visible: VisibleSamples,
        out: RenderedArrays,
    ):
        thread = wp.tid()
        memory = wp.tile_empty(shape=(size,), dtype=float, storage="shared")
        bring(memory, 0, field.weights, first, matrices)
        row = matrices + thread_of_block() * length
        index = int(-1)
        walk = Walk()
        optical_depth = float(0.0)
        needed = queue.most  # room to ask for before the next ray: what the last one has used of its own
        busy = int(1)
        while busy != 0:
            if index < 0 and needed >= 0:
                place = queue.ray_count[0]
                if queue.next_ray[0] < place:
                    if wp.atomic_add(queue.promised, 0, needed) + needed <= queue.capacity:
                        place = wp.atomic_add(queue.next_ray, 0, 1)
                    else:
                        wp.atomic_sub(queue.promised, 0, needed)
                needed = -1  # takes no other one
                if place < queue.ray_count[0]:
                    index = queue.indices[place]
                    walk = started(rays, index)
                    optical_depth = 0.0
                    needed = 0
            active = wp.where(index >= 0, 1, 0)
            busy = any_of_warp(active)
            if busy != 0:
                t = float(0.0)
                interval = float(0.0)
                p = wp.vec3(0.5, 0.5, 0.5)
                if active == 1:
                    # Read again for each sample: kept, it would take registers that the products need.
                    ray = ray_of(rays, index, m)
                    walk, t, interval = advanced(ray, walk, 0.5, grid, m)
                    p = inside(grid_position(ray.origin + ray.direction * t, m.contracted))
                    out.evaluated[thread] = out.evaluated[thread] + 1
                density = density_at(p, active, field, memory, row)
                before = wp.exp(-optical_depth)
                optical_depth += density * interval
                after = wp.exp(-optical_depth)
                weight = before - after
                if active == 1 and weight > cull:
                    # Not +=, which is atomic: a ray belongs to one thread.
                    out.pixels[index, 3] = out.pixels[index, 3] + weight
                    out.pixels[index, 4] = out.pixels[index, 4] + weight * t
                    place = wp.atomic_add(visible.count, 0, 1)
                    visible.rays[place] = index
                    visible.t[place] = t
                    visible.weights[place] = weight
                    keep(memory, row, visible.features, place)
                    needed += 1
                if active == 1:  # noqa: SIM102 (Warp evaluates both sides of "and")
                    if walk.sample >= rays.counts[index] or after < EARLY_STOP:
                        index = -1

    return _named(fused_density, "density", shape, lanes)


def color_kernel(shape: FusedShape, lanes: int) -> wp.Kernel:
    """The kernel that adds the colours of visible samples to their pixels."""
    return _color_kernel(replace(shape, classes=0, logits=False), lanes)


@cache
def _color_kernel(shape: FusedShape, lanes: int) -> wp.Kernel:
    color_at, head, length = color_function(shape), read_head(shape.geometry), color_row(shape)
    matrices, first = _held(lanes, shape.color), shape.places()["color"]
    size = (matrices + lanes * length) // 2

    def fused_color(rays: MarchedRays, visible: VisibleSamples, stride: int, field: FieldArrays, out: RenderedArrays):
        thread = thread_of_block()
        memory = wp.tile_empty(shape=(size,), dtype=float, storage="shared")
        bring(memory, 0, field.weights, first, matrices)
        row = matrices + thread * length
        in_warp = thread % WARP
        count = visible.count[0]
        for begin in range(wp.tid() - in_warp, count, stride):
            index = wp.min(begin + in_warp, count - 1)
            ray = visible.rays[index]
            head(memory, row, visible.features, index)
            logits = color_at(rays.directions[ray], field, memory, row)
            if begin + in_warp < count:
                weight = visible.weights[index]
                for k in range(3):
                    wp.atomic_add(out.pixels, ray, k, weight / (1.0 + wp.exp(-logits[k])))

    return _named(fused_color, "color", shape, lanes)


def class_kernel(shape: FusedShape, lanes: int) -> wp.Kernel:
    """The kernel that adds the class scores of visible samples to their pixels."""
    return _class_kernel(shape, lanes)


@cache
def _class_kernel(shape: FusedShape, lanes: int) -> wp.Kernel:
    classes_at, length, first = class_function(shape), class_row(shape), shape.places()["semantic"]
    branch = (shape.implicit,) if shape.octaves else ()
    matrices, begin_of_head = _held(lanes, *branch, shape.semantic), _held(lanes, *branch)
    size, of_head = (matrices + lanes * length) // 2, matrices - begin_of_head

    def fused_classes(
        rays: MarchedRays,
        visible: VisibleSamples,
        stride: int,
        m: MarchParams,
        field: FieldArrays,
        out: RenderedArrays,
    ):
        thread = thread_of_block()
        memory = wp.tile_empty(shape=(size,), dtype=float, storage="shared")
        bring(memory, 0, field.weights, 0, begin_of_head)
        bring(memory, begin_of_head, field.weights, first, of_head)
        row = matrices + thread * length
        in_warp = thread % WARP
        count = visible.count[0]
        for begin in range(wp.tid() - in_warp, count, stride):
            index = wp.min(begin + in_warp, count - 1)
            ray = visible.rays[index]
            point = rays.origins[ray] + rays.directions[ray] * visible.t[index]
            weight = wp.where(begin + in_warp < count, visible.weights[index], 0.0)
            p = inside(grid_position(point, m.contracted))
            classes_at(p, visible.features, index, field, memory, row, out.probabilities, ray, weight)

    return _named(fused_classes, "classes", shape, lanes)
