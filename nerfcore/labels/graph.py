"""What surfels look like as columns of numbers, and how strongly neighbours belong together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from .surfels import Surfels, cell_of
from .walker import edge_matrix

CELLS = 20_000  # of the coarse graph; not tuned
# Weights of the columns in units of their deviation; see experiments.md, “Surfels that end where colours do”, and for the
# filters “Exact kernels for labels”.
LAB, LAB_AROUND, CONTRAST, TEXTURE = 1.0, 0.5, 0.5, 0.5
NORMAL, HEIGHT, PLANARITY, FIELD, FIELD_AROUND = 0.85, 1.0, 0.3, 1.2, 1.0
FILTERS, TOKENS = 0.42, 1.5
EDGE_SCALE = 4.0  # b of an edge's weight exp(−Σ d²/(b·median d²))


@dataclass(frozen=True)
class Graph:
    """Edges of N surfels and of C cells of a coarser grid: symmetric weights edges (N, N), coarse (C, C); cell (N,) of each
    surfel."""

    edges: scipy.sparse.csr_matrix
    coarse: scipy.sparse.csr_matrix
    cell: np.ndarray


def feature_columns(surfels: Surfels, neighbours: np.ndarray) -> np.ndarray:
    """Columns (N, F) float32 by which surfels are told apart, mostly means over their neighbours (N, K), for one surfel is
    noisy. Places are not among them: what looks alike is alike wherever it stands."""

    def around(values: np.ndarray) -> np.ndarray:
        return values[neighbours].mean(1)

    lab = standardised(surfels.lab)
    contrast = standardised(np.log(lab[neighbours].std(1) + 0.02))
    texture = around(standardised(np.log1p(surfels.texture)[:, None]))
    planarity = around(standardised(surfels.planarity))
    height = standardised(surfels.height[:, None])
    field = around(np.asarray(surfels.field))
    columns = [
        LAB * lab,
        LAB_AROUND * around(lab),
        CONTRAST * contrast,
        TEXTURE * texture,
        NORMAL * around(np.asarray(surfels.normal)),
        HEIGHT * height,
        PLANARITY * planarity,
        FIELD * field,
        FIELD_AROUND * around(field),
    ]
    return np.concatenate(columns, 1).astype(np.float32)


def standardised(columns: np.ndarray) -> np.ndarray:
    """Columns (N, F) with mean 0 and deviation 1."""
    columns = np.asarray(columns, np.float32)
    return (columns - columns.mean(0)) / np.maximum(columns.std(0), 1e-6)


def unlikeness(surfels: Surfels, neighbours: np.ndarray) -> np.ndarray:
    """How much (N, K) surfels differ from their neighbours (N, K): squared distances of colour, normal and features of the
    field, each in units of its median, in sum."""
    total = np.zeros(neighbours.shape, np.float32)
    for values in (surfels.lab, surfels.normal, surfels.field):
        square = ((values[neighbours] - values[:, None]) ** 2).sum(2)
        total += square / max(float(np.median(square)), 1e-12)
    return total


def make_graph(surfels: Surfels, neighbours: np.ndarray, unlike: np.ndarray) -> Graph:
    """The graph of surfels with these neighbours (N, K), which are as `unlike` (N, K) as `unlikeness` says; and that of the
    cells of a coarser grid, whose weights are sums."""
    edges = edge_matrix(neighbours, np.exp(-unlike / EDGE_SCALE))
    cell, count = cell_of(np.asarray(surfels.position, np.float64), min(CELLS, max(1, len(surfels) // 4)))
    return Graph(edges, joined(edges, cell, count), cell.astype(np.int32))


def joined(edges: scipy.sparse.csr_matrix, group: np.ndarray, count: int | None = None) -> scipy.sparse.csr_matrix:
    """Weights (C, C) between groups of nodes, (N,) the group of each: sums of those between nodes (N, N)."""
    members = membership(group, int(group.max()) + 1 if count is None else count)
    found = (members.T @ edges @ members).tocsr()
    found.setdiag(0)
    found.eliminate_zeros()
    return found


def membership(cell: np.ndarray, count: int) -> scipy.sparse.csr_matrix:
    """Matrix (N, C) float32 that says which cell each surfel is in (N,)."""
    rows = np.arange(len(cell))
    return scipy.sparse.csr_matrix((np.ones(len(cell), np.float32), (rows, cell)), (len(cell), count))


def held_groups(group: np.ndarray, seeds: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which groups, (N,) that of each node, have known nodes (S,), ascending, and the mean of their probabilities (S, C)."""
    found, number, amount = np.unique(group[seeds], return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(number, column, len(found)) for column in values.T], 1)
    return found, (mean / amount[:, None]).astype(np.float32)
