"""Tiny ONNX files with the inputs and outputs of models that users bring. Decoders draw a disc where points and boxes are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

RADII = (2.0, 6.0, 3.0)  # of the discs in the decoder's masks, pixels of these
SCORES = (0.2, 0.9, 0.4)
FRAME, LOW = 1024, 256
FLOAT, INT64 = TensorProto.FLOAT, TensorProto.INT64
Ports = dict[str, tuple[int, Sequence[Any]]]  # name → kind, sizes


class Graph:
    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, values: Any, kind: type = np.float32) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(values, kind), name))
        return name

    def add(self, op: str, *inputs: str, out: str = "", **attributes: Any) -> str:
        name = out or f"n{len(self.nodes)}"
        self.nodes.append(helper.make_node(op, list(inputs), [name], **attributes))
        return name

    def save(self, path: Path, inputs: Ports, outputs: Ports) -> Path:
        values = [[helper.make_tensor_value_info(n, *port) for n, port in ports.items()] for ports in (inputs, outputs)]
        graph = helper.make_graph(self.nodes, "g", *values, initializer=self.constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        onnx.checker.check_model(model)
        onnx.save_model(model, str(path))
        return path


def encoder(
    path: Path, name: str = "images", side: int | None = FRAME, outputs: tuple[str, ...] = ("image_embeddings",)
) -> Path:
    """From pictures (1, 3, side, side), None: any size, to averages over 16×16 pixels, each in a channel of its own."""
    g = Graph()
    small = g.add("AveragePool", name, kernel_shape=[16, 16], strides=[16, 16], ceil_mode=1)
    weights = g.constant(np.eye(256, 3)[:, :, None, None])
    for output in outputs:
        g.add("Conv", small, weights, out=output)
    size = [side, side] if side else ["h", "w"]
    ports = {output: (FLOAT, [1, 256, "a", "b"]) for output in outputs}
    return g.save(path, {name: (FLOAT, [1, 3, *size])}, ports)


def raw_encoder(path: Path) -> Path:
    """From raw pictures (H, W, 3) to embeddings that hold their height, width and mean."""
    g = Graph()
    shape = g.add("Cast", g.add("Shape", "input_image"), to=FLOAT)
    mean = g.add("ReduceMean", "input_image", keepdims=0)
    facts = g.add("Concat", shape, g.add("Unsqueeze", mean, g.constant([0], np.int64)), axis=0)
    shaped = g.add("Reshape", facts, g.constant([1, 4, 1, 1], np.int64))
    g.add("Expand", shaped, g.constant([1, 4, 64, 64], np.int64), out="image_embeddings")
    return g.save(path, {"input_image": (FLOAT, ["h", "w", 3])}, {"image_embeddings": (FLOAT, [1, 4, 64, 64])})


def _center(g: Graph, points: str, labels: str, boxes: str = "") -> str:
    """The mean (2,) of what points say is inside, corners of boxes included; the rest is left out."""
    places = g.add("Reshape", points, g.constant([-1, 2], np.int64))
    flags = g.add("Cast", g.add("Reshape", labels, g.constant([-1, 1], np.int64)), to=FLOAT)
    weights = g.add("Cast", g.add("Greater", flags, g.constant(0.5)), to=FLOAT)
    if boxes:
        corners = g.add("Reshape", boxes, g.constant([-1, 2], np.int64))
        ones = g.add("Add", g.add("Mul", corners, g.constant(0.0)), g.constant(1.0))
        places = g.add("Concat", places, corners, axis=0)
        weights = g.add(
            "Concat", weights, g.add("Slice", ones, *[g.constant([v], np.int64) for v in (0, 1, 1)]), axis=0
        )
    total = g.add("ReduceSum", g.add("Mul", places, weights), g.constant([0], np.int64), keepdims=0)
    return g.add("Div", total, g.add("ReduceSum", weights, g.constant([0, 1], np.int64), keepdims=0))


def _discs(g: Graph, center: str, rows: str, columns: str) -> str:
    """Logits (3, rows, columns) of the discs around a center; rows and columns are scalars of int64."""

    def steps(count: str) -> str:
        numbers = g.add("Range", g.constant(0, np.int64), count, g.constant(1, np.int64))
        return g.add("Add", g.add("Cast", numbers, to=FLOAT), g.constant(0.5))

    def squared(numbers: str, index: int, axis: int) -> str:
        away = g.add("Sub", numbers, g.add("Gather", center, g.constant(index, np.int64)))
        return g.add("Unsqueeze", g.add("Mul", away, away), g.constant([axis], np.int64))

    distance = g.add("Add", squared(steps(columns), 0, 0), squared(steps(rows), 1, 1))
    return g.add("Sub", g.constant(np.square(RADII)[:, None, None]), distance)


def _finish(g: Graph, logits: str, masks: str, scores: str, leading: int) -> None:
    """The masks and scores with so many dimensions of one before them."""
    axes = list(range(leading))
    g.add("Unsqueeze", logits, g.constant(axes, np.int64), out=masks)
    g.add("Identity", g.constant(np.reshape(SCORES, [1] * leading + [3])), out=scores)


def sam_decoder(path: Path, without: str = "", points_rank: int = 3) -> Path:
    """SAM's decoder: masks as large as the photo."""
    g = Graph()
    size = g.add("Cast", "orig_im_size", to=INT64)
    rows, columns = (g.add("Gather", size, g.constant(i, np.int64)) for i in (0, 1))
    largest = g.add("ReduceMax", "orig_im_size", keepdims=0)
    center = g.add("Mul", _center(g, "point_coords", "point_labels"), g.add("Div", largest, g.constant(float(FRAME))))
    _finish(g, _discs(g, center, rows, columns), "masks", "iou_predictions", 1)
    inputs: Ports = {
        "image_embeddings": (FLOAT, [1, "c", 64, 64]),
        "point_coords": (FLOAT, [1, "n", 2] if points_rank == 3 else [1, 1, "n", 2]),
        "point_labels": (FLOAT, [1, "n"]),
        "mask_input": (FLOAT, [1, 1, LOW, LOW]),
        "has_mask_input": (FLOAT, [1]),
        "orig_im_size": (FLOAT, [2]),
    }
    inputs.pop(without, None)
    return g.save(path, inputs, {"masks": (FLOAT, [1, 3, "h", "w"]), "iou_predictions": (FLOAT, [1, 3])})


def _low(g: Graph, points: str, labels: str, boxes: str = "") -> str:
    center = g.add("Mul", _center(g, points, labels, boxes), g.constant(LOW / FRAME))
    return _discs(g, center, g.constant(LOW, np.int64), g.constant(LOW, np.int64))


def sam2_decoder(path: Path) -> Path:
    """SAM 2's decoder: masks of 256×256."""
    g = Graph()
    _finish(g, _low(g, "point_coords", "point_labels"), "masks", "iou_predictions", 1)
    inputs: Ports = {
        "image_embed": (FLOAT, [1, 256, 64, 64]),
        "high_res_feats_0": (FLOAT, [1, 256, 64, 64]),
        "high_res_feats_1": (FLOAT, [1, 256, 64, 64]),
        "point_coords": (FLOAT, ["b", "n", 2]),
        "point_labels": (FLOAT, ["b", "n"]),
        "mask_input": (FLOAT, ["b", 1, LOW, LOW]),
        "has_mask_input": (FLOAT, ["b"]),
    }
    return g.save(path, inputs, {"masks": (FLOAT, [1, 3, LOW, LOW]), "iou_predictions": (FLOAT, [1, 3])})


def hugging_decoder(path: Path) -> Path:
    """SAM 2's decoder as Hugging Face's tools name it."""
    g = Graph()
    _finish(g, _low(g, "input_points", "input_labels", "input_boxes"), "pred_masks", "iou_scores", 2)
    inputs: Ports = {f"image_embeddings.{i}": (FLOAT, [1, 256, 64, 64]) for i in range(3)}
    inputs |= {
        "input_points": (FLOAT, [1, 1, "n", 2]),
        "input_labels": (INT64, [1, 1, "n"]),
        "input_boxes": (FLOAT, [1, "m", 4]),
    }
    return g.save(path, inputs, {"iou_scores": (FLOAT, [1, 1, 3]), "pred_masks": (FLOAT, [1, 1, 3, LOW, LOW])})


def efficient_decoder(path: Path) -> Path:
    """EfficientSAM's decoder: points in pixels of the photo."""
    g = Graph()
    rows, columns = (g.add("Gather", "orig_im_size", g.constant(i, np.int64)) for i in (0, 1))
    center = _center(g, "batched_point_coords", "batched_point_labels")
    _finish(g, _discs(g, center, rows, columns), "output_masks", "iou_predictions", 2)
    inputs: Ports = {
        "image_embeddings": (FLOAT, [1, 256, "a", "b"]),
        "batched_point_coords": (FLOAT, [1, 1, "n", 2]),
        "batched_point_labels": (FLOAT, [1, 1, "n"]),
        "orig_im_size": (INT64, [2]),
    }
    return g.save(path, inputs, {"output_masks": (FLOAT, [1, 1, 3, "h", "w"]), "iou_predictions": (FLOAT, [1, 1, 3])})


def segformer(path: Path, side: int | None = None) -> Path:
    """From pictures to logits of red, green and blue at a quarter of their size."""
    g = Graph()
    small = g.add("AveragePool", "pixel_values", kernel_shape=[4, 4], strides=[4, 4])
    g.add("Mul", small, g.constant(5.0), out="logits")
    size = [side, side] if side else ["h", "w"]
    return g.save(path, {"pixel_values": (FLOAT, [1, 3, *size])}, {"logits": (FLOAT, [1, 3, "a", "b"])})


def dino(path: Path, patch: int = 14, others: int = 5, side: int | None = None) -> Path:
    """From pictures to tokens of 8: class and register tokens of 1000, then red, green, blue of each patch, and zeros."""
    g = Graph()
    small = g.add("AveragePool", "pixel_values", kernel_shape=[patch, patch], strides=[patch, patch])
    wide = g.add("Conv", small, g.constant(np.eye(8, 3)[:, :, None, None]))
    rows = g.add("Transpose", g.add("Reshape", wide, g.constant([1, 8, -1], np.int64)), perm=[0, 2, 1])
    g.add("Concat", g.constant(np.full((1, others, 8), 1000.0)), rows, axis=1, out="last_hidden_state")
    size = [side, side] if side else ["h", "w"]
    return g.save(path, {"pixel_values": (FLOAT, [1, 3, *size])}, {"last_hidden_state": (FLOAT, [1, "t", 8])})


def feature_map(path: Path, patch: int = 16) -> Path:
    """From pictures to a map (1, 8, h / patch, w / patch) of their colors."""
    g = Graph()
    small = g.add("AveragePool", "image", kernel_shape=[patch, patch], strides=[patch, patch])
    g.add("Conv", small, g.constant(np.eye(8, 3)[:, :, None, None]), out="feature_map")
    return g.save(path, {"image": (FLOAT, [1, 3, "h", "w"])}, {"feature_map": (FLOAT, [1, 8, "a", "b"])})
