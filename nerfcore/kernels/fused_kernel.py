"""The kernel of the fused renderer: second march, encodings, networks and compositing of whole rays.

The coarse march (`march_weight`) says which rays meet occupied cells and how much weight their bins have; this kernel
takes those rays from a queue. Every thread of a block follows one ray: it advances to the ray's next sample
(`pdf_sampling`), the block evaluates its samples together on the matrix units (`fused_field`), and the thread
composites its own. A ray that is used up, or opaque, makes room for the next one, so blocks stay full. Samples are
those of `march.sample` with all shifts ½; the unfused path in `render/model.py` is the oracle (equal within half
precision). `fused.py` launches it.

The same source runs on the CPU for tests, on one thread and slowly.
"""

from __future__ import annotations

from functools import cache

import warp as wp

from .fused_field import FieldArrays, field_functions, shape_name
from .fused_network import half_vector
from .fused_shape import FusedShape
from .pdf_sampling import MarchedRays, Ray, advanced, started
from .traversal import EARLY_STOP, GridArrays, MarchParams, grid_position, inside

MOST_UNROLLED = 64


@wp.struct
class RayQueue:
    """The rays that meet something: their indices, their number `ray_count` (1,), and `next_ray` (1,), the place of the
    next one."""

    indices: wp.array(dtype=int)
    next_ray: wp.array(dtype=int)
    ray_count: wp.array(dtype=int)


@wp.struct
class RenderedArrays:
    """What is written: pixels (R, 5) red, green, blue, opacity and depth; probabilities (R, K); evaluated: samples of
    each thread."""

    pixels: wp.array2d(dtype=float)
    probabilities: wp.array2d(dtype=float)
    evaluated: wp.array(dtype=int)


@wp.struct
class Pixel:
    """What has come together along a ray so far."""

    optical_depth: float
    transmittance: float
    color: wp.vec3
    opacity: float
    depth: float


@wp.func
def empty_pixel():
    pixel = Pixel()
    pixel.transmittance = 1.0
    return pixel


@wp.func
def with_color(pixel: Pixel, weight: float, logits: wp.vec3, t: float):
    """The pixel after a visible sample at distance t."""
    red = weight / (1.0 + wp.exp(-logits[0]))
    green = weight / (1.0 + wp.exp(-logits[1]))
    blue = weight / (1.0 + wp.exp(-logits[2]))
    pixel.color += wp.vec3(red, green, blue)
    pixel.opacity += weight
    pixel.depth += weight * t
    return pixel


@wp.func
def write_pixel(out: RenderedArrays, index: int, pixel: Pixel):
    for k in range(3):
        out.pixels[index, k] = pixel.color[k]
    out.pixels[index, 3] = pixel.opacity
    out.pixels[index, 4] = pixel.depth


@cache
def fused_kernel(shape: FusedShape, lanes: int) -> wp.Kernel:
    """The kernel for fields of a shape; `lanes` samples a block (1 on the CPU)."""
    read = field_functions(shape, lanes)
    grid_features, blended_features = read.grid, read.blended
    density_at, color_at, class_scores = read.density, read.color, read.classes
    octaves, classes = shape.octaves, shape.classes
    branch, density_input = half_vector(shape.features), half_vector(shape.density[0])

    def fused_render(
        rays: MarchedRays,
        queue: RayQueue,
        grid: GridArrays,
        m: MarchParams,
        field: FieldArrays,
        cull: float,
        out: RenderedArrays,
    ):
        lane = wp.tid()
        ray = Ray()
        ray.index = -1
        pixel = empty_pixel()
        samples = int(0)
        active_lanes = int(1)
        while active_lanes > 0:
            if ray.index < 0:
                place = wp.atomic_add(queue.next_ray, 0, 1)
                if place < queue.ray_count[0]:
                    ray = started(rays, queue.indices[place], m)
                    pixel = empty_pixel()
            active = wp.where(ray.index >= 0, 1, 0)
            active_lanes = wp.tile_sum(wp.tile(active))[0]
            if active_lanes > 0:
                t = float(0.0)
                length = float(0.0)
                p = wp.vec3(0.5, 0.5, 0.5)
                if active == 1:
                    ray, t, length = advanced(ray, 0.5, grid, m)
                    p = inside(grid_position(ray.origin + ray.direction * t, m.contracted))
                    samples += 1
                explicit = grid_features(p, field)
                implicit = branch()
                uncertain_lanes = int(0)
                if wp.static(octaves > 0):
                    joined, implicit, uncertain_lanes = blended_features(p, active, explicit, field)
                else:
                    joined = density_input(explicit)
                head, density = density_at(joined, p, field)
                pixel.optical_depth += density * length
                after = wp.exp(-pixel.optical_depth)
                weight = pixel.transmittance - after
                pixel.transmittance = after
                visible = wp.where(active == 1 and weight > cull, 1, 0)
                visible_lanes = wp.tile_sum(wp.tile(visible))[0]
                if visible_lanes > 0:
                    logits = color_at(head, ray.direction, field)
                    if visible == 1:
                        pixel = with_color(pixel, weight, logits, t)
                    if wp.static(classes > 0):
                        scores = class_scores(head, explicit, implicit, uncertain_lanes, p, field)
                        if visible == 1:
                            for k in range(classes):
                                if k < field.class_count:
                                    # Not +=, which is atomic: a ray belongs to one thread.
                                    before = out.probabilities[ray.index, k]
                                    out.probabilities[ray.index, k] = before + weight * scores[k]
                done = ray.ended == 1 or ray.sample >= ray.count or pixel.transmittance < EARLY_STOP
                if active == 1 and done:
                    write_pixel(out, ray.index, pixel)
                    ray.index = -1
        out.evaluated[lane] = samples

    name = f"fieldwork_fused_{shape_name(shape, lanes)}"
    kernel = wp.kernel(fused_render, name="fused_render", module=name, launch_bounds=lanes, grid_stride=False)
    # Vectors indexed in loops that are not unrolled would live in local memory.
    kernel.module.options["max_unroll"] = MOST_UNROLLED
    return kernel
