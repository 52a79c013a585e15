"""Pictures in the panels: thumbnails of photos, the preview of a held-out photo, the training curve."""

from __future__ import annotations

from pathlib import Path

import bpy
import bpy.utils.previews
import numpy as np

WIDTH, HEIGHT = 256, 176  # of the curve, in pixels
PSNR_COLOR = (0.35, 0.75, 1.0)
LOSS_COLOR = (1.0, 0.6, 0.25)

_previews: bpy.utils.previews.ImagePreviewCollection | None = None
_curve_drawn: tuple[str, int] = ("", 0)


def _collection() -> bpy.utils.previews.ImagePreviewCollection:
    global _previews
    if _previews is None:
        _previews = bpy.utils.previews.new()
    return _previews


def picture(path: Path | str, version: int = 0) -> int:
    """Icon id of a picture file, 0 when there is none. Another `version` reads the file again."""
    key = f"{path}|{version}"
    collection = _collection()
    if key not in collection:
        if not Path(path).is_file():
            return 0
        if version and f"{path}|{version - 1}" in collection:
            del collection[f"{path}|{version - 1}"]
        collection.load(key, str(path), "IMAGE")
    return collection[key].icon_id


def curve_icon(key: str, curve: list[tuple[int, float, float]]) -> int:
    """Icon id of the curve of a job (step, loss, PSNR), redrawn when it has grown; 0 with fewer than two points."""
    global _curve_drawn
    if len(curve) < 2:
        return 0
    collection = _collection()
    state = (key, curve[-1][0])
    if state != _curve_drawn:
        if "curve" in collection:
            del collection["curve"]
        preview = collection.new("curve")
        preview.image_size = (WIDTH, HEIGHT)
        preview.image_pixels_float.foreach_set(draw_curve(curve, WIDTH, HEIGHT).ravel())
        _curve_drawn = state
    return collection["curve"].icon_id


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


def unregister() -> None:
    global _previews, _curve_drawn
    if _previews is not None:
        bpy.utils.previews.remove(_previews)
    _previews, _curve_drawn = None, ("", 0)
