"""The trained field as an ONNX graph: any program with an ONNX runtime can ask it for density, colour and classes.

Inputs: `points` (N, 3) in the world, `directions` (N, 3) unit vectors from the eye to the point, in the world.
Outputs: `density` (N) per world unit, `color` (N, 3) sRGB in [0, 1], and with classes `probabilities` (N, K) in the
order of the metadata `class_ids`, `class_names`. All float32.

Only operators that TensorRT takes as well, which knows none on bits of integers.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from .. import __version__
from ..data.box import Box
from ..field.blend import RESOLUTION, BlendWeight
from ..field.grid import VertexGrid
from ..field.hybrid import HybridField
from ..field.mlp import MLP
from ..files import atomic_path
from ..geometry.similarity import similarity_scale
from ..kernels.encode_torch import PRIMES
from ..project.schema import Project
from ..render.run import Trained

OPSET = 18
Rows = Callable[[int, int, int], str]  # of the corner (dx, dy, dz) of a cell


def write_onnx(path: Path, trained: Trained, project: Project) -> None:
    """Write the field of a run. Raises DiskError."""
    model = field_model(trained.model.field, trained.info.box(project))
    names = {c.id: c.name for c in project.classes}
    ids = trained.info.class_ids if trained.model.field.classes else []
    helper.set_model_props(
        model,
        {
            "class_ids": json.dumps(ids),
            "class_names": json.dumps([names.get(i, str(i)) for i in ids], ensure_ascii=False),
            "world_from_box": json.dumps(trained.info.box(project).world_from_box.tolist()),
        },
    )
    with atomic_path(path) as temporary:
        onnx.save_model(model, str(temporary))


def field_model(field: HybridField, box: Box) -> onnx.ModelProto:
    """The graph of a field in its cube (see the module's text)."""
    g = _Graph()
    points = _grid_position(g, box)
    explicit = None if field.grid is None else _encode(g, field.grid, field.gains, points)
    implicit = None
    if field.implicit is not None:
        implicit = _network(g, field.implicit, _frequencies(g, points, field.config.octaves))
    hidden = _blend(g, field, points, explicit, implicit)
    out = _network(g, field.density_head, hidden)
    exponent = g.add("Add", g.slice(out, 0, 1), g.const(field.config.density_shift))
    density = g.add("Exp", g.add("Clip", exponent, g.const(-15.0), g.const(11.0)))
    density = g.add("Div", density, g.const(similarity_scale(box.world_from_box)))
    if field.thinning:
        density = g.add("Mul", density, _thinning(g, points))
    g.add("Squeeze", density, g.const([1], np.int64), name="density")
    parts = [out, _harmonics(g, box)]
    if field.config.appearance:
        code = torch.zeros(field.config.appearance) if field.appearance is None else field.appearance.mean(0)
        # As many rows as there are points.
        parts.append(g.add("Add", g.add("Mul", g.slice(out, 0, 1), g.const(0.0)), g.const(code.detach().cpu().numpy())))
    g.add("Sigmoid", _network(g, field.color_head, g.join(parts)), name="color")
    outputs = [("density", ["N"]), ("color", ["N", 3])]
    if field.semantic_head is not None:
        branches = [part for part in (implicit, explicit) if part is not None]
        logits = _network(g, field.semantic_head, g.join([out, *branches]))
        g.add("Softmax", logits, name="probabilities", axis=1)
        outputs.append(("probabilities", ["N", field.classes]))
    value = lambda name, shape: helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)  # noqa: E731
    graph = helper.make_graph(
        g.nodes,
        "fieldwork",
        [value("points", ["N", 3]), value("directions", ["N", 3])],
        [value(name, shape) for name, shape in outputs],
        g.initializers,
    )
    opset = helper.make_opsetid("", OPSET)
    model = helper.make_model(graph, producer_name="fieldwork", producer_version=__version__, opset_imports=[opset])
    model.ir_version = helper.find_min_ir_version_for([opset])
    return model


class _Graph:
    """Nodes and constants, with names that are counted."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: list[onnx.TensorProto] = []

    def const(self, value: Any, dtype: Any = np.float32) -> str:
        name = f"c{len(self.initializers)}"
        self.initializers.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def add(self, kind: str, *inputs: str, name: str = "", **attributes: Any) -> str:
        name = name or f"n{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    def slice(self, value: str, begin: int, end: int) -> str:
        """Columns of a matrix."""
        bounds = [self.const([number], np.int64) for number in (begin, end, 1)]
        return self.add("Slice", value, *bounds)

    def join(self, parts: list[str]) -> str:
        return parts[0] if len(parts) == 1 else self.add("Concat", *parts, axis=1)


def _grid_position(g: _Graph, box: Box) -> str:
    """World points to grid coordinates in [0, 1]³ (as kernels/traversal.py)."""
    matrix = box.box_from_world
    p = g.add("Add", g.add("MatMul", "points", g.const(matrix[:3, :3].T)), g.const(matrix[:3, 3]))
    if not box.contracted:
        scaled = g.add("Mul", p, g.const(0.5))
    else:
        r = g.add("ReduceMax", g.add("Abs", p), g.const([1], np.int64), keepdims=1)
        r = g.add("Max", r, g.const(1.0))
        shrink = g.add("Div", g.add("Sub", g.const(2.0), g.add("Reciprocal", r)), r)
        scaled = g.add("Mul", g.add("Mul", p, shrink), g.const(0.25))
    return g.add("Clip", g.add("Add", scaled, g.const(0.5)), g.const(0.0), g.const(1.0))


def _thinning(g: _Graph, points: str) -> str:
    """As geometry/contraction.py, (N, 1)."""
    away = g.add("Abs", g.add("Sub", points, g.const(0.5)))
    away = g.add("ReduceMax", away, g.const([1], np.int64), keepdims=1)
    share = g.add("Sub", g.const(2.0), g.add("Mul", away, g.const(4.0)))
    share = g.add("Clip", share, g.const(0.0), g.const(1.0))
    return g.add("Mul", share, share)


def _corners(g: _Graph, scaled: str, last: int) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """For each axis the indices (low, high) of the two vertices around positions in cells, (N, 1) int64, and the
    weights of them."""
    floor = g.add("Clip", g.add("Floor", scaled), g.const(0.0), g.const(float(last)))
    share = g.add("Clip", g.add("Sub", scaled, floor), g.const(0.0), g.const(1.0))
    rest = g.add("Sub", g.const(1.0), share)
    low = g.add("Cast", floor, to=TensorProto.INT64)
    high = g.add("Add", low, g.const(1, np.int64))
    columns = lambda value: [g.slice(value, k, k + 1) for k in range(3)]  # noqa: E731
    return list(zip(columns(low), columns(high))), list(zip(columns(rest), columns(share)))


def _dense_rows(g: _Graph, index: list[tuple[str, str]], side: int) -> Rows:
    """Rows of the vertices of a cell in a table of side³."""
    axes = [
        [i if f == 1 else g.add("Mul", i, g.const(f, np.int64)) for i in index[axis]]
        for axis, f in enumerate((1, side, side * side))
    ]
    return lambda dx, dy, dz: g.add("Add", g.add("Add", axes[0][dx], axes[1][dy]), axes[2][dz])


def _hashed_rows(g: _Graph, index: list[tuple[str, str]], size: int) -> Rows:
    """Rows of the vertices of a cell in a hashed table, whose size is a power of two: the exclusive or of one number for
    each axis. With 1 and −1 for the bits 0 and 1 it is a product, and the row a sum of bits, exact in float32."""
    powers = 2 ** np.arange(size.bit_length() - 1)

    def signs(vertex: str, factor: int) -> str:
        number = vertex if factor == 1 else g.add("Mul", vertex, g.const(factor, np.int64))
        number = g.add("Mod", number, g.const(size, np.int64))
        bits = g.add("Mod", g.add("Div", number, g.const(powers, np.int64)), g.const(2, np.int64))
        return g.add("Sub", g.const(1.0), g.add("Mul", g.add("Cast", bits, to=TensorProto.FLOAT), g.const(2.0)))

    axes = [[signs(vertex, factor) for vertex in index[axis]] for axis, factor in enumerate(PRIMES)]
    worth, middle = g.const(-powers[:, None] / 2), g.const((size - 1) / 2)

    def rows(dx: int, dy: int, dz: int) -> str:
        product = g.add("Mul", g.add("Mul", axes[0][dx], axes[1][dy]), axes[2][dz])
        return g.add("Cast", g.add("Add", g.add("MatMul", product, worth), middle), to=TensorProto.INT64)

    return rows


def _trilinear(g: _Graph, table: str, rows: Rows, weights: list[tuple[str, str]]) -> str:
    """Sum over the eight corners of weight · table[rows(dx, dy, dz)]."""
    total = ""
    for corner in range(8):
        dx, dy, dz = corner & 1, corner >> 1 & 1, corner >> 2
        weight = g.add("Mul", g.add("Mul", weights[0][dx], weights[1][dy]), weights[2][dz])
        values = g.add("Gather", table, g.add("Squeeze", rows(dx, dy, dz), g.const([1], np.int64)), axis=0)
        part = g.add("Mul", values, weight)
        total = g.add("Add", total, part) if total else part
    return total


def _encode(g: _Graph, grid: VertexGrid, gains: list[float], points: str) -> str:
    """The explicit features (as kernels/encode_torch.py)."""
    features = []
    for (resolution, base, size), gain in zip(grid.levels, gains):
        scaled = g.add("Mul", points, g.const(float(resolution - 1)))
        index, weights = _corners(g, scaled, resolution - 2)
        table = g.const(grid.table[base : base + size].detach().cpu().numpy() * gain)
        rows = _dense_rows(g, index, resolution) if resolution**3 <= size else _hashed_rows(g, index, size)
        features.append(_trilinear(g, table, rows, weights))
    return g.join(features)


def _frequencies(g: _Graph, points: str, octaves: int) -> str:
    """As field/encoding.py."""
    centered = g.add("Sub", g.add("Mul", points, g.const(2.0)), g.const(1.0))
    parts = [centered]
    for octave in range(octaves):
        angle = g.add("Mul", centered, g.const(np.pi * 2**octave))
        parts += [g.add("Sin", angle), g.add("Cos", angle)]
    return g.join(parts)


def _network(g: _Graph, network: MLP, value: str) -> str:
    for index, weight in enumerate(network.weights):
        value = g.add("MatMul", value, g.const(weight.detach().float().cpu().numpy().T))
        if index < len(network.weights) - 1:
            value = g.add("Relu", value)
    return value


def _blend(g: _Graph, field: HybridField, points: str, explicit: str | None, implicit: str | None) -> str:
    """What the density head reads, see `HybridField.geometry`."""
    if explicit is None or implicit is None or field.blend is None:
        return explicit or implicit or ""
    w = g.const(1.0) if field.blend.warming_up else _evidence(g, field.blend, points)
    rest = g.add("Sub", g.const(1.0), w)
    parts = [g.add("Mul", explicit, w), g.add("Mul", implicit, rest)]
    return g.join(parts) if field.config.fusion == "concat" else g.add("Add", *parts)


def _evidence(g: _Graph, blend: BlendWeight, points: str) -> str:
    """The blend weight (N, 1), see `BlendWeight.forward`."""
    n = RESOLUTION
    scaled = g.add("Sub", g.add("Mul", points, g.const(float(n))), g.const(0.5))
    index, weights = _corners(g, scaled, n - 2)
    table = g.const(blend.evidence.detach().cpu().numpy()[:, None])
    evidence = _trilinear(g, table, _dense_rows(g, index, n), weights)
    lack = g.add("Exp", g.add("Mul", evidence, g.const(-blend.rate)))
    return g.add("Sub", g.const(1.0), g.add("Mul", lack, g.const(1.0 - blend.floor)))


def _harmonics(g: _Graph, box: Box) -> str:
    """The spherical harmonics (N, 16) of the directions in the cube's frame, as field/encoding.py: a linear map of
    all products of up to three coordinates."""
    rotation = box.box_from_world[:3, :3] / similarity_scale(box.box_from_world)
    d = g.add("MatMul", "directions", g.const(rotation.T))
    return g.add("MatMul", _monomials(g, d), g.const(_harmonic_matrix()))


EXPONENTS = [
    (i, j, k) for total in range(4) for i in range(total + 1) for j in range(total - i + 1) for k in [total - i - j]
]


def _monomials(g: _Graph, d: str) -> str:
    """x^i y^j z^k of `EXPONENTS` for directions (N, 3): (N, 20)."""
    axes = [g.slice(d, k, k + 1) for k in range(3)]
    one = g.add("Add", g.add("Mul", axes[0], g.const(0.0)), g.const(1.0))
    parts = []
    for exponents in EXPONENTS:
        value = one
        for axis, power in zip(axes, exponents):
            for _ in range(power):
                value = g.add("Mul", value, axis)
        parts.append(value)
    return g.join(parts)


def _harmonic_matrix() -> np.ndarray:
    """(20, 16): the harmonics of field/encoding.py as polynomials, found by fitting them on unit vectors.

    On the sphere x² + y² + z² = 1 makes the coefficients ambiguous; the fit takes the smallest, which are exact there.
    """
    from ..field.encoding import spherical_harmonics

    directions = np.random.default_rng(0).normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    monomials = np.stack([np.prod(directions ** np.array(e), 1) for e in EXPONENTS], 1)
    values = spherical_harmonics(torch.from_numpy(directions)).numpy()
    return np.linalg.lstsq(monomials, values, rcond=None)[0].astype(np.float32)
