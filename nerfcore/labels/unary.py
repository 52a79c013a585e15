"""What a surfel looks like by itself: a classifier learned from the marked surfels, and how far it is from all of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

STEPS = 60  # of the optimiser
ROWS = 16384  # at once
# See experiments.md, “Exact kernels for labels”, “Labels from a few strokes” and “Looks that no small steps lead to”.
LANDMARKS = 512  # marked surfels, about, that a kernel is taken to
BANDWIDTH = 0.25  # inverse deviation of the Gaussian kernel, in feature columns
RIDGE = 1e-4  # added to the kernel's diagonal, which is 1: marked surfels may be the same
DECAY = 1e-5
KNOWN_LOOK = 2.85  # distance to the nearest marked surfel, in feature columns, at which prior and void count the same
KNOWN_KIND = 2.5  # the same of that distance times (how strange it is + STRANGE)
STRANGE = 0.3
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
    """Probability (N, classes) float32 of each class by features (N, F): logistic regression with a Gaussian kernel. Of
    classes without a marked surfel it is 0.

    Args:
        marked: (S,) indices of the marked surfels; target: (S,) their class indices; mark: (S,) which mark each is of.
    """
    kernel = Kernel(features[marked[sampled(mark, LANDMARKS)]])
    matrix, bias = logistic_regression(kernel.features(features[marked]), target, balanced(target, mark), classes)
    bias[torch.bincount(target, minlength=classes) == 0] = -torch.inf
    weights, found = kernel.weights(matrix), []
    for rows in features.split(ROWS):
        check()
        found.append(torch.softmax(torch.addmm(bias, kernel(rows), weights), 1))
    return torch.cat(found).numpy()


class Kernel:
    """A Gaussian kernel to landmarks (M, F), and features whose products are the kernel's as far as these tell (Nyström's
    method: Williams and Seeger, "Using the Nyström method to speed up kernel machines", 2001)."""

    def __init__(self, landmarks: torch.Tensor, bandwidth: float = BANDWIDTH) -> None:
        self._bandwidth = bandwidth
        scaled = landmarks * bandwidth
        self._across, self._size = scaled.T.contiguous(), -0.5 * scaled.square().sum(1)
        own = self(landmarks).double()
        own.diagonal().add_(RIDGE)
        self._root = torch.linalg.cholesky(own)

    def __call__(self, rows: torch.Tensor) -> torch.Tensor:
        """The kernel (N, M) of rows (N, F) and the landmarks: exp(−½ (bandwidth · distance)²)."""
        scaled = rows * self._bandwidth
        half = torch.addmm(self._size, scaled, self._across).sub_(0.5 * scaled.square().sum(1, keepdim=True))
        return half.clamp_(max=0).exp_()

    def features(self, rows: torch.Tensor) -> torch.Tensor:
        """(N, F) → (N, M): their products are the kernel between rows."""
        return torch.linalg.solve_triangular(self._root, self(rows).T.double(), upper=False).T.float()

    def weights(self, matrix: torch.Tensor) -> torch.Tensor:
        """Weights (M, C) of the kernel itself that do what those (M, C) of `features` do."""
        return torch.linalg.solve_triangular(self._root.T, matrix.double(), upper=True).float()


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


def familiarity(distance: np.ndarray, strange: np.ndarray) -> np.ndarray:
    """How much (N,) in [0, 1] something looks like any that is marked, by its distance (N,) to the nearest and how strange
    (N,) in [0, 1] it is to all (see likeness.py)."""
    return 0.5 ** ((distance * np.maximum(1 / KNOWN_LOOK, (strange + STRANGE) / KNOWN_KIND)) ** SHARPNESS)


def sampled(mark: torch.Tensor, most: int | None = None) -> torch.Tensor:
    """Indices of at most `SAMPLES` of the marked surfels (S,) of each mark, and of about `most` in all, drawn at random, the
    same in every call."""
    generator = torch.Generator().manual_seed(0)
    numbers, chosen = mark.unique(), []
    each = SAMPLES if most is None else min(SAMPLES, max(1, most // max(len(numbers), 1)))
    for number in numbers:
        own = torch.nonzero(mark == number).reshape(-1)
        chosen.append(own[torch.randperm(len(own), generator=generator)[:each]])
    return torch.cat(chosen)
