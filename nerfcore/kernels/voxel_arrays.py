"""A baked field as Warp's kernels take it."""

from __future__ import annotations

import warp as wp

from .runtime import array
from .traversal import MarchSettings
from .voxel_field import VoxelField, cell_length


@wp.struct
class VoxelArrays:
    """A `VoxelField` as kernels take it; exponent: length of a step in cells."""

    blocks: int
    index: wp.array(dtype=int)
    vertices: wp.array(dtype=int)
    changes: wp.array(dtype=int)
    class_opacity: wp.array(dtype=float)
    harmonic_range: float
    classes: int
    exponent: float


def voxel_arrays(field: VoxelField, settings: MarchSettings) -> VoxelArrays:
    """The field as kernels take it."""
    arrays = VoxelArrays()
    arrays.blocks, arrays.harmonic_range, arrays.classes = field.blocks, field.harmonic_range, field.classes
    arrays.exponent = settings.step / cell_length(field.blocks, settings.contracted)
    arrays.index, arrays.class_opacity = array(field.index), array(field.class_opacity)
    arrays.vertices, arrays.changes = array(field.vertices), array(field.changes)
    return arrays
