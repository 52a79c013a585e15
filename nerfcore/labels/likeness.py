"""Which parts of the surface look like which, and how strange a part is to everything that is marked.

Looks of one class are joined by those in between, which other parts of the surface show; a class without marks is a group
of its own, even where some mark looks no less like it than like the far end of its own class. So a walk goes from part to
part by how alike they look, wherever they lie (label propagation: Zhu and Ghahramani, "Learning from labeled and unlabeled
data with label propagation", 2002), and ends at a part that a mark looks like, or on the way.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy
import torch

from .walker import edge_matrix, random_walk

# See experiments.md, “Looks that no small steps lead to”.
NEIGHBOURS = 15
MARKED = 4.0  # conductance from a part that looks exactly like a mark; to a part of the same look it is 1
LOST = 0.1  # conductance of each part to nowhere
ROWS = 1024  # at once


def likeness(features: np.ndarray, check: Callable[[], None]) -> tuple[scipy.sparse.csr_matrix, float]:
    """Edges (P, P) from each part to those that look most like it, by features (P, F), and the distance of looks that they
    are weighed by: the median of that to the last neighbour."""
    count = min(NEIGHBOURS, len(features) - 1)
    if count < 1:
        return scipy.sparse.csr_matrix((len(features), len(features)), dtype=np.float32), 1.0
    columns, found = torch.from_numpy(features), []
    for rows in columns.split(ROWS):
        check()
        found.append(torch.cdist(rows, columns).topk(count + 1, largest=False))
    distance = torch.cat([near.values[:, 1:] for near in found]).numpy()
    neighbours = torch.cat([near.indices[:, 1:] for near in found]).numpy()
    scale = max(float(np.median(distance[:, -1])), 1e-6)
    return edge_matrix(neighbours, np.exp(-((distance / scale) ** 2))), scale


def strangeness(
    edges: scipy.sparse.csr_matrix, scale: float, distance: np.ndarray, check: Callable[[], None]
) -> np.ndarray:
    """How strange (P,) in [0, 1] parts are: the probability that a walk over `likeness` ends before it comes to a part that a
    mark looks like, by the distance (P,) of each to the look of the nearest mark."""
    marked = MARKED * np.exp(-((distance / scale) ** 2))
    ones, none = np.ones((len(distance), 1), np.float32), np.zeros(0, np.int64)
    return 1 - random_walk(edges, ones, marked, LOST, none, ones[:0], None, check)[:, 0]
