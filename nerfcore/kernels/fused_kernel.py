"""The kernels of the fused renderer: second march, encodings, networks and compositing of whole rays.

The coarse march (`march_weight`) says which rays meet occupied cells and how much weight their bins have. `density_kernel`
takes those rays from a queue. Every thread of a block follows one ray: it advances to the ray's next sample
(`pdf_sampling`), the block reads the density of its samples together on the matrix units (`fused_field`), and the thread
composites its own. A ray that is used up, or opaque, makes room for the next one, so blocks stay full. Samples whose
weight is worth shading are written one after the other, and `color_kernel` and `class_kernel` read colour and classes of
those, full blocks of them again, and add them to their pixels. Samples are those of `march.sample` with all shifts ½;
the unfused path in `render/model.py` is the oracle (equal within half precision). `fused.py` launches them.

The same source runs on the CPU for tests, on one thread and slowly.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import warp as wp

from .fused_field import FieldArrays, class_function, color_function, density_function, shape_name
from .fused_network import half_vector, put
from .fused_network import lane as own_lane
from .fused_shape import FusedShape
from .pdf_sampling import MarchedRays, Walk, advanced, ray_of, started
from .traversal import EARLY_STOP, GridArrays, MarchParams, grid_position, inside

MOST_UNROLLED = 64
BLOCKS_PER_MULTIPROCESSOR = 8


@wp.struct
class RayQueue:
    """The rays that meet something: their indices, their number `ray_count` (1,), and `next_ray` (1,), the place of the
    next one; those from place `end` on wait for another launch."""

    indices: wp.array(dtype=int)
    next_ray: wp.array(dtype=int)
    ray_count: wp.array(dtype=int)
    end: int


@wp.struct
class VisibleSamples:
    """Samples worth shading: their rays, distances and weights (N,), features for the heads (N, G), and their number
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
    # So many blocks a multiprocessor leave a thread 65536 / (8 · 64) = 128 registers.
    bounds = (lanes, BLOCKS_PER_MULTIPROCESSOR)
    kernel = wp.kernel(function, name=f"fused_{kind}", module=module, launch_bounds=bounds, grid_stride=False)
    # Vectors indexed in loops that are not unrolled would live in local memory.
    kernel.module.options["max_unroll"] = MOST_UNROLLED
    return kernel


def density_kernel(shape: FusedShape, lanes: int) -> wp.Kernel:
    """The kernel that follows rays and finds their visible samples; `lanes` samples a block (1 on the CPU)."""
    # What only the heads know of does not make another kernel.
    return _density_kernel(replace(shape, color_layers=2, appearance=0, classes=0, logits=False), lanes)


@cache
def _density_kernel(shape: FusedShape, lanes: int) -> wp.Kernel:
    density_at, geometry = density_function(shape, lanes), shape.geometry

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
        lane = wp.tid()
        index = int(-1)
        walk = Walk()
        optical_depth = float(0.0)
        interval = wp.tile_empty(shape=(2, lanes), dtype=float, storage="shared")
        active_lanes = int(1)
        last_place = wp.min(queue.ray_count[0], queue.end)
        while active_lanes > 0:
            if index < 0:
                place = wp.atomic_add(queue.next_ray, 0, 1)
                if place < last_place:
                    index = queue.indices[place]
                    walk = started(rays, index)
                    optical_depth = 0.0
            active = wp.where(index >= 0, 1, 0)
            active_lanes = wp.tile_sum(wp.tile(active))[0]
            if active_lanes > 0:
                t = float(0.0)
                length = float(0.0)
                p = wp.vec3(0.5, 0.5, 0.5)
                if active == 1:
                    # Read again for each sample: kept, it would take registers that the products need.
                    ray = ray_of(rays, index, m)
                    walk, t, length = advanced(ray, walk, 0.5, grid, m)
                    p = inside(grid_position(ray.origin + ray.direction * t, m.contracted))
                    out.evaluated[lane] = out.evaluated[lane] + 1
                # Not in registers, which the products need.
                put(interval, 0, t)
                put(interval, 1, length)
                head, density = density_at(p, active, field)
                t = interval[0, own_lane()]
                length = interval[1, own_lane()]
                before = wp.exp(-optical_depth)
                optical_depth += density * length
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
                    for k in range(geometry):
                        visible.features[place, k] = head[k]
                if active == 1:  # noqa: SIM102 (Warp evaluates both sides of "and")
                    if walk.sample >= rays.counts[index] or after < EARLY_STOP:
                        index = -1

    return _named(fused_density, "density", shape, lanes)


def color_kernel(shape: FusedShape, lanes: int) -> wp.Kernel:
    """The kernel that adds the colours of visible samples to their pixels."""
    return _color_kernel(replace(shape, classes=0, logits=False), lanes)


@cache
def _color_kernel(shape: FusedShape, lanes: int) -> wp.Kernel:
    color_at, geometry, vector = color_function(shape, lanes), shape.geometry, half_vector(shape.geometry)

    def fused_color(rays: MarchedRays, visible: VisibleSamples, stride: int, field: FieldArrays, out: RenderedArrays):
        lane = wp.tid() % lanes
        count = visible.count[0]
        for begin in range(wp.tid() - lane, count, stride):
            index = wp.min(begin + lane, count - 1)
            head = vector()
            for k in range(geometry):
                head[k] = visible.features[index, k]
            ray = visible.rays[index]
            logits = color_at(head, rays.directions[ray], field)
            if begin + lane < count:
                weight = visible.weights[index]
                for k in range(3):
                    wp.atomic_add(out.pixels, ray, k, weight / (1.0 + wp.exp(-logits[k])))

    return _named(fused_color, "color", shape, lanes)


def class_kernel(shape: FusedShape, lanes: int) -> wp.Kernel:
    """The kernel that adds the class scores of visible samples to their pixels."""
    return _class_kernel(shape, lanes)


@cache
def _class_kernel(shape: FusedShape, lanes: int) -> wp.Kernel:
    scores_at, geometry, vector = class_function(shape, lanes), shape.geometry, half_vector(shape.geometry)
    classes = shape.classes

    def fused_classes(
        rays: MarchedRays,
        visible: VisibleSamples,
        stride: int,
        m: MarchParams,
        field: FieldArrays,
        out: RenderedArrays,
    ):
        lane = wp.tid() % lanes
        count = visible.count[0]
        for begin in range(wp.tid() - lane, count, stride):
            index = wp.min(begin + lane, count - 1)
            head = vector()
            for k in range(geometry):
                head[k] = visible.features[index, k]
            ray = visible.rays[index]
            point = rays.origins[ray] + rays.directions[ray] * visible.t[index]
            scores = scores_at(head, inside(grid_position(point, m.contracted)), field)
            if begin + lane < count:
                weight = visible.weights[index]
                for k in range(classes):
                    if k < field.class_count:
                        wp.atomic_add(out.probabilities, ray, k, weight * scores[k])

    return _named(fused_classes, "classes", shape, lanes)
