"""What a surfel looks like by itself: a classifier learned from the marked surfels, and how far it is from all of them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

STEPS = 60  # of the optimiser
ROWS = 16384  # at once
# See experiments.md, “Labels from a few strokes”.
WAVES = 512
BANDWIDTH = 0.4  # deviation of the waves' frequencies
DECAY = 1e-5
KNOWN_LOOK = 2.85  # distance to the nearest marked surfel, in feature columns, at which prior and void count the same
SHARPNESS = 4
SAMPLES = 48  # marked surfels of each mark that distances are taken to


def class_probabilities(
    features: torch.Tensor,
    marked: torch.Tensor,
    target: torch.Tensor,
    mark: torch.Tensor,
    classes: int,
    check: Callable[[], None],
) -> np.ndarray:
    """Probability (N, classes) float32 of each class by features (N, F): logistic regression on random waves of them. Of
    classes without a marked surfel it is 0.

    Args:
        marked: (S,) indices of the marked surfels; target: (S,) their class indices; mark: (S,) which mark each is of.
    """
    waves = Waves(features.shape[1])
    matrix, bias = logistic_regression(waves(features[marked]), target, balanced(target, mark), classes)
    bias[torch.bincount(target, minlength=classes) == 0] = -torch.inf
    found = []
    for rows in features.split(ROWS):
        check()
        found.append(torch.softmax(waves(rows) @ matrix + bias, 1))
    return torch.cat(found).numpy()


class Waves:
    """Random Fourier features (Rahimi and Recht, "Random features for large-scale kernel machines", 2007): a linear
    function of them is one of a Gaussian kernel's. The same ones in every call."""

    def __init__(self, inputs: int, bandwidth: float = BANDWIDTH) -> None:
        generator = torch.Generator().manual_seed(0)
        self.frequency = torch.randn(inputs, WAVES, generator=generator) * bandwidth
        self.phase = torch.rand(WAVES, generator=generator) * 2 * math.pi

    def __call__(self, features: torch.Tensor) -> torch.Tensor:
        """(N, F) → (N, WAVES)."""
        return torch.addmm(self.phase, features, self.frequency).cos_().mul_(math.sqrt(2 / WAVES))


def balanced(target: torch.Tensor, mark: torch.Tensor) -> torch.Tensor:
    """What each marked surfel counts (S,), in sum 1: every class the same, and in a class every mark, so that a short one
    over a mistake is heard."""
    _, number, amount = mark.unique(return_inverse=True, return_counts=True)
    weight = 1 / amount[number].float()
    total = torch.zeros(int(target.max()) + 1).index_add(0, target, weight)
    return weight / total[target] / int((total > 0).sum())


def logistic_regression(
    features: torch.Tensor, target: torch.Tensor, share: torch.Tensor, classes: int, decay: float = DECAY
) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights (F, C) and bias (C,) of multinomial logistic regression.

    Args:
        features (S, F); target (S,) class index; share (S,) what each counts, in sum 1; decay: ½ decay ‖W‖² is added to
            the loss.
    """
    matrix = torch.zeros(features.shape[1], classes, requires_grad=True)
    bias = torch.zeros(classes, requires_grad=True)
    optimizer = torch.optim.LBFGS([matrix, bias], max_iter=STEPS, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimizer.zero_grad()
        each = torch.nn.functional.cross_entropy(features @ matrix + bias, target, reduction="none")
        value = (each * share).sum() + 0.5 * decay * (matrix * matrix).sum()
        value.backward()
        return value

    optimizer.step(loss)  # type: ignore[arg-type]
    return matrix.detach(), bias.detach()


def distance_to_samples(
    features: torch.Tensor, marked: torch.Tensor, mark: torch.Tensor, check: Callable[[], None]
) -> np.ndarray:
    """Distance (N,) of features (N, F) to the nearest of some marked surfels of each mark (S,)."""
    samples = features[marked[sampled(mark)]]
    found = []
    for rows in features.split(ROWS):
        check()
        found.append(torch.cdist(rows, samples).amin(1))
    return torch.cat(found).numpy()


def familiarity(distance: np.ndarray) -> np.ndarray:
    """How much (N,) in [0, 1] something looks like any that is marked, by its distance (N,) to the nearest."""
    return 0.5 ** ((distance / KNOWN_LOOK) ** SHARPNESS)


def sampled(mark: torch.Tensor) -> torch.Tensor:
    """Indices of at most `SAMPLES` of the marked surfels (S,) of each mark, drawn at random, the same in every call."""
    generator = torch.Generator().manual_seed(0)
    chosen = []
    for number in mark.unique():
        own = torch.nonzero(mark == number).reshape(-1)
        chosen.append(own[torch.randperm(len(own), generator=generator)[:SAMPLES]])
    return torch.cat(chosen)
