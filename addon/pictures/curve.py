"""The picture of the training curve; numpy only, no bpy."""

from __future__ import annotations

import numpy as np

PSNR_COLOR = (0.35, 0.75, 1.0)
LOSS_COLOR = (1.0, 0.6, 0.25)


def draw_curve(curve: list[tuple[int, float, float]], width: int, height: int) -> np.ndarray:
    """The loss (logarithmic) and the PSNR over the steps, each scaled to its own range.

    Returns float32 (height, width, 4), RGBA in [0, 1] with premultiplied alpha (as icons are drawn), first row at the
    bottom, transparent where nothing is drawn, so that it goes with dark and light themes.
    """
    image = np.zeros((height, width, 4), np.float32)
    for row in np.linspace(0, height - 1, 5).astype(int):
        image[row, :] = (0.15, 0.15, 0.15, 0.3)
    values = np.array(curve, np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        loss = np.log(values[:, 1])
    _plot(image, values[:, 0], loss, LOSS_COLOR)
    _plot(image, values[:, 0], values[:, 2], PSNR_COLOR)
    return image


def _plot(image: np.ndarray, steps: np.ndarray, values: np.ndarray, color: tuple[float, float, float]) -> None:
    """Draw one line into the image, scaled to its own range."""
    height, width = image.shape[:2]
    known = np.isfinite(values)
    if known.sum() < 2 or steps[-1] <= steps[0]:
        return
    x = (steps[known] - steps[0]) / (steps[-1] - steps[0]) * (width - 1)
    low, high = values[known].min(), values[known].max()
    y = np.interp(np.arange(width), x, values[known])
    y = (y - low) / max(high - low, 1e-9) * (height - 7) + 3
    for column in range(width):
        before = y[max(column - 1, 0)]
        bottom, top = sorted((before, y[column]))
        image[max(0, int(bottom) - 1) : int(top) + 2, column] = (*color, 1.0)
