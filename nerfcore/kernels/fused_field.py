"""Device functions that read the field for a block of samples: features, density, colour and classes.

They are made for a `FusedShape` and a number of lanes. Every thread of a block calls them together, also those without
a sample, because layers are shared (`fused_network`).
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from .cells import trilinear_at
from .fused_network import (
    frequency_encoding,
    grid_encoding,
    half_feature,
    half_vector,
    network,
    padded,
    spherical_harmonics,
)
from .fused_shape import HARMONICS, FusedShape

CERTAIN = wp.constant(0.999)  # blend weight from which the implicit branch no longer shows in half precision


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
    thinning: int
    class_count: int


@dataclass(frozen=True)
class FieldFunctions:
    """Device functions of one shape; each takes the field's arrays last.

    grid: point in [0, 1]³ → features of the grid. blended: point, active, features of the grid → input of the density
    head, features of the implicit branch and the number of the block's samples that need them; where that is 0 they
    were not read; None without an implicit branch. density: its input and the point → features for the other heads, and
    density per normalised unit length. color: those features and the ray's direction → logits of red, green and blue. classes:
    features for the heads, of the grid and of the implicit branch, whether those were read, and the point → scores;
    None without classes.
    """

    grid: Any
    blended: Any
    density: Any
    color: Any
    classes: Any


def shape_name(shape: FusedShape, lanes: int) -> str:
    """A name for what is compiled for a shape, as part of an identifier."""
    classes = f"{shape.classes}{'l' if shape.logits else ''}"
    joined = f"{shape.octaves}{'c' if shape.concat else ''}"
    return (
        f"{shape.levels}_{joined}_{shape.width}_{shape.geometry}_{shape.color_layers}_{shape.appearance}"
        f"_{classes}_{lanes}"
    )


@cache
def field_functions(shape: FusedShape, lanes: int) -> FieldFunctions:
    """The functions for fields of a shape; `lanes` samples a block (1 on the CPU)."""
    smooth = _smooth(shape, lanes) if shape.octaves else None
    blended = _blended(shape, lanes, smooth) if shape.octaves else None
    return FieldFunctions(
        _grid(shape, lanes),
        blended,
        _density(shape, lanes),
        _color(shape, lanes),
        _classes(shape, lanes, smooth) if shape.classes else None,
    )


def _grid(shape: FusedShape, lanes: int) -> Any:
    encoding = grid_encoding(shape.levels, shape.features)

    def grid_features(p: wp.vec3, field: FieldArrays):
        return encoding(p, field.table, field.layout, field.gains)

    return wp.func(grid_features, name=f"grid_features_{shape_name(shape, lanes)}")


def _smooth(shape: FusedShape, lanes: int) -> Any:
    frequencies = frequency_encoding(shape.octaves, shape.implicit[0])
    implicit_network, row = network(shape.implicit, lanes), shape.rows()["implicit"]

    def smooth_features(p: wp.vec3, field: FieldArrays):
        return implicit_network(frequencies(p), field.weights, row)

    return wp.func(smooth_features, name=f"smooth_features_{shape_name(shape, lanes)}")


@wp.func
def grid_share(p: wp.vec3, active: int, field: FieldArrays):
    """How much of the features at a point the grid gives, 1 where there is no sample; see `field.blend`."""
    share = float(1.0)
    if active == 1 and field.evidence_side > 0:
        certainty = trilinear_at(field.evidence, field.evidence_side, p)
        share = 1.0 - (1.0 - field.blend_floor) * wp.exp(-field.blend_rate * certainty)
    return share


def _blended(shape: FusedShape, lanes: int, smooth_features: Any) -> Any:
    features, concat = shape.features, shape.concat
    density_input, branch = half_vector(shape.density[0]), half_vector(features)

    def blended_features(p: wp.vec3, active: int, explicit: branch, field: FieldArrays):
        implicit = branch()
        joined = density_input()
        for k in range(features):
            joined[k] = explicit[k]
        w = grid_share(p, active, field)
        # Where the whole block is certain of its grid the implicit branch is read only for classes.
        uncertain_lanes = wp.tile_sum(wp.tile(wp.where(w < CERTAIN, 1, 0)))[0]
        if uncertain_lanes > 0:
            smooth = smooth_features(p, field)
            for k in range(features):
                implicit[k] = wp.float16(smooth[k])
                if wp.static(concat):
                    joined[k] = wp.float16(w * float(explicit[k]))
                    joined[features + k] = wp.float16((1.0 - w) * smooth[k])
                else:
                    joined[k] = wp.float16(w * float(explicit[k]) + (1.0 - w) * smooth[k])
        return joined, implicit, uncertain_lanes

    return wp.func(blended_features, name=f"blended_features_{shape_name(shape, lanes)}")


@wp.func
def thinning(p: wp.vec3):
    """See `geometry.contraction.thinning`."""
    away = wp.max(wp.abs(p[0] - 0.5), wp.max(wp.abs(p[1] - 0.5), wp.abs(p[2] - 0.5)))
    share = wp.clamp(2.0 - 4.0 * away, 0.0, 1.0)
    return share * share


def _density(shape: FusedShape, lanes: int) -> Any:
    head_network, row = network(shape.density, lanes), shape.rows()["density"]
    geometry, vector, head_input = shape.geometry, half_vector(shape.geometry), half_vector(shape.density[0])

    def density(x: head_input, p: wp.vec3, field: FieldArrays):
        head = head_network(x, field.weights, row)
        out = vector()
        for k in range(geometry):
            out[k] = wp.float16(head[k])
        sigma = wp.exp(wp.clamp(head[0] + field.density_shift, -15.0, 11.0))
        if field.thinning == 1:
            sigma *= thinning(p)
        return out, sigma

    return wp.func(density, name=f"density_{shape_name(shape, lanes)}")


def _color(shape: FusedShape, lanes: int) -> Any:
    head_network, row, vector = network(shape.color, lanes), shape.rows()["color"], half_vector(shape.color[0])
    geometry, appearance, code = shape.geometry, shape.appearance, shape.geometry + HARMONICS
    geometry_vector = half_vector(geometry)

    def color(features: geometry_vector, direction: wp.vec3, field: FieldArrays):
        x = vector()
        for k in range(geometry):
            x[k] = features[k]
        sh = spherical_harmonics(direction)
        for k in range(HARMONICS):
            x[geometry + k] = wp.float16(sh[k])
        for k in range(appearance):
            x[code + k] = wp.float16(field.code[k])
        out = head_network(x, field.weights, row)
        return wp.vec3(out[0], out[1], out[2])

    return wp.func(color, name=f"color_{shape_name(shape, lanes)}")


def _classes(shape: FusedShape, lanes: int, smooth_features: Any) -> Any:
    head_network, row, vector = network(shape.semantic, lanes), shape.rows()["semantic"], half_vector(shape.semantic[0])
    geometry, features, logits, classes = shape.geometry, shape.features, shape.logits, shape.classes
    implicit_row, branches = padded(geometry), bool(shape.octaves)
    explicit_row = implicit_row + (features if branches else 0)
    geometry_vector, branch = half_vector(geometry), half_vector(features)

    def class_scores(
        head: geometry_vector, explicit: branch, implicit: branch, was_read: int, p: wp.vec3, field: FieldArrays
    ):
        x = vector()
        for k in range(geometry):
            x[k] = head[k]
        for k in range(features):
            x[explicit_row + k] = explicit[k]
        if wp.static(branches):
            for k in range(features):
                x[implicit_row + k] = implicit[k]
            if was_read == 0:
                smooth = smooth_features(p, field)
                for k in range(features):
                    x[implicit_row + k] = wp.float16(smooth[k])
        scores = head_network(x, field.weights, row)
        if wp.static(not logits):
            largest = float(-1.0e30)
            for k in range(classes):
                largest = wp.where(k < field.class_count, wp.max(largest, scores[k]), largest)
            total = float(0.0)
            for k in range(classes):
                e = wp.where(k < field.class_count, wp.exp(scores[k] - largest), 0.0)
                scores[k] = e
                total += e
            scores = scores / total
        return scores

    return wp.func(class_scores, name=f"class_scores_{shape_name(shape, lanes)}")
