"""A baked field as kernels read it: the occupied blocks of a grid over the field's domain, packed into bytes."""

from __future__ import annotations

from dataclasses import dataclass

import torch

CELLS = 8  # along a side of a block
VERTICES = CELLS + 1  # blocks store the vertices that they share, so that a cell's corners are in one block
VIEWS = 4  # cameras that are remembered for each vertex


@dataclass(frozen=True)
class VoxelField:
    """Of a grid of blocks³ blocks over grid coordinates [0, 1]³, S of them occupied:

    index (blocks³,) int32, x fastest: number of the block + 1, or minus the distance in blocks to the nearest occupied
    one; vertices (S · 9³ · 4,) int32, x fastest: four texels of four bytes a vertex, lowest byte first,

      0  colour without direction (sRGB); root of the opacity of a way as long as a cell
      1  change of the colour with the direction's x, 127.5 being none; index of the most probable class
      2  … with y; the probability of that class
      3  … with z; index of the second class, which has the rest of the probability

    class_opacity (256,) float32: factor of the opacity of each class; harmonic_range: change that 255 means;
    classes: number of classes, 0 without.
    """

    blocks: int
    index: torch.Tensor
    vertices: torch.Tensor
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
