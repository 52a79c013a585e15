"""The hybrid implicit–explicit semantic field: position and direction → density, colour, class logits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn

from ..config import MOST_VERTICES, FieldConfig
from ..geometry.contraction import thinning
from ..kernels import network_host
from ..kernels.device import on_host
from ..kernels.encode import FEATURES
from ..kernels.field_host import HostField
from ..kernels.packed_info import PackedInfo
from .blend import BlendWeight
from .encoding import encoded_positions
from .grid import VertexGrid, level_layout
from .mlp import MLP, compute_dtype
from .slices import read_in_slices

DIRECTION_FEATURES = 16  # spherical harmonics of degrees 0 to 3
SHORT_ROW = 8  # numbers below which torch's softmax of a row is ten times as slow as one across rows, on the CPU


class _TruncatedExp(torch.autograd.Function):
    """exp whose value and gradient stay finite (Müller et al., 2022, use the same trick)."""

    @staticmethod
    def forward(ctx, x: torch.Tensor) -> torch.Tensor:
        y = torch.exp(x.clamp(-15.0, 11.0))
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx, *grads):
        return grads[0] * ctx.saved_tensors[0]


@dataclass(frozen=True)
class Geometry:
    """What the density head knows of N points: density (N,) float32, features (N, G), implicit and
    explicit features (N, F) of the branches there are."""

    density: torch.Tensor
    features: torch.Tensor
    implicit: torch.Tensor | None
    explicit: torch.Tensor | None

    def __getitem__(self, rows: torch.Tensor) -> Geometry:
        """The points with these indices (M,)."""
        # Half the time of indexing with brackets, forward and backward.
        parts = (self.density, self.features, self.implicit, self.explicit)
        return Geometry(*(None if x is None else x.index_select(0, rows) for x in parts))  # type: ignore[arg-type]


class HybridField(nn.Module):
    """Explicit grid and implicit network, weighed by evidence, read by one decoder.

    Args:
        config: settings of the field.
        classes: number of class logits; 0 leaves the semantic head out.
        images: number of training images (for appearance codes).
        thinning: density falls outside of the inner half of the grid, see `contraction.thinning`.
    """

    def __init__(self, config: FieldConfig, classes: int, images: int = 0, thinning: bool = False) -> None:
        super().__init__()
        self.config, self.classes, self.thinning = config, classes, thinning
        self.features = config.levels * FEATURES
        self.grid = (
            VertexGrid(level_layout(config.levels, config.coarsest, config.finest or MOST_VERTICES, config.table_log2))
            if config.branch != "implicit"
            else None
        )
        self.concat = config.branch == "hybrid" and config.fusion == "concat"
        self.implicit = (
            MLP(3 + 6 * config.octaves, self.features, config.width, config.implicit_layers)
            if config.branch != "explicit"
            else None
        )
        self.blend = BlendWeight(config) if config.branch == "hybrid" else None
        outputs = 1 + config.geometry_features
        decoder_inputs = self.features * (2 if self.concat else 1)
        self.density_head = MLP(decoder_inputs, outputs, config.width, 2)
        self.color_head = MLP(
            outputs + DIRECTION_FEATURES + config.appearance, 3, config.width, config.color_layers, output_gain=0.5
        )
        semantic_inputs = outputs + self.features * sum(b is not None for b in (self.grid, self.implicit))
        self.semantic_head = (
            MLP(semantic_inputs, classes, config.width, config.semantic_layers) if classes > 0 else None
        )
        self.appearance = nn.Parameter(torch.zeros(images, config.appearance)) if config.appearance and images else None
        self.gains = [1.0] * config.levels
        self.register_buffer("_device", torch.zeros(0), persistent=False)
        self._device: torch.Tensor

    @property
    def dtype(self) -> torch.dtype:
        return compute_dtype(self.config.precision, self._device.device)

    def parameter_count(self) -> int:
        """Trainable numbers: grid rows and network weights."""
        networks = sum(p.numel() for p in self.parameters())
        return networks + (self.grid.parameter_count() if self.grid is not None else 0)

    def set_progress(self, progress: float, fade: float, step: int) -> None:
        """Coarse-to-fine: level l fades in over `fade` of training; the blend is held at 1 while it warms up."""
        levels = self.config.levels
        # Half of the levels are there from the start; the rest appear one after the other.
        position = levels if fade <= 0 else levels / 2 + levels / 2 * min(1.0, progress / fade)
        self.gains = [float(min(1.0, max(0.0, position - index))) for index in range(levels)]
        if self.blend is not None:
            self.blend.warming_up = step < self.config.blend_warmup

    def geometry(self, points: torch.Tensor, precomputed: torch.Tensor | None = None) -> Geometry:
        """Density and features of points (N, 3) in grid coordinates [0, 1]³; density per normalised unit length.

        `precomputed` (N, F): explicit features of these points, from a pass without gradients.
        """
        if torch.is_grad_enabled():
            return Geometry(*self._geometry(points, precomputed))
        if precomputed is None and self.on_host(points.device):
            return self._read_on_host(points)
        given = (points,) if precomputed is None else (points, precomputed)
        return Geometry(*read_in_slices(self._geometry, *given))  # type: ignore[arg-type]

    def _geometry(
        self, points: torch.Tensor, precomputed: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None, torch.Tensor | None]:
        explicit = self.grid(points, self.gains, precomputed) if self.grid is not None else None
        implicit = None
        if self.implicit is not None:
            implicit = self.implicit(encoded_positions(points, self.config.octaves, self.dtype), self.dtype)
        if explicit is None:
            hidden = implicit
        elif implicit is None:
            hidden = explicit
        else:
            assert self.blend is not None
            w = self.blend(points)[:, None]
            if self.concat:
                parts = w.to(self.dtype) * explicit.to(self.dtype), (1 - w).to(self.dtype) * implicit
                hidden = torch.cat(parts, 1)
            else:
                hidden = torch.lerp(implicit.to(explicit.dtype), explicit, w)
        out = self.density_head(hidden, self.dtype)
        return self._density_of(out, points), out, implicit, explicit

    def _density_of(self, out: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """Density (N,) from what the density head says (N, G) of points (N, 3)."""
        density = _TruncatedExp.apply(out[:, 0].float() + self.config.density_shift)
        return density * thinning(points) if self.thinning else density

    def on_host(self, device: torch.device) -> bool:
        """Whether the CPU's own kernel can read this field."""
        heads = (self.implicit, self.density_head, self.color_head, self.semantic_head)
        networks = [part for part in heads if part is not None]
        narrow = all(network_host.supported(tuple(part.weights)) for part in networks)
        return on_host(device) and self.dtype == torch.float32 and narrow

    def _read_on_host(self, points: torch.Tensor) -> Geometry:
        out, explicit, implicit = self._host_field().read(points, True, self.semantic_head is not None)
        return Geometry(self._density_of(out, points), out, implicit, explicit)

    def weighted_on_host(
        self, points: torch.Tensor, deltas: torch.Tensor, packed_info: PackedInfo, cull: float
    ) -> tuple[Geometry, torch.Tensor]:
        """Geometry and rendering weights (N,) of packed samples at points (N, 3) on the CPU, without gradients: features only
        where the weight is above `cull`, nothing behind where a ray is opaque (density −1, weight 0)."""
        read = self._host_field().render(points, deltas, packed_info, cull, self.semantic_head is not None)
        density, weights, out, explicit, implicit = read
        return Geometry(density, out, implicit, explicit), weights

    def _host_field(self) -> HostField:
        blend = None if self.blend is None or self.blend.warming_up else self.blend
        return HostField.of(
            None if self.grid is None else self.grid.table,
            [] if self.grid is None else self.grid.levels,
            self.gains,
            None if blend is None else blend.evidence,
            1.0 if blend is None else blend.floor,
            0.0 if blend is None else blend.rate,
            () if self.implicit is None else tuple(self.implicit.weights),
            self.config.octaves,
            self.concat,
            tuple(self.density_head.weights),
            self.config.density_shift,
            self.thinning,
        )

    def density(self, points: torch.Tensor) -> torch.Tensor:
        """Density (N,) alone."""
        if not torch.is_grad_enabled() and self.on_host(points.device):
            return self._density_of(self._host_field().read(points, False, False)[0], points)
        return self.geometry(points).density

    def density_along(self, points: torch.Tensor, deltas: torch.Tensor, packed_info: PackedInfo) -> torch.Tensor:
        """Density (N,) of packed samples at points (N, 3) of lengths deltas (N,), without gradients. On the CPU what lies
        behind where a ray is opaque is not read and has 0."""
        with torch.no_grad():
            if self.on_host(points.device):
                return self._host_field().render(points, deltas, packed_info, math.inf, False)[0].clamp_(min=0)
            return self.density(points)

    def density_until(
        self, least: float, points: torch.Tensor, deltas: torch.Tensor, packed_info: PackedInfo
    ) -> torch.Tensor:
        """What `density` says, to the bit, of packed samples as in `density_along`. On the CPU what lies behind where a ray's
        transmittance is below `least` is not read and has 0."""
        if not self.on_host(points.device):
            return self.density(points)
        density, _, out, _, _ = self._host_field().render(points, deltas, packed_info, -1.0, False, least)
        return torch.where(density < 0, 0.0, self._density_of(out, points))

    def color(self, geometry: Geometry, directions: torch.Tensor, codes: torch.Tensor | None = None) -> torch.Tensor:
        """Colour (N, 3) in [0, 1]; `directions` (N, 16) spherical harmonics, `codes` (N, A) appearance."""
        parts = [geometry.features, directions.to(self.dtype)]
        if self.config.appearance:
            if codes is None:
                codes = self._mean_code().expand(len(directions), -1)
            parts.append(codes.to(self.dtype))
        return torch.sigmoid(self.color_head(torch.cat(parts, 1), self.dtype).float())

    @torch.no_grad()
    def forget_directions(self) -> None:
        """Make colours the same from everywhere: weights of all harmonics but the constant one become zero."""
        first = 1 + self.config.geometry_features
        self.color_head.weights[0][:, first + 1 : first + DIRECTION_FEATURES] = 0

    def _mean_code(self) -> torch.Tensor:
        """The appearance code (A,) of pictures."""
        if self.appearance is None:
            return self._device.new_zeros(self.config.appearance)
        return self.appearance.mean(0)

    def logits(self, geometry: Geometry) -> torch.Tensor:
        """Class logits (N, K). The viewing direction has no say; both branches are read as they are as well, for what
        is too fine for the features that density and colour share."""
        assert self.semantic_head is not None
        branches = [part.to(self.dtype) for part in (geometry.implicit, geometry.explicit) if part is not None]
        return self.semantic_head(torch.cat([geometry.features, *branches], 1), self.dtype).float()

    def class_probabilities(self, geometry: Geometry) -> torch.Tensor:
        """Probability of each class (N, K), from the logits."""
        return self._softmax(self.logits(geometry))

    def shaded_on_host(
        self,
        geometry: Geometry,
        chosen: torch.Tensor,
        directions: torch.Tensor,
        rays: torch.Tensor,
        codes: torch.Tensor | None,
        classes: Literal["probabilities", "logits"] | None,
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Colour (M, 3) and classes (M, K) of the points `chosen` (M,), whose rays are `rays` (M,), on the CPU without
        gradients; `directions` (R, 16) spherical harmonics and `codes` (R, A) of rays."""
        parts = [(geometry.features, chosen), (directions, rays)]
        if self.config.appearance:
            shared = codes is None
            parts.append((self._mean_code()[None], torch.zeros_like(rays)) if shared else (codes, rays))  # type: ignore[arg-type]
        color = torch.sigmoid(network_host.forward(parts, tuple(self.color_head.weights))[0])
        if classes is None or self.semantic_head is None:
            return color, None
        branches = [(part, chosen) for part in (geometry.implicit, geometry.explicit) if part is not None]
        known = [(geometry.features, chosen), *branches]
        logits = network_host.forward(known, tuple(self.semantic_head.weights))[0]
        return color, logits if classes == "logits" else self._softmax(logits)

    def _softmax(self, logits: torch.Tensor) -> torch.Tensor:
        if self.classes >= SHORT_ROW or logits.device.type != "cpu":
            return torch.softmax(logits, 1)
        return torch.softmax(logits.t().contiguous(), 0).t().contiguous()
