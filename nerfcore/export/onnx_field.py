"""The trained field as an ONNX graph: any program with an ONNX runtime can ask it for density, colour and classes.

Inputs: `points` (N, 3) in the world, `directions` (N, 3) unit vectors from the eye to the point, in the world.
Outputs: `density` (N) per world unit, `color` (N, 3) sRGB in [0, 1], and with classes `probabilities` (N, K) in the
order of the metadata `class_ids`, `class_names`; `label_revision` says which marks they are from, if any. All float32.
"""

from __future__ import annotations

import json
import logging
import warnings
from pathlib import Path

import onnx
import torch

from .. import __version__
from ..data.box import Box
from ..field.hybrid import HybridField
from ..files import atomic_path
from ..project.label_revision import label_facts
from ..project.schema import Project
from ..render.run import Trained
from .field_function import FieldFunction

OPSET = 18
EXAMPLES = 5  # points that the function is traced with


def write_onnx(path: Path, trained: Trained, project: Project) -> None:
    """Write the field of a run. Raises DiskError."""
    box = trained.info.box(project)
    model = field_model(trained.model.field, box)
    names = {c.id: c.name for c in project.classes}
    ids = trained.info.class_ids if trained.model.field.classes else []
    onnx.helper.set_model_props(
        model,
        {
            "class_ids": json.dumps(ids),
            "class_names": json.dumps([names.get(i, str(i)) for i in ids], ensure_ascii=False),
            "world_from_box": json.dumps(box.world_from_box.tolist()),
            **{fact: str(value) for fact, value in label_facts(trained.info.label_revision).items()},
        },
    )
    with atomic_path(path) as temporary:
        onnx.save_model(model, str(temporary))


def field_model(field: HybridField, box: Box) -> onnx.ModelProto:
    """The graph of a field in its cube (see the module's text)."""
    names = ["density", "color", "probabilities"] if field.classes else ["density", "color"]
    example = (torch.rand(EXAMPLES, 3), torch.rand(EXAMPLES, 3))
    number = torch.export.Dim("N")
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # of the exporter about itself
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # that torchvision is missing
        program = torch.onnx.export(
            FieldFunction(field, box).eval(),
            example,
            dynamo=True,
            opset_version=OPSET,
            input_names=["points", "directions"],
            output_names=names,
            dynamic_shapes=({0: number}, {0: number}),
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    model.producer_name, model.producer_version = "fieldwork", __version__
    return model
