"""What is behind the field: which colour a ray has that meets nothing."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ..data.box import looks_inward
from ..data.scene import Scene
from ..geometry.cameras import Camera, pixel_centers, rays
from ..images.working import read_picture
from .infinity import share_at_infinity

Background = Literal["environment", "random", "white", "black"]
LEVEL: dict[str, float] = {"white": 1.0, "black": 0.0}

# Not tuned: the next four.
MOST_PHOTOS = 12  # that are looked at
EDGE = 0.04  # of the sides: the strip along the borders that is looked at
BLACK, WHITE = 8, 248  # of 255: all channels below, all channels above
SHARE = 0.5  # of the strip
INFINITE = 0.004  # of all pixels; measured: docs/experiments.md, “Is there a sky?”


def choose_background(scene: Scene, transparent: bool) -> Background:
    """The background of a capture for which none is set.

    - An object in front of black (or white) on nearly all sides: that colour. Nothing has to be there, then, for rays
      past the object; a field that must be opaque everywhere fills the space around it with black clouds instead, at
      any depth, since black looks the same from all sides.
    - Photos that show something infinitely far away, like the sky: an environment. Where there is none, it would take over
      what few photos show.
    - All else: random, so that rays without alpha have to meet something, and transparent ones nothing.
    """
    if transparent or any(view.mask is not None for view in scene.views):
        return "random"
    if looks_inward(scene.views):
        surroundings = _plain_surroundings(scene)
        if surroundings is not None:
            return surroundings
    return "environment" if share_at_infinity(scene) > INFINITE else "random"


def _plain_surroundings(scene: Scene) -> Background | None:
    """Black or white, where nearly all photos have borders of that."""
    chosen = np.unique(np.linspace(0, len(scene.train) - 1, MOST_PHOTOS).round().astype(int))
    views = [scene.views[scene.train[i]] for i in chosen]
    shares = [edge_shares(read_picture(view.image).pixels[..., :3], view.camera) for view in views]
    black, white = np.median(shares, axis=0)
    return "black" if black > SHARE else "white" if white > SHARE else None


def edge_shares(photo: np.ndarray, camera: Camera) -> tuple[float, float]:
    """Which shares of the strip along the borders of a photo (H, W, 3) uint8 are black, and white; what a fisheye does not
    see, which is black around its circle, says nothing."""
    height, width = photo.shape[:2]
    strip = np.ones((height, width), bool)
    y, x = max(1, round(EDGE * height)), max(1, round(EDGE * width))
    strip[y : height - y, x : width - x] = False
    pixels = photo[strip]
    if camera.model == "OPENCV_FISHEYE":
        places = pixel_centers(width, height)[strip]
        pixels = pixels[rays(camera.resized(width, height), places)[1]]
    if not len(pixels):
        return 0.0, 0.0
    return float((pixels.max(1) < BLACK).mean()), float((pixels.min(1) >= WHITE).mean())
