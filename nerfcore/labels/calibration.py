"""How sure labels are: the walker's probabilities, made as right as marks on one photo prove for those on others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from .seeds import VOID, Seeds
from .unary import class_probabilities

# See experiments.md, “Labels from a few strokes”.
CERTAINTY = 3.0  # exponent that makes confidence the share that is right, where marks cannot tell
SCALE = 4.5  # exponent by what is found for the classifier: SCALE · τ
STRENGTH = 0.003  # γ of the prior, of the median of what edges conduct, where marks cannot tell
TAUS = np.linspace(0.05, 1.5, 30)
LEAST, MOST = 0.3, 4.0  # exponents
HELD = 1.4  # most where looks count more than STRENGTH: a walker that they hold hardly strays


@dataclass(frozen=True)
class Certainty:
    """How far marks can be trusted on other photos: exponent for `calibrated`; right: share of the marks of each photo,
    each mark counting the same, that the marks on the others guess; None where no class is marked on two photos; strength:
    γ of what surfels look like, against what lies around them."""

    exponent: float
    right: float | None
    strength: float = STRENGTH


def certainty(
    features: torch.Tensor, seeds: Seeds, classes: int, check: Callable[[], None], strength: float = STRENGTH
) -> Certainty:
    """How a classifier taught by the marks on all photos but one does on that one.

    The power τ of its probabilities by which the marks left out are most likely (temperature scaling: Guo et al., "On
    calibration of modern neural networks", 2017) tells how far looks carry from photo to photo in this scene. Classes that
    are marked on one photo alone say nothing.

    Args:
        features: (S, F) of the marked surfels. strength: of their looks in the random walker.
    """
    most = MOST if strength <= STRENGTH else HELD
    found, right, share = [], [], []
    photos = np.unique(seeds.photo) if len(seeds.photo) else []
    for photo in photos if len(photos) > 1 else []:
        check()
        others = np.flatnonzero((seeds.photo != photo) & (seeds.label != VOID))
        own = np.flatnonzero((seeds.photo == photo) & np.isin(seeds.label, seeds.label[others]) & (seeds.label != VOID))
        if not len(own) or len(np.unique(seeds.label[others])) < 2:
            continue
        target, mark = (torch.from_numpy(part[others]).long() for part in (seeds.label, seeds.mark))
        taught = class_probabilities(features, torch.from_numpy(others), target, mark, classes, check)
        _, number, amount = np.unique(seeds.mark[own], return_inverse=True, return_counts=True)
        found.append(taught[own])
        right.append(seeds.label[own])
        share.append(1 / amount[number])
    if not found:
        return Certainty(min(CERTAINTY, most), None, strength)
    probability, label = np.concatenate(found).clip(1e-6, 1), np.concatenate(right)
    weight = np.concatenate(share)
    tau = likeliest_power(probability, label, weight)
    correct = float((weight * (probability.argmax(1) == label)).sum() / weight.sum())
    return Certainty(float(np.clip(SCALE * tau, LEAST, most)), correct, strength)


def likeliest_power(probability: np.ndarray, label: np.ndarray, share: np.ndarray) -> float:
    """The power τ of probabilities (N, C), in sum 1 again, by which the labels (N,) are most likely; each counts `share`."""

    def surprise(tau: float) -> float:
        scaled = probability**tau
        own = scaled[np.arange(len(label)), label] / scaled.sum(1)
        return float(-(share * np.log(np.maximum(own, 1e-12))).sum())

    return float(min(TAUS, key=surprise))


def calibrated(probability: np.ndarray, exponent: float) -> np.ndarray:
    """Probabilities (N, C), in sum at most 1, with their ratios, and that of all classes to void, to the power of the
    exponent. What is most probable stays so."""
    total = probability.sum(1, keepdims=True).clip(0, 1)
    share = (probability / np.maximum(probability.max(1, keepdims=True), 1e-12)) ** exponent
    classed = total**exponent / (total**exponent + (1 - total) ** exponent)
    return (classed * share / np.maximum(share.sum(1, keepdims=True), 1e-12)).astype(np.float32)
