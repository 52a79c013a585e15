"""The trained field as one function of tensors, written in operators that TensorRT has as well.

What the field computes with kernels of its own is spelled out here: looking up the grid, the evidence of the blend. TensorRT
knows no operators on bits of integers, which hashing needs; see `_hashed_rows`.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import nn

from ..data.box import Box
from ..field.blend import RESOLUTION
from ..field.encoding import frequency_encoding, spherical_harmonics
from ..field.hybrid import HybridField
from ..field.mlp import MLP
from ..geometry.contraction import grid_position, thinning
from ..geometry.similarity import similarity_scale
from ..kernels.encode_torch import PRIMES


class FieldFunction(nn.Module):
    """`points` (N, 3) in the world and unit `directions` (N, 3) from the eye to them → density (N,) per world unit, colour
    (N, 3) sRGB in [0, 1] and, of a field with classes, probabilities (N, K). All float32, on the CPU."""

    def __init__(self, field: HybridField, box: Box) -> None:
        super().__init__()
        self.config, self.contracted, self.thinning = field.config, box.contracted, field.thinning
        self.scale = float(similarity_scale(box.world_from_box))
        matrix = torch.as_tensor(box.box_from_world, dtype=torch.float32)
        self.register_buffer("rotation", matrix[:3, :3].T.contiguous())
        self.register_buffer("offset", matrix[:3, 3].clone())
        self.levels = [] if field.grid is None else list(zip(field.grid.levels, field.gains))
        for index, ((_, first, rows), _) in enumerate(self.levels):
            assert field.grid is not None
            self.register_buffer(f"level_{index}", _copied(field.grid.table[first : first + rows]))
        blend = field.blend if field.blend is not None and not field.blend.warming_up else None
        self.blend = None if blend is None else (blend.floor, blend.rate)
        self.register_buffer("evidence", None if blend is None else _copied(blend.evidence[:, None]))
        self.density_head, self.color_head = _weights(field.density_head), _weights(field.color_head)
        self.implicit = None if field.implicit is None else _weights(field.implicit)
        self.semantic_head = None if field.semantic_head is None else _weights(field.semantic_head)
        codes = field.config.appearance
        seen = torch.zeros(codes) if field.appearance is None else _copied(field.appearance.mean(0))
        self.register_buffer("appearance", seen if codes else None)
        self.hybrid = field.blend is not None
        self.rotation: torch.Tensor
        self.offset: torch.Tensor
        self.appearance: torch.Tensor | None

    def forward(self, points: torch.Tensor, directions: torch.Tensor) -> tuple[torch.Tensor, ...]:
        places = grid_position(points @ self.rotation + self.offset, self.contracted).clamp(0, 1)
        explicit = self._explicit(places) if self.levels else None
        implicit = None
        if self.implicit is not None:
            implicit = _network(self.implicit, frequency_encoding(places, self.config.octaves))
        branches = [part for part in (implicit, explicit) if part is not None]
        out = _network(self.density_head, self._blended(places, branches))
        density = torch.exp((out[:, 0] + self.config.density_shift).clamp(-15, 11)) / self.scale
        if self.thinning:
            density = density * thinning(places)
        parts = [out, spherical_harmonics(directions @ self.rotation * self.scale)]
        if self.appearance is not None:
            parts.append(0 * out[:, :1] + self.appearance)  # as many rows as there are points
        color = torch.sigmoid(_network(self.color_head, torch.cat(parts, 1)))
        if self.semantic_head is None:
            return density, color
        return density, color, torch.softmax(_network(self.semantic_head, torch.cat([out, *branches], 1)), 1)

    def _explicit(self, places: torch.Tensor) -> torch.Tensor:
        """As kernels/encode_torch.py."""
        features = []
        for index, ((resolution, _, size), gain) in enumerate(self.levels):
            cell, weights = _cells(places * (resolution - 1), resolution - 2)
            rows = _dense_rows(cell, resolution) if resolution**3 <= size else _hashed_rows(cell, size)
            features.append(_trilinear(self.get_buffer(f"level_{index}"), rows, weights) * gain)
        return torch.cat(features, 1)

    def _blended(self, places: torch.Tensor, branches: list[torch.Tensor]) -> torch.Tensor:
        """What the density head reads, see `HybridField.geometry`."""
        if not self.hybrid:
            return branches[0]
        implicit, explicit = branches
        w = torch.ones_like(places[:, :1])
        if self.blend is not None:
            floor, rate = self.blend
            cell, weights = _cells(places * RESOLUTION - 0.5, RESOLUTION - 2)
            evidence = _trilinear(self.get_buffer("evidence"), _dense_rows(cell, RESOLUTION), weights)
            w = 1 - (1 - floor) * torch.exp(-rate * evidence)
        if self.config.fusion == "concat":
            return torch.cat([w * explicit, (1 - w) * implicit], 1)
        return w * explicit + (1 - w) * implicit


def _copied(values: torch.Tensor) -> torch.Tensor:
    return values.detach().float().cpu().clone()


def _weights(network: MLP) -> nn.ParameterList:
    return nn.ParameterList(_copied(weight) for weight in network.weights)


def _network(weights: Iterable[torch.Tensor], values: torch.Tensor) -> torch.Tensor:
    first, *others = weights
    values = values @ first.T
    for weight in others:
        values = torch.relu(values) @ weight.T
    return values


def _cells(scaled: torch.Tensor, last: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The cells (N, 3) int64 of positions in cells (N, 3), and the places in them (N, 3) in [0, 1]."""
    floor = scaled.floor().clamp(0, last)
    return floor.long(), (scaled - floor).clamp(0, 1)


def _corners(axes: list[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What the two sides of each axis have, (N, 2, …), laid out so that they broadcast to the eight corners (N, 2, 2, 2, …)."""
    x, y, z = axes
    return x[:, None, None], y[:, None, :, None], z[:, :, None, None]


def _dense_rows(cell: torch.Tensor, side: int) -> torch.Tensor:
    """Rows (N, 2, 2, 2) of the corners of cells in a table of side³."""
    x, y, z = _corners([(cell[:, axis, None] + torch.arange(2)) * side**axis for axis in range(3)])
    return x + y + z


def _hashed_rows(cell: torch.Tensor, size: int) -> torch.Tensor:
    """The same in a hashed table, whose size is a power of two: the exclusive or of one number for each axis. With 1 and −1
    for the bits 0 and 1 it is a product, and the row a sum of bits, exact in float32."""
    powers = 2.0 ** torch.arange(size.bit_length() - 1)

    def signs(axis: int) -> torch.Tensor:
        number = torch.remainder((cell[:, axis, None] + torch.arange(2)) * PRIMES[axis], size).float()[..., None]
        return 1 - 2 * torch.remainder(torch.floor(number / powers), 2)

    x, y, z = _corners([signs(axis) for axis in range(3)])
    return ((1 - x * y * z) @ (powers / 2)).long()


def _trilinear(table: torch.Tensor, rows: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """What a table (rows, F) holds at the corners (N, 2, 2, 2), weighed by the place in the cell (N, 3): (N, F)."""
    x, y, z = _corners([torch.stack([1 - place[:, axis], place[:, axis]], 1) for axis in range(3)])
    weights = (x * y * z).reshape(-1, 8, 1)
    return (table.index_select(0, rows.flatten()).reshape(-1, 8, table.shape[1]) * weights).sum(1)
