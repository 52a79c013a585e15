"""Where classes meet in the labels: rays drawn there sharpen outlines, and small things are nearly all outline."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from ..data.pixels import VOID, PixelStore

REACH = 2  # pixels from another class
MOST_OFTEN = 5  # times as often as others: where few photos are labelled, these must not have most of the rays


class Outlines:
    """The usable labelled pixels that have another class at most `REACH` pixels away in x and in y.

    places (N,) int64: their flat positions, class after class, on the store's device. A class with n of them gets
    rays in proportion to √n, so that rare classes have more than their share.
    """

    def __init__(self, store: PixelStore) -> None:
        found = outline_mask(store).nonzero()[:, 0]
        label = store.label[found].long()
        self.places = found[torch.argsort(label, stable=True)]
        self.count = torch.bincount(label, minlength=VOID)
        self.first = self.count.cumsum(0) - self.count
        self.upto = self.count.sqrt().cumsum(0)
        self.share = len(self.places) / max(len(store), 1)

    def number(self, rays: int, asked: float) -> int:
        """How many of the rays of a step to draw here when a share of them is asked for."""
        return round(rays * min(asked, MOST_OFTEN * self.share))

    def draw(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """`count` flat positions (count,), with repetition; there must be outlines."""
        where, which = torch.rand(2, count, device=self.places.device, generator=generator)
        label = torch.searchsorted(self.upto, where * self.upto[-1], right=True).clamp(max=VOID - 1)
        index = self.first[label] + (which * self.count[label]).long()
        return self.places[index.clamp(max=len(self.places) - 1)]


def outline_mask(store: PixelStore) -> torch.Tensor:
    """Which pixels (P,) of a store are outlines."""
    outline = torch.zeros(len(store), dtype=torch.bool, device=store.device)
    for view, camera in enumerate(store.cameras):
        pixels = slice(int(store.first[view]), int(store.first[view + 1]))
        label = store.label[pixels].view(1, camera.height, camera.width).float()
        void = label == VOID
        if bool(void.all()):
            continue
        largest = F.max_pool2d(torch.where(void, -1.0, label), 2 * REACH + 1, 1, REACH)
        least = -F.max_pool2d(-label, 2 * REACH + 1, 1, REACH)  # VOID is larger than any class
        outline[pixels] = ((largest != least) & ~void).view(-1)
    if store.usable is not None:
        keep = torch.zeros_like(outline)
        keep[store.usable] = True
        outline &= keep
    return outline
