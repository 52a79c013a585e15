"""From known surfels to class probabilities of all: what they look like, and what lies around them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from .graph import Graph, membership
from .preparation import Preparation
from .seeds import VOID, Seeds
from .unary import class_probabilities, distance_to_samples
from .walker import random_walk

# See experiments.md, “Labels from a few strokes”.
STRENGTH = 0.003  # γ of the prior, of the median of what edges conduct
KNOWN_LOOK = 2.75  # distance to the nearest marked surfel, in feature columns, at which prior and void count the same
SHARPNESS = 4
CERTAINTY = 3  # exponent that makes confidence the share that is right
FINE_STEPS = 15  # on surfels, after the coarse solution of all of it


def propagated(
    ready: Preparation,
    seeds: Seeds,
    classes: int,
    start: np.ndarray | None = None,
    check: Callable[[], None] = lambda: None,
) -> np.ndarray:
    """Probability (N, classes) float32 of each class at all surfels; what is missing to 1 is void.

    A classifier of what surfels look like gives each its prior. It counts as much as the surfel looks like any that is
    marked; the rest of its strength conducts to void. The random walker then evens this out along the surface.

    Args:
        start: (N, classes) of an earlier revision, to begin with. check: called often, may raise to stop.
    """
    known = seeds.label != VOID
    if not known.any():
        return np.zeros((len(ready.surfels), classes), np.float32)
    look, familiar = appearance(ready, seeds, classes, check)
    values = np.zeros((len(seeds.surfel), classes), np.float32)
    values[np.flatnonzero(known), seeds.label[known]] = 1
    start = None if start is None else calibrated(start, 1 / CERTAINTY)
    return calibrated(walked(ready.graph, look, familiar, seeds.surfel, values, start, check))


def appearance(
    ready: Preparation, seeds: Seeds, classes: int, check: Callable[[], None] = lambda: None
) -> tuple[np.ndarray, np.ndarray]:
    """Probability (N, classes) float32 of each class by what surfels look like, and how much (N,) in [0, 1] each looks like
    any that is marked."""
    known = seeds.label != VOID
    features = torch.from_numpy(np.array(ready.features))
    # Void is one more class of the classifier where it is marked.
    void_marked = bool((~known).any())
    target = torch.from_numpy(np.where(known, seeds.label, classes)).long()
    marked, mark = torch.from_numpy(seeds.surfel), torch.from_numpy(seeds.mark)
    look = class_probabilities(features, marked, target, mark, classes + void_marked, check)
    distance = distance_to_samples(features, marked, mark, check)
    return look[:, :classes], 0.5 ** ((distance / KNOWN_LOOK) ** SHARPNESS)


def walked(
    graph: Graph,
    look: np.ndarray,
    familiar: np.ndarray,
    seeds: np.ndarray,
    values: np.ndarray,
    start: np.ndarray | None,
    check: Callable[[], None],
) -> np.ndarray:
    """Probability (N, C) of the classes by the random walker, first on parts, then on surfels.

    Args:
        look: (N, C) prior of each surfel, in sum at most 1. familiar: (N,) in [0, 1], share of its strength that the prior
            has; the rest conducts to void. seeds: (S,) known surfels; values: (S, C) their probabilities. start: (N, C) or
            None, as in `propagated`.
    """
    count = int(graph.part.max(initial=-1)) + 1
    members = membership(graph.part, count)
    strength = STRENGTH * float(np.median(np.asarray(graph.edges.sum(1))))
    to_classes = strength * familiar
    to_void = strength * (1 - familiar)
    pull = np.asarray(members.T @ to_classes)
    prior = (members.T @ (to_classes[:, None] * look)) / np.maximum(pull, 1e-12)[:, None]
    amount = np.bincount(graph.part[seeds], minlength=count)
    known = np.flatnonzero(amount)
    mean = np.stack([np.bincount(graph.part[seeds], column, count) for column in values.T], 1)
    mean = mean[known] / amount[known, None]
    sink = np.asarray(members.T @ to_void)
    size = np.maximum(np.bincount(graph.part, minlength=count), 1)[:, None]
    begin = None if start is None else (members.T @ start) / size
    coarse = random_walk(graph.coarse, prior, pull, sink, known, mean, begin, check)
    first = coarse[graph.part]
    return random_walk(graph.edges, look, to_classes, to_void, seeds, values, first, check, most_steps=FINE_STEPS)


def calibrated(probability: np.ndarray, exponent: float = CERTAINTY) -> np.ndarray:
    """Probabilities (N, C), in sum at most 1, with their ratios, and that of all classes to void, to the power of the
    exponent: a walker is far less sure than it is right. What is most probable stays so."""
    total = probability.sum(1, keepdims=True).clip(0, 1)
    share = (probability / np.maximum(probability.max(1, keepdims=True), 1e-12)) ** exponent
    classed = total**exponent / (total**exponent + (1 - total) ** exponent)
    return (classed * share / np.maximum(share.sum(1, keepdims=True), 1e-12)).astype(np.float32)
