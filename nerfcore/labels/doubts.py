"""Marks that look more like those of another class than like the others of their own: perhaps a slip of the hand.

They are told, and count all the same: see experiments.md, “Exact kernels for labels”.
"""

from __future__ import annotations

import numpy as np
import torch

from .preparation import Preparation
from .seeds import VOID, Seeds
from .unary import LANDMARKS, Kernel, sampled

BANDWIDTH = 0.15  # of the kernel: strokes are compared more broadly than surfels
MARGIN = 0.15  # by how much more a mark is like those of another class
MOST = 0.4  # share of the marks in doubt beyond which looks tell nothing of marks


def doubtful(ready: Preparation, seeds: Seeds, classes: int) -> list[tuple[int, int]]:
    """Revisions of the marks in doubt, and the index of the class that each looks like, the most doubtful one first.

    How alike two marks are is the cosine between the means of their surfels in the space of a Gaussian kernel, that of a mark
    and a class the mean over the class's other marks. A mark that is the only one of its class cannot be doubted. Void is left out.
    """
    known = seeds.label != VOID
    revisions, label = one_label_each(seeds.mark[known], seeds.label[known])
    if len(revisions) < 2:
        return []
    same = alikeness(ready, seeds.surfel[known], seeds.mark[known])
    member = np.eye(classes, dtype=np.float32)[label]
    own = np.arange(len(label)), label
    amount = np.tile(member.sum(0), (len(label), 1))
    amount[own] -= 1
    total = same @ member
    total[own] -= same.diagonal()
    mean = np.where(amount > 0, total / np.maximum(amount, 1), -np.inf)
    compared = mean[own]
    mean[own] = -np.inf
    more = np.where(np.isfinite(compared), mean.max(1) - compared, -np.inf)
    found = np.flatnonzero(more > MARGIN)
    if len(found) > MOST * len(label):
        return []
    return [(int(revisions[i]), int(mean[i].argmax())) for i in found[np.argsort(-more[found])]]


def one_label_each(mark: np.ndarray, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The marks (M,) of surfels (S,), ascending, and the label (M,) of each."""
    revisions, first = np.unique(mark, return_index=True)
    return revisions, label[first]


def alikeness(ready: Preparation, surfel: np.ndarray, mark: np.ndarray) -> np.ndarray:
    """How alike (M, M), in [0, 1], marks are, ascending, by what the surfels (S,) that they cover look like."""
    chosen = sampled(torch.from_numpy(mark))
    columns = ready.columns(surfel[chosen])
    landmarks = columns[sampled(torch.from_numpy(mark[chosen]), LANDMARKS)]
    features = Kernel(landmarks, BANDWIDTH).features(columns)
    _, number, amount = np.unique(mark[chosen], return_inverse=True, return_counts=True)
    total = torch.zeros(len(amount), features.shape[1]).index_add(0, torch.from_numpy(number), features)
    mean = total / torch.from_numpy(amount)[:, None]
    mean /= mean.norm(dim=1, keepdim=True)
    return (mean @ mean.T).numpy()
