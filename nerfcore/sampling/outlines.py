"""Where classes meet in the labels: rays drawn there sharpen outlines, and small things are nearly all outline."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from ..data.pixels import VOID, PixelStore

# Measured: the limit (docs/experiments.md, “Rays at outlines”). The distance is not tuned.
DISTANCE = 2  # pixels from another class
MOST_OFTEN = 4  # times as often as other pixels: where few photos are labelled these would have most of the rays


class Outlines:
    """The usable labelled pixels that have another class at most `DISTANCE` pixels away in x and in y.

    pixel_indices (N,) int64: their flat indices, class after class. A class with n of them gets
    rays in proportion to √n, so that rare classes have more than their share, but at most `MOST_OFTEN` times as many
    as other pixels. `share`: of a step's rays that these are when a share `asked` is asked for.
    """

    def __init__(self, store: PixelStore, asked: float) -> None:
        self.store, self.mask = store, outline_mask(store)
        indices = self.mask.nonzero()[:, 0]
        label = store.label[indices].long()
        self.pixel_indices = indices[torch.argsort(label, stable=True)]
        count, pixels = torch.bincount(label, minlength=VOID).cpu(), max(len(store), 1)
        root = count.double().sqrt()
        share = torch.minimum(asked * root / root.sum().clamp(min=1), MOST_OFTEN * count / pixels)
        self.count, self.first = count.to(store.device), (count.cumsum(0) - count).to(store.device)
        self.cumulative = share.cumsum(0).float().to(store.device)
        self.share = float(share.sum())
        self.elsewhere = max(1 - self.share, 1e-6)  # of the rays; all may be asked for
        drawn = self.elsewhere + share * pixels / count.clamp(min=1)
        self.class_weight = (1 / drawn).float().to(store.device)

    def draw(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """`count` flat pixel indices (count,), with repetition; there must be outlines."""
        u, v = torch.rand(2, count, device=self.store.device, generator=generator)
        label = torch.searchsorted(self.cumulative, u * self.cumulative[-1], right=True).clamp(max=VOID - 1)
        index = self.first[label] + (v * self.count[label]).long()
        return self.store.at(self.pixel_indices, index.clamp(max=len(self.pixel_indices) - 1))

    def weight(self, pixel_indices: torch.Tensor) -> torch.Tensor:
        """How much each of a step's rays must count (R,), so that the pixels drawn more often do not count for more:
        one over how many times as often as evenly a pixel is drawn. Their mean is about 1."""
        label = self.store.at(self.store.label, pixel_indices).long().clamp(max=VOID - 1)
        return torch.where(self.store.at(self.mask, pixel_indices), self.class_weight[label], 1 / self.elsewhere)


def outline_mask(store: PixelStore) -> torch.Tensor:
    """Which pixels (P,) of a store are outlines."""
    outline = torch.zeros(len(store), dtype=torch.bool, device=store.home)
    for view, camera in enumerate(store.cameras):
        pixels = slice(int(store.first[view]), int(store.first[view + 1]))
        label = store.label[pixels].view(1, camera.height, camera.width).to(store.device).float()
        void = label == VOID
        if bool(void.all()):
            continue
        largest = F.max_pool2d(torch.where(void, -1.0, label), 2 * DISTANCE + 1, 1, DISTANCE)
        least = -F.max_pool2d(-label, 2 * DISTANCE + 1, 1, DISTANCE)  # VOID is larger than any class
        outline[pixels] = ((largest != least) & ~void).view(-1).to(store.home)
    if store.usable is not None:
        keep = torch.zeros_like(outline)
        keep[store.usable] = True
        outline &= keep
    return outline
