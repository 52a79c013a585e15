"""The picture of the training curve; numpy only, no bpy."""

from __future__ import annotations

import math

import numpy as np

PSNR_COLOR = (0.35, 0.75, 1.0)
LOSS_COLOR = (1.0, 0.6, 0.25)
AXIS_COLOR, GRID_COLOR = (
    (0.55, 0.55, 0.55, 1.0),
    (0.15, 0.15, 0.15, 0.3),
)  # premultiplied; seen on dark and light themes
LINES = 3  # of the grid, between the axis and the top
# Letters of axes: three by five dots, an octal digit for each row from the top. Blender draws no text into pictures.
LETTERS = {
    "0": 0o75557, "1": 0o26227, "2": 0o71747, "3": 0o71717, "4": 0o55711, "5": 0o74717, "6": 0o74757, "7": 0o71222,
    "8": 0o75757, "9": 0o75717, ".": 0o00002, "-": 0o00700, "k": 0o45665, "M": 0o57755,
}  # fmt: skip
Curve = list[tuple[int, float, float]]


def draw_curve(curve: Curve, width: int, height: int) -> np.ndarray:
    """The loss (logarithmic) and the PSNR over the steps, each scaled to its own range, with axes: PSNR in dB to the
    left, loss to the right, steps below.

    Returns float32 (height, width, 4), RGBA in [0, 1] with premultiplied alpha (as icons are drawn), first row at the
    bottom, transparent where nothing is drawn, so that it goes with dark and light themes.
    """
    image = np.zeros((height, width, 4), np.float32)
    dot = max(1, width // 112)  # pixels a side of a letter's dot
    side, below = 4 * 4 * dot + 2 * dot, 7 * dot
    plot = image[below:, side : width - side]
    for row in np.linspace(0, len(plot) - 1, LINES + 2).astype(int)[1:]:
        plot[row, :] = GRID_COLOR
    image[below, side : width - side] = AXIS_COLOR
    image[below:, [side, width - side - 1]] = AXIS_COLOR
    values = np.array(curve, np.float64)
    steps = values[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        loss = np.log(values[:, 1])
    for y, color, right in ((values[:, 2], PSNR_COLOR, False), (loss, LOSS_COLOR, True)):
        ends = _plot(plot, steps, y, color)
        if ends is None:
            continue
        texts = [f"{end:.1f}" for end in ends] if not right else [amount(math.exp(end)) for end in ends]
        for text, bottom in zip(texts, (below, height - 5 * dot)):
            left = width - side + dot if right else side - dot - text_width(text, dot)
            write(image, text, left, bottom, dot, color)
    last = count(int(steps[-1]))
    write(image, count(int(steps[0])), side, 0, dot, AXIS_COLOR[:3])
    write(image, last, width - side - text_width(last, dot), 0, dot, AXIS_COLOR[:3])
    return image


def amount(value: float) -> str:
    """A loss in at most four letters."""
    return f"{value:.2f}"[:4] if value >= 0.1 else f"{value:.3f}"[1:] if value >= 0.001 else f"{value:.4f}"[1:]


def count(steps: int) -> str:
    """Steps in few letters: 950, 12.5k."""
    if steps < 1000:
        return str(steps)
    value, unit = (steps / 1e6, "M") if steps >= 1_000_000 else (steps / 1e3, "k")
    return f"{value:.1f}".removesuffix(".0") + unit


def text_width(text: str, dot: int) -> int:
    return 4 * dot * len(text)


def write(image: np.ndarray, text: str, left: int, bottom: int, dot: int, color: tuple[float, ...]) -> None:
    """Write into the image, `dot` pixels a dot; what has no letter leaves a gap, what lies outside is left out."""
    for number, letter in enumerate(text):
        rows = LETTERS.get(letter, 0)
        for place in range(15):
            if rows >> (14 - place) & 1:
                x, y = left + (4 * number + place % 3) * dot, bottom + (4 - place // 3) * dot
                image[max(0, y) : y + dot, max(0, x) : x + dot] = (*color, 1.0)


def _plot(
    image: np.ndarray, steps: np.ndarray, values: np.ndarray, color: tuple[float, float, float]
) -> tuple[float, float] | None:
    """Draw one line into the image, scaled to its own range, which is returned; None where there is no line."""
    height, width = image.shape[:2]
    known = np.isfinite(values)
    if known.sum() < 2 or steps[-1] <= steps[0]:
        return None
    x = (steps[known] - steps[0]) / (steps[-1] - steps[0]) * (width - 1)
    low, high = values[known].min(), values[known].max()
    y = np.interp(np.arange(width), x, values[known])
    y = (y - low) / max(high - low, 1e-9) * (height - 7) + 3
    for column in range(width):
        before = y[max(column - 1, 0)]
        bottom, top = sorted((before, y[column]))
        image[max(0, int(bottom) - 1) : int(top) + 2, column] = (*color, 1.0)
    return low, high
