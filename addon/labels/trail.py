"""The way of the mouse over the surface: where a stroke meets it, and where it is beside it or over a hole."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

LEAST_STEP, MOST_STEP = 3.0, 8.0  # pixels of the screen between two places of a stroke, however fast the mouse is

Look = Callable[[float, float], Any]  # the place of the surface at x, y of the region, None where none is


class Trail:
    """A stroke under way. pieces: its places, one list from where it meets the surface to where that ends; a gap no wider
    than the brush parts nothing, for the brush covers it."""

    def __init__(self, width: float) -> None:
        """`width`: of the brush, in pixels of the screen."""
        self.pieces: list[list[Any]] = []
        self._width = width
        self._last: tuple[float, float] | None = None  # where the mouse was
        self._met: tuple[float, float] | None = None  # where it was over the surface last
        self._gap = False  # whether it was beside it since

    def go(self, x: float, y: float, look: Look) -> None:
        """The mouse has moved to x, y: look for the surface along its way."""
        for place in _way(self._last, (x, y)):
            self._last = place
            found = look(*place)
            if found is None:
                self._gap = True
                continue
            if self._met is None or (self._gap and math.dist(self._met, place) > self._width):
                self.pieces.append([])
            self.pieces[-1].append(found)
            self._met, self._gap = place, False


def _way(begin: tuple[float, float] | None, end: tuple[float, float]) -> Iterator[tuple[float, float]]:
    """Places on the screen from behind `begin` to `end`, none where that is too near to count."""
    if begin is None:
        yield end
        return
    length = math.dist(begin, end)
    if length < LEAST_STEP:
        return
    steps = math.ceil(length / MOST_STEP)
    for step in range(1, steps + 1):
        yield tuple(a + (b - a) * step / steps for a, b in zip(begin, end))
