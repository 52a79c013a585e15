"""Where classes meet in the labels: rays drawn there sharpen outlines, and small things are nearly all outline."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from ..data.pixels import VOID, PixelStore

REACH = 2  # pixels from another class
MOST_OFTEN = 5  # times as often as others: where few photos are labelled, these must not have most of the rays


def outline_places(store: PixelStore) -> torch.Tensor:
    """Flat positions (N,) int64 of the usable labelled pixels that have another class at most `REACH` pixels away in
    x and in y, on the store's device."""
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
        return store.usable[outline[store.usable]]
    return outline.nonzero()[:, 0]


def outline_share(outlines: int, pixels: int, asked: float) -> float:
    """Share of the rays to draw from so many outline places among all pixels."""
    return min(asked, MOST_OFTEN * outlines / max(pixels, 1))
