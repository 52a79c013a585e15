"""From known surfels to class probabilities of all: what they look like, and what lies around them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from .calibration import CERTAINTY, Certainty, calibrated, certainty
from .graph import Graph, membership
from .preparation import Preparation
from .seeds import VOID, Carried, Seeds
from .unary import class_probabilities, distance_to_samples, sampled
from .walker import random_walk

# See experiments.md, “Labels from a few strokes”.
STRENGTH = 0.003  # γ of the prior, of the median of what edges conduct
KNOWN_LOOK = 2.75  # distance to the nearest marked surfel, in feature columns, at which prior and void count the same
SHARPNESS = 4
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
    if not known.any() and carried is None:
        return np.zeros((len(ready.surfels), classes), np.float32)
    count = len(ready.surfels)
    look, familiar = np.zeros((count, classes), np.float32), np.zeros(count, np.float32)
    if known.any():
        look, familiar = appearance(ready, seeds, classes, check)
    firm = np.ones(count, np.float32)
    if carried is not None:
        look, familiar, firm = with_carried(look, familiar, carried)
    values = one_hot(seeds.label, classes)
    exponent = (trust or trusted(ready, seeds, classes, check)).exponent
    start = None if start is None else calibrated(start, 1 / exponent)
    return calibrated(walked(ready.graph, look, familiar, seeds.surfel, values, start, check, firm), exponent)


def trusted(ready: Preparation, seeds: Seeds, classes: int, check: Callable[[], None] = lambda: None) -> Certainty:
    """How far the marks of a scene can be trusted on other photos."""
    return certainty(appearance_columns(ready, seeds.surfel), seeds, classes, check)


def by_parts(ready: Preparation, seeds: Seeds, classes: int, check: Callable[[], None] = lambda: None) -> np.ndarray:
    """Probability (P, classes) float32 of the fine parts of the surface, as `propagated`: a tenth of the work, to be shown
    until all surfels are known. What an earlier epoch says is not heard."""
    known = seeds.label != VOID
    parts = np.asarray(ready.parts[:, 0])
    count = len(ready.part_features)
    if not known.any():
        return np.zeros((count, classes), np.float32)
    chosen = sampled(torch.from_numpy(seeds.mark))
    columns = appearance_columns(ready, seeds.surfel[chosen])
    both = torch.cat([columns, torch.from_numpy(np.array(ready.part_features))])
    void_marked = bool((~known).any())
    target = torch.from_numpy(np.where(known, seeds.label, classes)[chosen]).long()
    mark, rows = torch.from_numpy(seeds.mark[chosen]), torch.arange(len(chosen))
    look = class_probabilities(both, rows, target, mark, classes + void_marked, check)[len(chosen) :, :classes]
    distance = distance_to_samples(both[:, : ready.features.shape[1]], rows, mark, check)[len(chosen) :]
    familiar = 0.5 ** ((distance / KNOWN_LOOK) ** SHARPNESS)
    size = np.bincount(parts, minlength=count)
    strength = STRENGTH * ready.conductance * size
    held, values = held_groups(parts, seeds.surfel, one_hot(seeds.label, classes))
    found = random_walk(
        ready.part_edges, look, strength * familiar, strength * (1 - familiar), held, values, None, check
    )
    return calibrated(found, CERTAINTY)


def one_hot(label: np.ndarray, classes: int) -> np.ndarray:
    """Probabilities (S, classes) float32 of what is certain, by class index (S,) or VOID."""
    found = np.zeros((len(label), classes), np.float32)
    known = label != VOID
    found[np.flatnonzero(known), label[known]] = 1
    return found


def held_groups(group: np.ndarray, seeds: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which groups, (N,) that of each node, have known nodes (S,), ascending, and the mean of their probabilities (S, C)."""
    found, number, amount = np.unique(group[seeds], return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(number, column, len(found)) for column in values.T], 1)
    return found, (mean / amount[:, None]).astype(np.float32)


def appearance_columns(ready: Preparation, surfels: np.ndarray | slice) -> torch.Tensor:
    """What some surfels look like as columns (S, F + G): those of the surface and those of the photos."""
    return torch.from_numpy(np.concatenate([ready.features[surfels], ready.photo_features[surfels]], 1))


def appearance(
    ready: Preparation, seeds: Seeds, classes: int, check: Callable[[], None] = lambda: None
) -> tuple[np.ndarray, np.ndarray]:
    """Probability (N, classes) float32 of each class by what surfels look like, and how much (N,) in [0, 1] each looks like
    any that is marked."""
    known = seeds.label != VOID
    features = torch.from_numpy(np.array(ready.features))
    columns = appearance_columns(ready, slice(None))
    # Void is one more class of the classifier where it is marked.
    void_marked = bool((~known).any())
    target = torch.from_numpy(np.where(known, seeds.label, classes)).long()
    marked, mark = torch.from_numpy(seeds.surfel), torch.from_numpy(seeds.mark)
    look = class_probabilities(columns, marked, target, mark, classes + void_marked, check)
    # What photos show is too fine to say what is known: every place has another texture.
    distance = distance_to_samples(features, marked, mark, check)
    return look[:, :classes], 0.5 ** ((distance / KNOWN_LOOK) ** SHARPNESS)


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
    firm: np.ndarray | float = 1.0,
) -> np.ndarray:
    """Probability (N, C) of the classes by the random walker, first on the cells of a coarser grid, then on surfels.

    Args:
        look: (N, C) prior of each surfel, in sum at most 1. familiar: (N,) in [0, 1], share of its strength that the prior
            has; the rest conducts to void. seeds: (S,) known surfels; values: (S, C) their probabilities. start: (N, C) or
            None, as in `propagated`. firm: (N,) factors of the strength.
    """
    count = int(graph.cell.max(initial=-1)) + 1
    members = membership(graph.cell, count)
    strength = STRENGTH * float(np.median(np.asarray(graph.edges.sum(1)))) * firm
    to_classes = strength * familiar
    to_void = strength * (1 - familiar)
    pull = np.asarray(members.T @ to_classes)
    prior = (members.T @ (to_classes[:, None] * look)) / np.maximum(pull, 1e-12)[:, None]
    known, mean = held_groups(graph.cell, seeds, values)
    sink = np.asarray(members.T @ to_void)
    size = np.maximum(np.bincount(graph.cell, minlength=count), 1)[:, None]
    begin = None if start is None else (members.T @ start) / size
    coarse = random_walk(graph.coarse, prior, pull, sink, known, mean, begin, check)
    first = coarse[graph.cell]
    return random_walk(graph.edges, look, to_classes, to_void, seeds, values, first, check, most_steps=FINE_STEPS)
