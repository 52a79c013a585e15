"""Pictures in the panels: thumbnails of photos, the preview of a held-out photo, the training curve."""

from __future__ import annotations

from pathlib import Path

import bpy
import bpy.utils.previews

WIDTH, HEIGHT = 448, 320  # of the curve, in pixels

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
        from .curve import draw_curve  # not at the top: it needs numpy, and enabling the extension must be quick

        preview = collection.new("curve")
        preview.image_size = (WIDTH, HEIGHT)
        preview.image_pixels_float.foreach_set(draw_curve(curve, WIDTH, HEIGHT).ravel())
        _curve_drawn = state
    return collection["curve"].icon_id


def unregister() -> None:
    global _previews, _curve_drawn
    if _previews is not None:
        bpy.utils.previews.remove(_previews)
    _previews, _curve_drawn = None, ("", 0)
