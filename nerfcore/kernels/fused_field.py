"""Device functions that read the field for a block of samples: features, density, colour and classes.

They are made for a `FusedShape` and a number of lanes. Every thread of a block calls them together, also those without
a sample, because layers are shared (`fused_network`).
"""

from functools import cache
from typing import Any

import warp as wp

from .cells import trilinear_at
from .encode import FEATURES
from .fused_network import (
    frequency_encoding,
    grid_encoding,
    half_feature,
    half_vector,
    hidden_layers,
    last_layer,
    layer,
    padded,
    put,
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
    weights: wp.array(dtype=wp.float16)
    code: wp.array(dtype=float)
    density_shift: float
    thinning: int
    class_count: int


def shape_name(shape: FusedShape, lanes: int) -> str:
    """A name for what is compiled for a shape, as part of an identifier."""
    classes = f"{shape.classes}{'l' if shape.logits else ''}"
    joined = f"{shape.octaves}{'c' if shape.concat else ''}"
    return (
        f"{shape.levels}_{joined}_{shape.width}_{shape.geometry}_{shape.color_layers}_{shape.appearance}"
        f"_{classes}_{lanes}"
    )


def input_rows(*networks: tuple[int, ...]) -> int:
    """Rows of the tile from which networks of these sizes take their input, see `hidden_layers`."""
    return max(rows for sizes in networks for rows in (sizes[0], *sizes[2:-1]))


@cache
def _explicit(shape: FusedShape) -> Any:
    """A device function: point in [0, 1]³ → features of the grid, see `grid_encoding`; rows beyond them are zeroed."""
    encoding, used, features = grid_encoding(shape.levels), shape.levels * FEATURES, shape.features

    def explicit_features(p: wp.vec3, field: FieldArrays, into: Any, place: int, share: float, added: int):
        encoding(p, field.table, field.layout, field.gains, into, place, share, added)
        for k in range(used, features):
            put(into, place + k, wp.float16(0.0))

    return wp.func(explicit_features, name=f"explicit_features_{shape.levels}")


@cache
def _implicit(shape: FusedShape, lanes: int) -> Any:
    """A device function: point in [0, 1]³ → features of the implicit branch, times `share`, in rows of the tile `x`
    from `place` on; overwrites all of `x`, and `inner`."""
    sizes, first = shape.implicit, shape.places()["implicit"]
    frequencies, hidden = frequency_encoding(shape.octaves, sizes[0]), hidden_layers(sizes, lanes)
    last, later = layer(sizes[1], sizes[2], lanes, False), first + sizes[0] * sizes[1]

    def implicit_features(p: wp.vec3, field: FieldArrays, x: Any, inner: Any, place: int, share: float):
        frequencies(p, x)
        hidden(x, field.weights, first, inner)
        last(inner, field.weights, later, x, place, share)

    return wp.func(implicit_features, name=f"implicit_features_{shape_name(shape, lanes)}")


@wp.func
def grid_share(p: wp.vec3, active: int, field: FieldArrays):
    """How much of the features at a point the grid gives, 1 where there is no sample; see `field.blend`."""
    share = float(1.0)
    if active == 1 and field.evidence_side > 0:
        certainty = trilinear_at(field.evidence, field.evidence_side, p)
        share = 1.0 - (1.0 - field.blend_floor) * wp.exp(-field.blend_rate * certainty)
    return share


@cache
def _joined(shape: FusedShape, lanes: int) -> Any:
    """A device function: point, active → the input of the density head in the first rows of the tile `x`: blended
    features; or those of the grid and of the implicit branch, each weighed by its share, one after the other."""
    features, concat, branches = shape.features, shape.concat, bool(shape.octaves)
    explicit_features = _explicit(shape)
    implicit_features = _implicit(shape, lanes) if shape.octaves else None
    place = features if concat else 0

    def joined_features(p: wp.vec3, active: int, field: FieldArrays, x: Any, inner: Any):
        if wp.static(branches):
            w = grid_share(p, active, field)
            added = int(0)
            # Where the whole block is certain of its grid the implicit branch is not read.
            if wp.tile_sum(wp.tile(wp.where(w < CERTAIN, 1, 0)))[0] > 0:
                implicit_features(p, field, x, inner, place, 1.0 - w)
                added = wp.static(0 if concat else 1)
            else:
                w = 1.0
                if wp.static(concat):
                    for k in range(features):
                        put(x, features + k, wp.float16(0.0))
            explicit_features(p, field, x, 0, w, added)
        else:
            explicit_features(p, field, x, 0, 1.0, 0)

    return wp.func(joined_features, name=f"joined_features_{shape_name(shape, lanes)}")


@wp.func
def thinning(p: wp.vec3):
    """See `geometry.contraction.thinning`."""
    away = wp.max(wp.abs(p[0] - 0.5), wp.max(wp.abs(p[1] - 0.5), wp.abs(p[2] - 0.5)))
    share = wp.clamp(2.0 - 4.0 * away, 0.0, 1.0)
    return share * share


@cache
def density_function(shape: FusedShape, lanes: int) -> Any:
    """A device function: point, active → features for the other heads (geometry,) half, and density per normalised
    unit length."""
    sizes, first, geometry = shape.density, shape.places()["density"], shape.geometry
    networks = (shape.implicit, sizes) if shape.octaves else (sizes,)
    rows, width, vector = input_rows(*networks), sizes[1], half_vector(geometry)
    features, hidden = _joined(shape, lanes), hidden_layers(sizes, lanes)
    last, later = last_layer(sizes[1], sizes[2], lanes), first + sizes[0] * sizes[1]

    def density(p: wp.vec3, active: int, field: FieldArrays):
        x = wp.tile_empty(shape=(rows, lanes), dtype=wp.float16, storage="shared")
        inner = wp.tile_empty(shape=(width, lanes), dtype=wp.float16, storage="shared")
        # Before the networks: the point need not be kept until after them.
        thinned = wp.where(field.thinning == 1, thinning(p), 1.0)
        features(p, active, field, x, inner)
        hidden(x, field.weights, first, inner)
        head = last(inner, field.weights, later)
        out = vector()
        for k in range(geometry):
            out[k] = wp.float16(head[k])
        return out, thinned * wp.exp(wp.clamp(head[0] + field.density_shift, -15.0, 11.0))

    return wp.func(density, name=f"density_{shape_name(shape, lanes)}")


@cache
def color_function(shape: FusedShape, lanes: int) -> Any:
    """A device function: features for the heads and the ray's direction → logits of red, green and blue."""
    sizes, first = shape.color, shape.places()["color"]
    geometry, appearance, code = shape.geometry, shape.appearance, shape.geometry + HARMONICS
    hidden, last = hidden_layers(sizes, lanes), last_layer(sizes[-2], sizes[-1], lanes)
    later, vector = first + sum(a * b for a, b in zip(sizes[:-2], sizes[1:-1])), half_vector(geometry)
    rows, width, used, inputs = input_rows(sizes), sizes[1], code + appearance, sizes[0]

    def color(features: vector, direction: wp.vec3, field: FieldArrays):
        x = wp.tile_empty(shape=(rows, lanes), dtype=wp.float16, storage="shared")
        inner = wp.tile_empty(shape=(width, lanes), dtype=wp.float16, storage="shared")
        for k in range(geometry):
            put(x, k, features[k])
        sh = spherical_harmonics(direction)
        for k in range(HARMONICS):
            put(x, geometry + k, wp.float16(sh[k]))
        for k in range(appearance):
            put(x, code + k, wp.float16(field.code[k]))
        for k in range(used, inputs):
            put(x, k, wp.float16(0.0))
        hidden(x, field.weights, first, inner)
        out = last(inner, field.weights, later)
        return wp.vec3(out[0], out[1], out[2])

    return wp.func(color, name=f"color_{shape_name(shape, lanes)}")


@cache
def class_function(shape: FusedShape, lanes: int) -> Any:
    """A device function: features for the heads and the point → scores (classes,) float, probabilities or logits."""
    sizes, first = shape.semantic, shape.places()["semantic"]
    hidden, last = hidden_layers(sizes, lanes), last_layer(sizes[1], sizes[2], lanes)
    later, branches = first + sizes[0] * sizes[1], bool(shape.octaves)
    geometry, features, logits, classes = shape.geometry, shape.features, shape.logits, shape.classes
    implicit_row = padded(geometry)
    explicit_row = implicit_row + (features if branches else 0)
    rows = input_rows(shape.implicit, sizes) if branches else input_rows(sizes)
    explicit_features = _explicit(shape)
    implicit_features = _implicit(shape, lanes) if shape.octaves else None
    width, vector = sizes[1], half_vector(geometry)

    def class_scores(head: vector, p: wp.vec3, field: FieldArrays):
        x = wp.tile_empty(shape=(rows, lanes), dtype=wp.float16, storage="shared")
        inner = wp.tile_empty(shape=(width, lanes), dtype=wp.float16, storage="shared")
        if wp.static(branches):
            implicit_features(p, field, x, inner, implicit_row, 1.0)
        for k in range(geometry):
            put(x, k, head[k])
        for k in range(geometry, implicit_row):
            put(x, k, wp.float16(0.0))
        explicit_features(p, field, x, explicit_row, 1.0, 0)
        hidden(x, field.weights, first, inner)
        scores = last(inner, field.weights, later)
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
