"""From known surfels to class probabilities of all: what they look like, and what lies around them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from .calibration import Certainty, calibrated, certainty
from .graph import Graph, held_groups, membership
from .part_labels import best_strength, strange_parts
from .preparation import Preparation
from .seeds import VOID, Carried, Seeds, one_hot
from .unary import class_probabilities, distance_to_samples, familiarity
from .walker import random_walk

# See experiments.md, “Labels from a few strokes”.
CARRIED = 30.0  # by how much firmer the labels of an earlier epoch are than what surfels look like; not tuned
FINE_STEPS = 15  # on surfels, after the coarse solution of all of it


def propagated(
    ready: Preparation,
    seeds: Seeds,
    classes: int,
    start: np.ndarray | None = None,
    check: Callable[[], None] = lambda: None,
    trust: Certainty | None = None,
) -> np.ndarray:
    """Probability (N, classes) float32 of each class at all surfels; what is missing to 1 is void.

    A classifier of what surfels look like gives each its prior. It counts as much as the surfel looks like any that is
    marked; the rest of its strength conducts to void. The random walker then evens this out along the surface.

    Args:
        start: (N, classes) of an earlier revision, to begin with. check: called often, may raise to stop. trust: what
            `trusted` says; None: it is asked.
    """
    known, carried = seeds.label != VOID, seeds.carried
    if not classes or (not known.any() and carried is None):
        return np.zeros((len(ready.surfels), classes), np.float32)
    count = len(ready.surfels)
    look, familiar = np.zeros((count, classes), np.float32), np.zeros(count, np.float32)
    if known.any():
        look, familiar = appearance(ready, seeds, classes, check)
    firm = np.ones(count, np.float32)
    if carried is not None:
        look, familiar, firm = with_carried(look, familiar, carried)
    values = one_hot(seeds.label, classes)
    trust = trust or trusted(ready, seeds, classes, check)
    start = None if start is None else calibrated(start, 1 / trust.exponent)
    found = walked(ready.graph, look, familiar, seeds.surfel, values, start, check, trust.strength * firm)
    return calibrated(found, trust.exponent)


def trusted(ready: Preparation, seeds: Seeds, classes: int, check: Callable[[], None] = lambda: None) -> Certainty:
    """How far the marks of a scene can be trusted on other photos, and how far looks are."""
    strength = best_strength(ready, seeds, classes, check)
    return certainty(ready.columns(seeds.surfel), seeds, classes, check, strength)


def appearance(
    ready: Preparation, seeds: Seeds, classes: int, check: Callable[[], None] = lambda: None
) -> tuple[np.ndarray, np.ndarray]:
    """Probability (N, classes) float32 of each class by what surfels look like, and how much (N,) in [0, 1] each looks like
    any that is marked."""
    known = seeds.label != VOID
    features = torch.from_numpy(np.array(ready.features))
    columns = ready.columns(slice(None))
    # Void is one more class of the classifier where it is marked.
    void_marked = bool((~known).any())
    target = torch.from_numpy(np.where(known, seeds.label, classes)).long()
    marked, mark = torch.from_numpy(seeds.surfel), torch.from_numpy(seeds.mark)
    look = class_probabilities(columns, marked, target, mark, classes + void_marked, check)
    # What photos show is too fine to say what is known: every place has another texture.
    distance = distance_to_samples(features, marked, mark, check)
    strange = strange_parts(ready, marked, mark, check)[np.asarray(ready.parts[:, 0])]
    return look[:, :classes], familiarity(distance, strange)


def with_carried(look: np.ndarray, familiar: np.ndarray, carried: Carried) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Prior (N, C), its share of the strength (N,) and factors (N,) of the strength, where an earlier epoch has a say: as
    sure as it was, and firmer than what surfels look like."""
    told = carried.label >= 0
    mixed, known = look.copy(), familiar.copy()
    one = np.zeros((int(told.sum()), look.shape[1]), np.float32)
    one[np.arange(len(one)), carried.label[told]] = 1
    sure = carried.sure[told, None]
    mixed[told] = sure * one + (1 - sure) * look[told]
    known[told] = np.maximum(familiar[told], carried.sure[told])
    return mixed, known, np.where(told, CARRIED, 1).astype(np.float32)


def walked(
    graph: Graph,
    look: np.ndarray,
    familiar: np.ndarray,
    seeds: np.ndarray,
    values: np.ndarray,
    start: np.ndarray | None,
    check: Callable[[], None],
    strength: np.ndarray | float,
) -> np.ndarray:
    """Probability (N, C) of the classes by the random walker, first on the cells of a coarser grid, then on surfels.

    Args:
        look: (N, C) prior of each surfel, in sum at most 1. familiar: (N,) in [0, 1], share of its strength that the prior
            has; the rest conducts to void. seeds: (S,) known surfels; values: (S, C) their probabilities. start: (N, C) or
            None, as in `propagated`. strength: (N,) or one, γ of the prior in units of the median of what edges conduct.
    """
    count = int(graph.cell.max(initial=-1)) + 1
    members = membership(graph.cell, count)
    pulled = strength * float(np.median(np.asarray(graph.edges.sum(1))))
    to_classes = pulled * familiar
    to_void = pulled * (1 - familiar)
    pull = np.asarray(members.T @ to_classes)
    prior = (members.T @ (to_classes[:, None] * look)) / np.maximum(pull, 1e-12)[:, None]
    known, mean = held_groups(graph.cell, seeds, values)
    sink = np.asarray(members.T @ to_void)
    size = np.maximum(np.bincount(graph.cell, minlength=count), 1)[:, None]
    begin = None if start is None else (members.T @ start) / size
    coarse = random_walk(graph.coarse, prior, pull, sink, known, mean, begin, check)
    first = coarse[graph.cell]
    return random_walk(graph.edges, look, to_classes, to_void, seeds, values, first, check, most_steps=FINE_STEPS)
