"""Files with the inputs and outputs of SAM's encoder and decoder that compute next to nothing: what is left of a click's
time is ours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

SIDE, CHANNELS, STEP, LOW = 1024, 256, 16, 256
RADIUS = 40.0  # of the disc that the decoder answers with, of its 256 pixels


def encoder(path: Path) -> Path:
    """Pictures (1, 3, 1024, 1024) → embeddings (1, 256, 64, 64)."""
    import onnx

    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    weights = onnx.numpy_helper.from_array(np.eye(CHANNELS, 3, dtype=np.float32)[:, :, None, None], "weights")
    nodes = [
        helper.make_node("AveragePool", ["image"], ["small"], kernel_shape=[STEP] * 2, strides=[STEP] * 2),
        helper.make_node("Conv", ["small", "weights"], ["image_embeddings"]),
    ]
    small = SIDE // STEP
    ports = {"image": (kind, [1, 3, SIDE, SIDE])}, {"image_embeddings": (kind, [1, CHANNELS, small, small])}
    return _saved(path, nodes, [weights], *ports)


def decoder(path: Path) -> Path:
    """A disc in the middle, whatever is asked."""
    import onnx

    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    y, x = np.mgrid[:LOW, :LOW] - LOW / 2
    disc = np.where(np.hypot(x, y) < RADIUS, 1, -1).astype(np.float32)[None, None]
    constants = [
        onnx.numpy_helper.from_array(values, name)
        for name, values in {"disc": disc, "sure": np.ones((1, 1), np.float32), "none": np.zeros(1, np.float32)}.items()
    ]
    given = {
        "image_embeddings": [1, CHANNELS, SIDE // STEP, SIDE // STEP],
        "point_coords": [1, "points", 2],
        "point_labels": [1, "points"],
        "mask_input": [1, 1, LOW, LOW],
        "has_mask_input": [1],
        "orig_im_size": [2],
    }
    nodes = []
    for number, name in enumerate(given):  # each is read, or files with it would not be whole
        nodes.append(helper.make_node("ReduceMax", [name], [f"max{number}"], keepdims=0))
        nodes.append(helper.make_node("Mul", [f"max{number}", "none"], [f"zero{number}"]))
    nodes.append(helper.make_node("Sum", ["disc", *(f"zero{number}" for number in range(len(given)))], ["masks"]))
    nodes.append(helper.make_node("Identity", ["sure"], ["iou_predictions"]))
    ports = {name: (kind, size) for name, size in given.items()}
    answers = {"masks": (kind, [1, 1, LOW, LOW]), "iou_predictions": (kind, [1, 1])}
    return _saved(path, nodes, constants, ports, answers)


def _saved(path: Path, nodes: Sequence[Any], constants: Sequence[Any], inputs: Any, outputs: Any) -> Path:
    import onnx

    values = [
        [onnx.helper.make_tensor_value_info(name, *port) for name, port in ports.items()] for ports in (inputs, outputs)
    ]
    graph = onnx.helper.make_graph(list(nodes), "stand_in", *values, initializer=list(constants))
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    onnx.save_model(model, str(path))
    return path
