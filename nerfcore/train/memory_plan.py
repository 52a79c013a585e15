"""How much memory of a graphics card training takes, told before there is one: by the shapes of what it keeps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import nn

from ..config import RunConfig, make_config
from ..kernels.encode import FEATURES
from ..render.model import CAPACITY_FACTOR, Model
from .trainer import HEADROOM

PHOTOS = 100 * 1600 * 1067  # pixels of the capture in the table of `doctor`
CLASSES = 16
BYTES_A_PIXEL = 5  # colour with alpha and class
VISIBLE = 0.6  # of the samples; 0.59 (lego_400) and 0.72 (museum) in the middle of training
WAY_BACK = 1.25  # what is kept for the gradients and the largest network's own on the way back; not measured
CUDA = 0.5e9  # of the driver's context and of the kernels, about; not measured


@dataclass(frozen=True)
class MemoryPlan:
    """Bytes: of field, grids and optimiser; of one step at the end of the schedule; of the photos' pixels; of CUDA itself.

    Photos move to the main memory where the card has no room for them.
    """

    model: int
    step: int
    photos: int
    context: int = int(CUDA)

    @property
    def needed(self) -> int:
        """Bytes without which it does not train."""
        return self.model + self.step + self.context


def memory_plan(
    config: RunConfig, classes: int = CLASSES, pixels: int = PHOTOS, half: bool = True, images: int = 100
) -> MemoryPlan:
    """The plan of a training with so many classes on so many pixels; `half`: products are in half precision."""
    with torch.device("meta"):
        model = Model(config, classes, images, contracted=True)
    fixed = _bytes(model) + 2 * sum(p.numel() * p.element_size() for p in model.parameters())  # Adam's moments
    fixed += model.occupancy.density.numel() * 16  # what the cells' means are summed up in
    samples = math.ceil(HEADROOM * config.train.batch_samples)
    visible = min(samples, math.ceil(samples * CAPACITY_FACTOR * VISIBLE))
    back = WAY_BACK * visible * saved_bytes(config, classes, half)
    step = math.ceil(samples * first_pass_bytes(config) + back)
    return MemoryPlan(fixed, step, pixels * BYTES_A_PIXEL)


def _bytes(model: nn.Module) -> int:
    """Of parameters and of all buffers."""
    return sum(t.numel() * t.element_size() for t in [*model.parameters(), *model.buffers()])


def first_pass_bytes(config: RunConfig) -> int:
    """Of a sample in the pass that only looks for the visible ones: its place, features, density and weight."""
    features = config.field.levels * FEATURES
    return 4 * (3 + 2 + features + 4) + 2 * (3 + 6 * config.field.octaves + 2 * features + 2 * config.field.width)


def saved_bytes(config: RunConfig, classes: int, half: bool) -> int:
    """Of a visible sample until its gradient is known: the inputs of every product, and what they are made of."""
    f, size = config.field, 2 if half else 4
    features, outputs = f.levels * FEATURES, 1 + f.geometry_features
    networks = []
    if f.branch != "explicit":
        networks.append(3 + 6 * f.octaves + f.width * (f.implicit_layers - 1))
    both = f.branch == "hybrid" and f.fusion == "concat"
    networks.append(features * (2 if both else 1) + f.width)
    networks.append(outputs + 16 + f.appearance + f.width * (f.color_layers - 1))
    if classes:
        inputs = outputs + features * (2 if f.branch == "hybrid" else 1)
        networks.append(inputs + f.width * (f.semantic_layers - 1))
    floats = 3 + 2 * features + 2 * (5 + classes) + 8
    return size * (sum(networks) + 2 * features) + 4 * floats


def preset_plans(names: list[str], half: bool = True) -> dict[str, MemoryPlan]:
    """The plan of each preset, for 16 classes and 100 photos of 1600×1067."""
    return {name: memory_plan(make_config(name), half=half) for name in names}
