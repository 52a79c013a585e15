"""The kernel of the fused renderer: second march, encodings, networks and compositing of whole rays.

The coarse march (`march_weight`) says which rays meet occupied cells and how much weight their bins have; this kernel
takes those rays from a queue. Every thread of a block follows one ray: it advances to the ray's next sample, the block
evaluates its samples together on the matrix units (`fused_network`), and the thread composites its own. A ray that
is used up, or opaque, makes room for the next one, so blocks stay full. Samples are those of `march.sample` with all
shifts ½; the unfused path in `render/model.py` is the oracle (equal within half precision). `fused.py` launches it.

The same source runs on the CPU for tests, on one thread and slowly.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import warp as wp

from .cells import trilinear_at
from .fused_network import (
    GRANULE,
    frequency_encoding,
    grid_encoding,
    half_feature,
    half_vector,
    network,
    padded,
    spherical_harmonics,
)
from .traversal import (
    _DEFAULT,
    EARLY_STOP,
    MAX_BINS,
    MarchParams,
    bin_length,
    bin_weight,
    cell_index,
    grid_position,
    inside,
    ray_interval,
    reciprocal,
    skip_length,
)

CERTAIN = wp.constant(0.999)  # blend weight from which the implicit branch no longer shows in half precision
HARMONICS = 16
MOST_UNROLLED = 64


@dataclass(frozen=True)
class FusedShape:
    """What a fused kernel is compiled for. Sizes of networks are those of the field, not padded.

    levels: of the grid. octaves: of the implicit branch, 0 when there is none. concat: the density head reads both
    branches side by side. width: of hidden layers. geometry: outputs of the density head. color_layers: 2 or 3.
    appearance: length of the code. classes: padded number of classes, 0 without semantics. logits: sum logits instead
    of probabilities.
    """

    levels: int
    octaves: int
    concat: bool
    width: int
    geometry: int
    color_layers: int
    appearance: int
    classes: int
    logits: bool

    @property
    def features(self) -> int:
        return padded(self.levels * 4)

    @property
    def implicit(self) -> tuple[int, ...]:
        return (padded(3 + 6 * self.octaves), self.width, self.features)

    @property
    def density(self) -> tuple[int, ...]:
        return (self.features * (2 if self.concat else 1), self.width, padded(self.geometry))

    @property
    def color(self) -> tuple[int, ...]:
        inputs = padded(self.geometry + HARMONICS + self.appearance)
        return (inputs, *[self.width] * (self.color_layers - 1), GRANULE)

    @property
    def semantic(self) -> tuple[int, ...]:
        """Implicit and explicit features follow the padded geometry, so that all start at a multiple of 16."""
        inputs = padded(self.geometry) + self.features * (2 if self.octaves else 1)
        return (inputs, self.width, self.classes)

    def networks(self) -> dict[str, tuple[int, ...]]:
        """Padded sizes of the networks there are, in the order in which their weights are packed."""
        parts = {"implicit": self.implicit} if self.octaves else {}
        parts |= {"density": self.density, "color": self.color}
        return parts | ({"semantic": self.semantic} if self.classes else {})

    def rows(self) -> dict[str, int]:
        """First row of each network in the packed weights, and their number as "all"."""
        row, first = 0, {}
        for name, sizes in self.networks().items():
            first[name] = row
            row += sum(sizes[1:])
        return {**first, "all": row}

    @property
    def columns(self) -> int:
        return max(max(sizes[:-1]) for sizes in self.networks().values())


@wp.struct
class Ray:
    """One ray on its way: what `march_sample` keeps in local variables."""

    index: int
    origin: wp.vec3
    direction: wp.vec3
    inverse: wp.vec3
    high: float
    share: float
    t: float
    t_last: float  # distance of the last occupied bin
    transmittance: float
    below: float  # weight of the bins behind
    used: float  # part of the present bin given to intervals already
    gathered: float  # occupied length of the next sample's interval so far
    sample: int
    count: int
    ended: int


@wp.struct
class RayQueue:
    """Rays (R,) after the coarse march; `queue` holds those that meet something, `ray_count` (1,) their number, and
    `next_ray` (1,) the place of the next one. counts: samples of each ray."""

    origins: wp.array(dtype=wp.vec3)
    directions: wp.array(dtype=wp.vec3)
    total_weight: wp.array(dtype=float)
    t_first: wp.array(dtype=float)
    counts: wp.array(dtype=int)
    queue: wp.array(dtype=int)
    next_ray: wp.array(dtype=int)
    ray_count: wp.array(dtype=int)


@wp.struct
class FieldArrays:
    """A field as the kernel reads it, see `fused.FusedField`."""

    table: wp.array(dtype=half_feature)
    layout: wp.array2d(dtype=int)
    gains: wp.array(dtype=float)
    evidence: wp.array(dtype=float)
    evidence_side: int
    blend_floor: float
    blend_rate: float
    weights: wp.array2d(dtype=wp.float16)
    code: wp.array(dtype=float)
    density_shift: float
    class_count: int


@wp.struct
class RenderedArrays:
    """What is written: pixels (R, 5) red, green, blue, opacity and depth; probabilities (R, K); evaluated: samples of
    each thread."""

    pixels: wp.array2d(dtype=float)
    probabilities: wp.array2d(dtype=float)
    evaluated: wp.array(dtype=int)


@wp.func
def started(rays: RayQueue, index: int, m: MarchParams):
    """A ray before its first sample."""
    ray = Ray()
    ray.index = index
    ray.origin = rays.origins[index]
    ray.direction = rays.directions[index]
    ray.inverse = reciprocal(ray.direction)
    _, high = ray_interval(ray.origin, ray.inverse, m)
    ray.high = high
    ray.count = rays.counts[index]
    ray.share = rays.total_weight[index] / float(ray.count)
    ray.t = rays.t_first[index]
    ray.t_last = ray.t
    ray.transmittance = 1.0
    return ray


@wp.func
def advanced(ray: Ray, m: MarchParams, cells: wp.array(dtype=wp.vec2), skip_distance: wp.array(dtype=wp.uint8)):
    """The ray after its next sample, with the sample's distance and length."""
    target = (float(ray.sample) + 0.5) * ray.share
    edge = float(ray.sample + 1) * ray.share
    t = float(-1.0)
    length = float(0.0)
    complete = int(0)
    for _ in range(MAX_BINS):
        if complete == 1 or ray.t >= ray.high:
            break
        p = ray.origin + ray.direction * ray.t
        width = bin_length(p, m)
        u = grid_position(p, m.contracted)
        cell = cells[cell_index(u, m.n)]
        if cell[0] > 0.0:
            bin_transmittance = wp.exp(-cell[0] * width)
            weight = bin_weight(cell, ray.transmittance, bin_transmittance, m)
            above = ray.below + weight
            ray.t_last = ray.t
            if t < 0.0 and target <= above:
                t = ray.t + ((target - ray.below) / weight - 0.5) * width
            if edge <= above:
                fraction = (edge - ray.below) / weight
                length = ray.gathered + (fraction - ray.used) * width
                ray.gathered = 0.0
                ray.used = fraction
                complete = 1
            else:
                ray.gathered += (1.0 - ray.used) * width
                ray.used = 0.0
                ray.below = above
                ray.t += width
                if m.mode == _DEFAULT:
                    ray.transmittance *= bin_transmittance
                    if ray.transmittance < EARLY_STOP:
                        ray.t = ray.high
        else:
            ray.t += skip_length(u, ray.direction, ray.inverse, width, m, skip_distance)
    if complete == 0:
        # Rounding left this interval just short of the total; nothing is behind it.
        length = ray.gathered
        ray.gathered = 0.0
        ray.ended = 1
        if t < 0.0:
            t = ray.t_last
    ray.sample += 1
    return ray, t, length


@cache
def fused_kernel(shape: FusedShape, lanes: int) -> wp.Kernel:
    """The kernel for fields of a shape; `lanes` samples a block (1 on the CPU)."""
    grid = grid_encoding(shape.levels, shape.features)
    octaves, classes, logits = shape.octaves, shape.classes, int(shape.logits)
    geometry, geometry_rows, appearance = shape.geometry, padded(shape.geometry), shape.appearance
    features, concat = shape.features, shape.concat
    color_code = shape.geometry + HARMONICS
    rows = shape.rows()
    density_row, color_row = rows["density"], rows["color"]
    implicit_row, semantic_row = rows.get("implicit", 0), rows.get("semantic", 0)
    density_network = network(shape.density, lanes)
    color_network, color_input = network(shape.color, lanes), half_vector(shape.color[0])
    implicit_network = network(shape.implicit, lanes) if octaves else None
    frequencies = frequency_encoding(octaves, shape.implicit[0]) if octaves else None
    semantic_network = network(shape.semantic, lanes) if classes else None
    semantic_input = half_vector(shape.semantic[0])
    density_input, branch_vector = half_vector(shape.density[0]), half_vector(features)
    geometry_vector = half_vector(geometry)
    explicit_row = geometry_rows + (features if octaves else 0)

    def fused_render(
        rays: RayQueue,
        m: MarchParams,
        cells: wp.array(dtype=wp.vec2),
        skip_distance: wp.array(dtype=wp.uint8),
        field: FieldArrays,
        cull: float,
        out: RenderedArrays,
    ):
        lane = wp.tid()
        ray = Ray()
        ray.index = -1
        optical_depth = float(0.0)
        before = float(1.0)
        red = float(0.0)
        green = float(0.0)
        blue = float(0.0)
        opacity = float(0.0)
        distance = float(0.0)
        samples = int(0)
        active_lanes = int(1)
        while active_lanes > 0:
            if ray.index < 0:
                position = wp.atomic_add(rays.next_ray, 0, 1)
                if position < rays.ray_count[0]:
                    r = rays.queue[position]
                    ray = started(rays, r, m)
                    optical_depth = 0.0
                    before = 1.0
                    red = 0.0
                    green = 0.0
                    blue = 0.0
                    opacity = 0.0
                    distance = 0.0
            active = wp.where(ray.index >= 0, 1, 0)
            active_lanes = wp.tile_sum(wp.tile(active))[0]
            if active_lanes > 0:
                t = float(0.0)
                length = float(0.0)
                p = wp.vec3(0.5, 0.5, 0.5)
                if active == 1:
                    ray, t, length = advanced(ray, m, cells, skip_distance)
                    p = inside(grid_position(ray.origin + ray.direction * t, m.contracted))
                    samples += 1
                explicit = grid(p, field.table, field.layout, field.gains)
                implicit = branch_vector()
                hidden = density_input()
                for k in range(features):
                    hidden[k] = explicit[k]
                if wp.static(octaves > 0):
                    w = float(1.0)
                    if active == 1 and field.evidence_side > 0:
                        certainty = trilinear_at(field.evidence, field.evidence_side, p)
                        w = 1.0 - (1.0 - field.blend_floor) * wp.exp(-field.blend_rate * certainty)
                    # Where the whole block is certain of its grid the implicit branch is read only for classes.
                    uncertain_lanes = wp.tile_sum(wp.tile(wp.where(w < CERTAIN, 1, 0)))[0]
                    if uncertain_lanes > 0:
                        smooth = implicit_network(frequencies(p), field.weights, implicit_row)
                        for k in range(features):
                            implicit[k] = wp.float16(smooth[k])
                            if wp.static(concat):
                                hidden[k] = wp.float16(w * float(explicit[k]))
                                hidden[features + k] = wp.float16((1.0 - w) * smooth[k])
                            else:
                                hidden[k] = wp.float16(w * float(explicit[k]) + (1.0 - w) * smooth[k])
                head = density_network(hidden, field.weights, density_row)
                geometry_features = geometry_vector()
                for k in range(geometry):
                    geometry_features[k] = wp.float16(head[k])
                density = wp.exp(wp.clamp(head[0] + field.density_shift, -15.0, 11.0))
                optical_depth += density * length
                after = wp.exp(-optical_depth)
                weight = before - after
                before = after
                visible = wp.where(active == 1 and weight > cull, 1, 0)
                visible_lanes = wp.tile_sum(wp.tile(visible))[0]
                if visible_lanes > 0:
                    x = color_input()
                    for k in range(geometry):
                        x[k] = geometry_features[k]
                    sh = spherical_harmonics(ray.direction)
                    for k in range(HARMONICS):
                        x[geometry + k] = wp.float16(sh[k])
                    for k in range(appearance):
                        x[color_code + k] = wp.float16(field.code[k])
                    color = color_network(x, field.weights, color_row)
                    if visible == 1:
                        red += weight / (1.0 + wp.exp(-color[0]))
                        green += weight / (1.0 + wp.exp(-color[1]))
                        blue += weight / (1.0 + wp.exp(-color[2]))
                        opacity += weight
                        distance += weight * t
                    if wp.static(classes > 0):
                        y = semantic_input()
                        for k in range(geometry):
                            y[k] = geometry_features[k]
                        if wp.static(octaves > 0):
                            if uncertain_lanes == 0:
                                smooth = implicit_network(frequencies(p), field.weights, implicit_row)
                                for k in range(features):
                                    implicit[k] = wp.float16(smooth[k])
                            for k in range(features):
                                y[geometry_rows + k] = implicit[k]
                        for k in range(features):
                            y[explicit_row + k] = explicit[k]
                        scores = semantic_network(y, field.weights, semantic_row)
                        if visible == 1:
                            if wp.static(logits == 0):
                                largest = float(-1.0e30)
                                for k in range(classes):
                                    largest = wp.where(k < field.class_count, wp.max(largest, scores[k]), largest)
                                sum = float(0.0)
                                for k in range(classes):
                                    e = wp.where(k < field.class_count, wp.exp(scores[k] - largest), 0.0)
                                    scores[k] = e
                                    sum += e
                                scores = scores / sum
                            for k in range(classes):
                                if k < field.class_count:
                                    out.probabilities[ray.index, k] = (
                                        out.probabilities[ray.index, k] + weight * scores[k]
                                    )
                if active == 1 and (ray.ended == 1 or ray.sample >= ray.count or before < EARLY_STOP):
                    out.pixels[ray.index, 0] = red
                    out.pixels[ray.index, 1] = green
                    out.pixels[ray.index, 2] = blue
                    out.pixels[ray.index, 3] = opacity
                    out.pixels[ray.index, 4] = distance
                    ray.index = -1
        out.evaluated[lane] = samples

    classes_text = f"{classes}{'l' if logits else ''}"
    joined = f"{octaves}{'c' if concat else ''}"
    name = (
        f"fieldwork_fused_{shape.levels}_{joined}_{shape.width}_{geometry}_{shape.color_layers}_{appearance}"
        f"_{classes_text}_{lanes}"
    )
    kernel = wp.kernel(fused_render, name="fused_render", module=name, launch_bounds=lanes, grid_stride=False)
    # Vectors indexed in loops that are not unrolled would live in local memory.
    kernel.module.options["max_unroll"] = MOST_UNROLLED
    return kernel
