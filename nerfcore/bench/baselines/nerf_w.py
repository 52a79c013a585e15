"""NeRF with the appearance codes of NeRF-W (its variant NeRF-A: no transient head).

Source: Martin-Brualla et al., “NeRF in the Wild”, 2021, section 4.1. Held-out photos are rendered with the mean code:
the publication fits one to half of each of them.
"""

from __future__ import annotations

import torch
from torch import nn

from .method import Rays, Setup
from .nerf import FIRST_RATE, NeRF

CODE = 48


class NeRFW(NeRF):
    def __init__(self, setup: Setup) -> None:
        super().__init__(setup, extra_views=CODE)
        self.codes = nn.Embedding(setup.images, CODE).to(setup.device)
        self.optimizer = torch.optim.Adam(self.parameters(), FIRST_RATE)

    def views(self, rays: Rays) -> torch.Tensor:
        if rays.images is None:
            code = self.codes.weight.mean(0).expand(len(rays), CODE)
        else:
            code = self.codes(rays.images)
        return torch.cat([super().views(rays), code], 1)
