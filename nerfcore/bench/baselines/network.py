"""The network of NeRF, which Mip-NeRF, NeRF-W and Semantic-NeRF share.

Source: Mildenhall et al., “NeRF”, 2020, figure 7; its semantic head: Zhi et al., “In-Place Scene Labelling and
Understanding with Implicit Scene Representation”, 2021, figure 2.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn.functional import relu

LAYERS, WIDTH, VIEW_WIDTH, SKIP = 8, 256, 128, 5  # the position enters again before layer SKIP


class RadianceNetwork(nn.Module):
    """Encoded positions (N, positions) and views (N, views) → raw density (N,), raw colour (N, 3), logits (N, classes)."""

    def __init__(self, positions: int, views: int, classes: int = 0) -> None:
        super().__init__()
        inputs = [positions if i == 0 else WIDTH + positions * (i == SKIP) for i in range(LAYERS)]
        self.trunk = nn.ModuleList(nn.Linear(n, WIDTH) for n in inputs)
        self.density = nn.Linear(WIDTH, 1)
        self.feature = nn.Linear(WIDTH, WIDTH)
        self.view = nn.Linear(WIDTH + views, VIEW_WIDTH)
        self.color = nn.Linear(VIEW_WIDTH, 3)
        self.semantic = (
            nn.Sequential(nn.Linear(WIDTH, WIDTH // 2), nn.ReLU(), nn.Linear(WIDTH // 2, classes)) if classes else None
        )
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                nn.init.xavier_uniform_(layer.weight)
                nn.init.zeros_(layer.bias)

    def forward(
        self, positions: torch.Tensor, views: torch.Tensor, semantics: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
        x = positions
        for index, layer in enumerate(self.trunk):
            x = relu(layer(torch.cat([x, positions], 1) if index == SKIP else x))
        color = self.color(relu(self.view(torch.cat([self.feature(x), views.to(x.dtype)], 1))))
        logits = self.semantic(x).float() if self.semantic is not None and semantics else None
        return self.density(x)[:, 0].float(), color.float(), logits
