"""The random walker with priors and a sink: class probabilities on a graph from some nodes that are known.

Grady, "Multilabel random walker image segmentation using prior models" (2005): with edge weights w, Laplacian L, priors p of
strength γ, the probability x that a walker from a node first ends at a class minimises Σ wᵢⱼ (xᵢ − xⱼ)² + Σ γᵢ (xᵢ − pᵢ)².
Here every node is also joined to void by a conductance ε, which takes in the walkers that nothing explains.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy

TOLERANCE = 1e-3  # of the residual, relative to the right side
MOST_STEPS = 200


def edge_matrix(neighbours: np.ndarray, weights: np.ndarray) -> scipy.sparse.csr_matrix:
    """Symmetric weights (N, N) float32 of a graph; where both ends name each other, the larger weight counts.

    Args:
        neighbours (N, K) indices, weights (N, K) of the edges to them.
    """
    count, each = neighbours.shape
    starts = np.arange(0, count * each + 1, each)
    one_way = scipy.sparse.csr_matrix(
        (weights.reshape(-1).astype(np.float32), neighbours.reshape(-1), starts), (count, count)
    )
    return one_way.maximum(one_way.T).tocsr()


def random_walk(
    edges: scipy.sparse.csr_matrix,
    prior: np.ndarray,
    strength: np.ndarray,
    sink: float | np.ndarray,
    seeds: np.ndarray,
    values: np.ndarray,
    start: np.ndarray | None = None,
    check: Callable[[], None] = lambda: None,
    tolerance: float = TOLERANCE,
    most_steps: int = MOST_STEPS,
) -> np.ndarray:
    """Probabilities (N, C) of the classes at all nodes; what is missing to 1 is void.

    Conjugate gradients on all classes at once, with the diagonal as preconditioner.

    Args:
        edges: (N, N) symmetric weights. prior: (N, C); strength: (N,) γ; sink: ε ≥ 0, of each node or of all.
        seeds: (S,) indices of the known nodes, each once; values: (S, C) their probabilities.
        start: (N, C) probabilities of a similar problem. check: called in every step, may raise to stop. tolerance: of the
            residual, relative to the right side; most_steps: after which it ends all the same.
    """
    count, classes = prior.shape
    free = np.ones(count, bool)
    free[seeds] = False
    x = np.zeros((count, classes), np.float32) if start is None else start.astype(np.float32)
    x[seeds] = values
    total = np.asarray(edges.sum(1)).reshape(-1) + strength + sink
    diagonal = np.maximum(total, 1e-12).astype(np.float32)[:, None]
    inside = free.astype(np.float32)[:, None]
    right = strength.astype(np.float32)[:, None] * prior.astype(np.float32)
    # Known nodes are held: their rows of the residual are 0, so steps never move them.
    residual = (right - (diagonal * x - edges @ x)) * inside
    size = np.sqrt(((right + edges @ (x * (1 - inside))) ** 2 * inside / diagonal).sum(0))
    ahead = residual / diagonal
    product = (residual * ahead).sum(0)
    direction = ahead
    for _ in range(most_steps):
        check()
        if (np.sqrt(product) <= tolerance * np.maximum(size, 1e-12)).all():
            break
        pushed = (diagonal * direction - edges @ direction) * inside
        step = product / np.maximum((direction * pushed).sum(0), 1e-30)
        x += step * direction
        residual -= step * pushed
        ahead = residual / diagonal
        following = (residual * ahead).sum(0)
        direction = ahead + following / np.maximum(product, 1e-30) * direction
        product = following
    return x.clip(0, 1)
