"""What a fused kernel is compiled for."""

from __future__ import annotations

from dataclasses import dataclass

from .fused_network import GRANULE, packed_size, padded

HARMONICS = 16


@dataclass(frozen=True)
class FusedShape:
    """What a fused kernel is compiled for. Sizes of networks are those of the field, not padded.

    levels: of the grid. octaves: of the implicit branch, 0 when there is none. concat: the density head reads both
    branches side by side. width: of hidden layers. geometry: outputs of the density head. color_layers: 2 or 3.
    appearance: length of the code. classes: padded number of classes, 0 without semantics. logits: sum logits instead
    of probabilities.
    """

    levels: int
    octaves: int
    concat: bool
    width: int
    geometry: int
    color_layers: int
    appearance: int
    classes: int
    logits: bool

    @property
    def features(self) -> int:
        return padded(self.levels * 4)

    @property
    def implicit(self) -> tuple[int, ...]:
        return (padded(3 + 6 * self.octaves), self.width, self.features)

    @property
    def density(self) -> tuple[int, ...]:
        return (self.features * (2 if self.concat else 1), self.width, padded(self.geometry))

    @property
    def color(self) -> tuple[int, ...]:
        inputs = padded(self.geometry + HARMONICS + self.appearance)
        return (inputs, *[self.width] * (self.color_layers - 1), GRANULE)

    @property
    def semantic(self) -> tuple[int, ...]:
        """Implicit and explicit features follow the padded geometry, so that all start at a multiple of 16."""
        inputs = padded(self.geometry) + self.features * (2 if self.octaves else 1)
        return (inputs, self.width, self.classes)

    def networks(self) -> dict[str, tuple[int, ...]]:
        """Padded sizes of the networks there are, in the order in which their weights are packed."""
        parts = {"implicit": self.implicit} if self.octaves else {}
        parts |= {"density": self.density, "color": self.color}
        return parts | ({"semantic": self.semantic} if self.classes else {})

    def places(self) -> dict[str, int]:
        """First of each network's packed weights, and their number as "all"."""
        place, first = 0, {}
        for name, sizes in self.networks().items():
            first[name] = place
            place += packed_size(sizes)
        return {**first, "all": place}
