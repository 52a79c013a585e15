"""Parts: the surface cut where its looks change, at two levels, so that one click takes a whole part."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy

# Of each level; see experiments.md, “Labels from a few strokes”.
STIFFNESS = (2.0, 10.0)  # k, in units of the median difference of neighbours
LEAST = (10, 50)  # surfels of a part
CHECKED = 50_000  # edges between two looks at whether to stop


def surface_parts(neighbours: np.ndarray, unlike: np.ndarray, check: Callable[[], None] = lambda: None) -> np.ndarray:
    """Number (N, 2) int32 of the part that each surfel is of, at the fine and at the coarse level, by its neighbours (N, K)
    and how `unlike` (N, K) they are (`graph.unlikeness`)."""
    difference = np.sqrt(unlike)
    difference /= max(float(np.median(difference)), 1e-6)
    tree = spanning_tree(neighbours, difference)
    return np.stack(
        [segments(len(neighbours), *tree, k, least, check) for k, least in zip(STIFFNESS, LEAST)], 1
    ).astype(np.int32)


def spanning_tree(neighbours: np.ndarray, difference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges (E, 2) of the minimum spanning forest of a graph, and their differences (E,), ascending.

    Args:
        neighbours (N, K) indices, difference (N, K) of the edges to them.
    """
    count, each = neighbours.shape
    starts = np.arange(0, count * each + 1, each)
    given = np.maximum(difference, 1e-6).reshape(-1)  # zeros would be no edges
    tree = scipy.sparse.csgraph.minimum_spanning_tree(
        scipy.sparse.csr_matrix((given, neighbours.reshape(-1), starts), (count, count))
    ).tocoo()
    order = np.argsort(tree.data, kind="stable")
    return np.stack([tree.row, tree.col], 1)[order], tree.data[order]


def segments(
    count: int, edges: np.ndarray, difference: np.ndarray, stiffness: float, least: int, check: Callable[[], None]
) -> np.ndarray:
    """Number (count,) of the segment of each node, by Felzenszwalb and Huttenlocher, "Efficient graph-based image
    segmentation" (2004): from alike to unalike, an edge joins two segments where it differs no more than the largest edge
    inside of each, plus stiffness / size. Segments smaller than `least` then join the most alike neighbour.

    Args:
        edges (E, 2), difference (E,): of the minimum spanning forest, ascending. Others never join.
    """
    parent = list(range(count))
    size, limit = [1] * count, [stiffness] * count

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    def join(a: int, b: int, value: float) -> None:
        if size[a] < size[b]:
            a, b = b, a
        parent[b] = a
        size[a] += size[b]
        limit[a] = value + stiffness / size[a]

    for small in (False, True):
        if small:  # what is as large already stays as it is
            own = np.array([root(node) for node in range(count)])
            ends = np.bincount(own, minlength=count)[own[edges]]
            asked = (ends.min(1) < least) & (own[edges[:, 0]] != own[edges[:, 1]])
            edges, difference = edges[asked], difference[asked]
        for number, ((first, second), value) in enumerate(zip(edges.tolist(), difference.tolist())):
            if number % CHECKED == 0:
                check()
            a, b = root(first), root(second)
            wanted = min(size[a], size[b]) < least if small else value <= min(limit[a], limit[b])
            if a != b and wanted:
                join(a, b, value)
    return np.unique([root(node) for node in range(count)], return_inverse=True)[1].reshape(-1)
