"""Labels of whole parts of the surface, a tenth of the work of those of all surfels, and what they tell of the method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from .calibration import CERTAINTY, STRENGTH, calibrated
from .graph import held_groups
from .likeness import strangeness
from .preparation import Preparation
from .seeds import VOID, Seeds, one_hot
from .unary import class_probabilities, distance_to_samples, familiarity, sampled
from .walker import random_walk

STRENGTHS = (STRENGTH, 0.01, 0.03, 0.1)  # that are tried; see experiments.md, “Surfels that end where colours do”
FOLDS = 4  # groups of photos at most, of which one is left out at a time


def by_parts(ready: Preparation, seeds: Seeds, classes: int, check: Callable[[], None] = lambda: None) -> np.ndarray:
    """Probability (P, classes) float32 of the fine parts of the surface, as `propagated`, to be shown until all surfels are
    known. What an earlier epoch says is not heard."""
    if not (seeds.label != VOID).any():
        return np.zeros((len(ready.part_features), classes), np.float32)
    look, familiar = looks_of_parts(ready, seeds, classes, check)
    return calibrated(walked_parts(ready, seeds, look, familiar, STRENGTH, check), CERTAINTY)


def best_strength(ready: Preparation, seeds: Seeds, classes: int, check: Callable[[], None] = lambda: None) -> float:
    """The least strength of the prior with which labels of parts, by the marks on some photos, are as often those of the marks
    on the others as with any (`simplest`), each mark counting the same: where classes do not end where surfaces do, looks are
    to be believed more."""
    found, photos = [], np.unique(seeds.photo)
    for left_out in np.array_split(photos, min(FOLDS, len(photos))) if len(photos) > 1 else []:
        out = np.isin(seeds.photo, left_out)
        others = chosen_seeds(seeds, ~out)
        known = np.unique(others.label[others.label != VOID])
        own = chosen_seeds(seeds, out & np.isin(seeds.label, known))
        if not len(own.surfel) or len(known) < 2:
            continue
        look, familiar = looks_of_parts(ready, others, classes, check)
        marks, number, amount = np.unique(own.mark, return_inverse=True, return_counts=True)
        right = np.zeros((len(marks), len(STRENGTHS)))
        for index, strength in enumerate(STRENGTHS):
            walked = walked_parts(ready, others, look, familiar, strength, check)
            guess = walked[np.asarray(ready.parts[:, 0])[own.surfel]].argmax(1)
            right[:, index] = np.bincount(number, guess == own.label, len(marks)) / amount
        found.append(right)
    return STRENGTHS[simplest(np.concatenate(found))] if found else STRENGTH


def simplest(right: np.ndarray) -> int:
    """The first of some ways that does as well as the best one, by their success (M, W) on M examples: it fails no more often
    than by one standard error of the difference (the rule of Breiman et al., "Classification and regression trees", 1984)."""
    best = int(right.mean(0).argmax())
    lost = right[:, [best]] - right
    doubt = lost.std(0) / np.sqrt(max(len(right) - 1, 1))
    return int(np.flatnonzero(lost.mean(0) <= doubt + 1e-9)[0])


def chosen_seeds(seeds: Seeds, chosen: np.ndarray) -> Seeds:
    """Some of the known surfels (S,) bool."""
    return replace(seeds, **{name: getattr(seeds, name)[chosen] for name in ("surfel", "label", "mark", "photo")})


def looks_of_parts(
    ready: Preparation, seeds: Seeds, classes: int, check: Callable[[], None]
) -> tuple[np.ndarray, np.ndarray]:
    """Probability (P, classes) of each class by what parts look like, and how much (P,) in [0, 1] each looks like any that is
    marked; taught by some surfels of each mark."""
    known, chosen = seeds.label != VOID, sampled(torch.from_numpy(seeds.mark)).numpy()
    both = torch.cat([ready.columns(seeds.surfel[chosen]), torch.from_numpy(np.array(ready.part_features))])
    void_marked = bool((~known).any())
    target = torch.from_numpy(np.where(known, seeds.label, classes)[chosen]).long()
    mark, rows = torch.from_numpy(seeds.mark[chosen]), torch.arange(len(chosen))
    look = class_probabilities(both, rows, target, mark, classes + void_marked, check)[len(chosen) :, :classes]
    distance = distance_to_samples(both[:, : ready.features.shape[1]], rows, mark, check)[len(chosen) :]
    return look, familiarity(distance, strangeness(*ready.likeness, distance, check))


def strange_parts(
    ready: Preparation, marked: torch.Tensor, mark: torch.Tensor, check: Callable[[], None]
) -> np.ndarray:
    """How strange (P,) in [0, 1] parts are to the marked surfels (S,), of which `mark` (S,) says which mark each is of."""
    size = ready.features.shape[1]
    both = torch.from_numpy(np.concatenate([ready.features[marked.numpy()], ready.part_features[:, :size]]))
    distance = distance_to_samples(both, torch.arange(len(marked)), mark, check)[len(marked) :]
    return strangeness(*ready.likeness, distance, check)


def walked_parts(
    ready: Preparation,
    seeds: Seeds,
    look: np.ndarray,
    familiar: np.ndarray,
    strength: float,
    check: Callable[[], None],
) -> np.ndarray:
    """Probability (P, C) of the classes of parts by the random walker, from their look (P, C), of which (P,) is familiar."""
    parts = np.asarray(ready.parts[:, 0])
    pull = strength * ready.conductance * np.bincount(parts, minlength=len(look))
    held, values = held_groups(parts, seeds.surfel, one_hot(seeds.label, look.shape[1]))
    return random_walk(ready.part_edges, look, pull * familiar, pull * (1 - familiar), held, values, None, check)
