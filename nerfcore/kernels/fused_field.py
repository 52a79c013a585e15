"""Device functions that read the field for a warp of samples: features, density, colour and classes.

They are made for a `FusedShape`. Every thread of a warp calls them together, also those without a sample, because
networks are shared (`fused_network`). `memory` is a block's shared memory: matrices, then a row of each thread.
"""

from functools import cache
from typing import Any

import warp as wp

from .cells import trilinear_at
from .encode import FEATURES
from .fused_encoding import frequency_encoding, grid_encoding, half_feature, put, spherical_harmonics
from .fused_network import (
    any_of_warp,
    network,
    network_to_pixels,
    network_to_row,
    output,
    packed_size,
    padded,
    read_head,
    row_length,
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
    weights: wp.array(dtype=wp.float16)
    code: wp.array(dtype=float)
    density_shift: float
    thinning: int
    class_count: int


def shape_name(shape: FusedShape, number: int) -> str:
    """A name for what is compiled for a shape and a number, as part of an identifier."""
    classes = f"{shape.classes}{'l' if shape.logits else ''}"
    joined = f"{shape.octaves}{'c' if shape.concat else ''}"
    return (
        f"{shape.levels}_{joined}_{shape.width}_{shape.geometry}_{shape.color_layers}_{shape.appearance}"
        f"_{classes}_{number}"
    )


def density_row(shape: FusedShape) -> int:
    """Numbers of a thread's row for the density."""
    return row_length(*((shape.implicit, shape.density) if shape.octaves else (shape.density,)))


def color_row(shape: FusedShape) -> int:
    """The same for the colour."""
    return row_length(shape.color)


def class_row(shape: FusedShape) -> int:
    """The same for the classes, whose scores never lie in it."""
    return row_length(*((shape.implicit,) if shape.octaves else ()), (shape.semantic[0], 0))


@cache
def _explicit(shape: FusedShape) -> Any:
    """A device function: point in [0, 1]³ → features of the grid, see `grid_encoding`; what is beyond them is zeroed."""
    encoding, used, features = grid_encoding(shape.levels), shape.levels * FEATURES, shape.features

    def explicit_features(p: wp.vec3, field: FieldArrays, memory: Any, place: int, share: float, added: int):
        encoding(p, field.table, field.layout, field.gains, memory, place, share, added)
        for k in range(used, features):
            put(memory, place + k, wp.float16(0.0))

    return wp.func(explicit_features, name=f"explicit_features_{shape.levels}")


@cache
def _implicit(shape: FusedShape, length: int) -> Any:
    """A device function: point in [0, 1]³ → features of the implicit branch, times `share`, in the thread's row from
    number `place` on; overwrites the row from its beginning. The branch's matrices lie at the beginning of `memory`."""
    sizes, first = shape.implicit, shape.places()["implicit"]
    frequencies, features = frequency_encoding(shape.octaves, sizes[0]), network_to_row(sizes, length)

    def implicit_features(p: wp.vec3, field: FieldArrays, memory: Any, row: int, place: int, share: float):
        frequencies(p, memory, row)
        features(memory, row, 0, field.weights, first, place, share)

    return wp.func(implicit_features, name=f"implicit_features_{shape.octaves}_{shape.width}_{shape.features}_{length}")


@wp.func
def grid_share(p: wp.vec3, active: int, field: FieldArrays):
    """How much of the features at a point the grid gives, 1 where there is no sample; see `field.blend`."""
    share = float(1.0)
    if active == 1 and field.evidence_side > 0:
        certainty = trilinear_at(field.evidence, field.evidence_side, p)
        share = 1.0 - (1.0 - field.blend_floor) * wp.exp(-field.blend_rate * certainty)
    return share


@cache
def _joined(shape: FusedShape, length: int) -> Any:
    """A device function: point, active → the input of the density head at the beginning of the thread's row: blended
    features; or those of the grid and of the implicit branch, each weighed by its share, one after the other."""
    features, concat, branches = shape.features, shape.concat, bool(shape.octaves)
    explicit_features = _explicit(shape)
    implicit_features = _implicit(shape, length) if shape.octaves else None
    place = features if concat else 0

    def joined_features(p: wp.vec3, active: int, field: FieldArrays, memory: Any, row: int):
        if wp.static(branches):
            w = grid_share(p, active, field)
            added = int(0)
            # Where the whole warp is certain of its grid the implicit branch is not read.
            if any_of_warp(wp.where(w < CERTAIN, 1, 0)) != 0:
                implicit_features(p, field, memory, row, place, 1.0 - w)
                added = wp.static(0 if concat else 1)
            else:
                w = 1.0
                if wp.static(concat):
                    for k in range(features):
                        put(memory, row + features + k, wp.float16(0.0))
            explicit_features(p, field, memory, row, w, added)
        else:
            explicit_features(p, field, memory, row, 1.0, 0)

    return wp.func(joined_features, name=f"joined_features_{shape_name(shape, length)}")


@wp.func
def thinning(p: wp.vec3):
    """See `geometry.contraction.thinning`."""
    away = wp.max(wp.abs(p[0] - 0.5), wp.max(wp.abs(p[1] - 0.5), wp.abs(p[2] - 0.5)))
    share = wp.clamp(2.0 - 4.0 * away, 0.0, 1.0)
    return share * share


@cache
def density_function(shape: FusedShape) -> Any:
    """A device function: point, active → density per normalised unit length; the features for the other heads are left
    in the thread's row as `network` leaves them. The matrices of the implicit branch and of the density head lie one
    after the other at the beginning of `memory`."""
    sizes, length, first = shape.density, density_row(shape), shape.places()["density"]
    features, head = _joined(shape, length), network(sizes, length)

    def density(p: wp.vec3, active: int, field: FieldArrays, memory: Any, row: int):
        # Before the networks: the point need not be kept until after them.
        thinned = wp.where(field.thinning == 1, thinning(p), 1.0)
        features(p, active, field, memory, row)
        head(memory, row, first, field.weights, first)
        return thinned * wp.exp(wp.clamp(output(memory, row, 0) + field.density_shift, -15.0, 11.0))

    return wp.func(density, name=f"density_{shape_name(shape, length)}")


@cache
def color_function(shape: FusedShape) -> Any:
    """A device function: features for the heads, at the beginning of the thread's row, and the ray's direction → logits
    of red, green and blue. The matrices of the colour head lie at the beginning of `memory`."""
    sizes, length, first = shape.color, color_row(shape), shape.places()["color"]
    geometry, appearance, code = shape.geometry, shape.appearance, shape.geometry + HARMONICS
    head, used, inputs = network(sizes, length), code + appearance, sizes[0]

    def color(direction: wp.vec3, field: FieldArrays, memory: Any, row: int):
        sh = spherical_harmonics(direction)
        for k in range(HARMONICS):
            put(memory, row + geometry + k, wp.float16(sh[k]))
        for k in range(appearance):
            put(memory, row + code + k, wp.float16(field.code[k]))
        for k in range(used, inputs):
            put(memory, row + k, wp.float16(0.0))
        head(memory, row, 0, field.weights, first)
        return wp.vec3(output(memory, row, 0), output(memory, row, 1), output(memory, row, 2))

    return wp.func(color, name=f"color_{shape_name(shape, length)}")


@cache
def class_function(shape: FusedShape) -> Any:
    """A device function: of the visible sample `index`, at a point, the scores times `weight`, probabilities or logits,
    added to row `pixel` of `pixels`. The matrices of the implicit branch and of the class head lie one after the other
    at the beginning of `memory`."""
    sizes, length, first = shape.semantic, class_row(shape), shape.places()["semantic"]
    held, branches = packed_size(shape.implicit) if shape.octaves else 0, bool(shape.octaves)
    implicit_row = padded(shape.geometry)
    explicit_row = implicit_row + (shape.features if branches else 0)
    explicit_features, head = _explicit(shape), read_head(shape.geometry)
    implicit_features = _implicit(shape, length) if shape.octaves else None
    scores = network_to_pixels(sizes, length, shape.logits)

    def classes(
        p: wp.vec3,
        features: wp.array2d(dtype=wp.float16),
        index: int,
        field: FieldArrays,
        memory: Any,
        row: int,
        pixels: wp.array2d(dtype=float),
        pixel: int,
        weight: float,
    ):
        if wp.static(branches):
            implicit_features(p, field, memory, row, implicit_row, 1.0)
        head(memory, row, features, index)
        explicit_features(p, field, memory, row + explicit_row, 1.0, 0)
        scores(memory, row, held, field.weights, first, pixels, pixel, weight, field.class_count)

    return wp.func(classes, name=f"classes_{shape_name(shape, length)}")
