"""A baked field as kernels read it: the occupied blocks of a grid over the field's domain, packed into bytes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

CELLS = 8  # along a side of a block
VERTICES = CELLS + 1  # blocks store the vertices that they share, so that a cell's corners are in one block
COARSE = CELLS // 2 + 1  # of them along a side for which changes of the colour are stored: every second one
TEXELS = 2  # of a vertex
AXES = 3  # along which colours change: texels of a coarse vertex
VIEWS = 4  # cameras that are remembered for each vertex
SLOT_BITS = 22  # of an entry of the index


@dataclass(frozen=True)
class VoxelField:
    """Of a grid of blocks³ blocks over grid coordinates [0, 1]³, S of them occupied:

    index (blocks³,) int32, x fastest: minus the distance in blocks to the nearest occupied one; or in its lower `SLOT_BITS`
    bits number of the block + 1, and above them which of its eight octants (x lowest) hold anything.

    vertices (S · 9³ · 2,) int32, x fastest: two texels of four bytes a vertex, lowest byte first,

      0  colour without direction (sRGB); root of the opacity of a way as long as a cell
      1  index of the most probable class; its probability; index of the second class, which has the rest; unused

    changes (S · 5³ · 3,) int32: of every second vertex, three texels: change of the colour with the direction's x, y and z,
    127.5 being none; unused.

    class_opacity (256,) float32: factor of the opacity of each class; harmonic_range: change that 255 means;
    classes: number of classes, 0 without.
    """

    blocks: int
    index: torch.Tensor
    vertices: torch.Tensor
    changes: torch.Tensor
    class_opacity: torch.Tensor
    harmonic_range: float
    classes: int


@dataclass(frozen=True)
class VoxelRays:
    """Of R rays: color (R, 3) sRGB without background, opacity (R,), depth (R,) expected distance (normalised units, not
    divided by opacity), probabilities (R, K) or None."""

    color: torch.Tensor
    opacity: torch.Tensor
    depth: torch.Tensor
    probabilities: torch.Tensor | None


def cell_length(blocks: int, contracted: bool) -> float:
    """Side of a cell inside the cube [−1, 1]³ in normalised units."""
    return (4.0 if contracted else 2.0) / (blocks * CELLS)


def occupied_octants(roots: torch.Tensor) -> torch.Tensor:
    """Of blocks (S · 9³,) uint8 roots of opacity, which octants hold anything: (S,) int32, a bit for each, x lowest."""
    half, found = CELLS // 2, roots.new_zeros(len(roots) // VERTICES**3, dtype=torch.int32)
    there = (roots > 0).view(-1, VERTICES, VERTICES, VERTICES)
    for octant in range(8):
        x, y, z = (half * (octant >> axis & 1) for axis in range(3))
        part = there[:, z : z + half + 1, y : y + half + 1, x : x + half + 1]
        found |= part.flatten(1).any(1).int() << octant
    return found


def occupied_blocks(index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of a field's `index` (blocks³,), the places in it of its S occupied blocks, and the number of each."""
    places = np.flatnonzero(index > 0)
    return places, (index[places] & ((1 << SLOT_BITS) - 1)) - 1


def texels_of(words: torch.Tensor, count: int) -> Any:
    """The bytes (N, count, 4) uint8, numpy, of int32 words (N · count,)."""
    return words.cpu().view(torch.uint8).view(-1, count, 4).numpy()
