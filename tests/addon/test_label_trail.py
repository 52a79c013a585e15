"""Strokes on the surface: where they begin, and what parts them."""

from __future__ import annotations

import math

from fieldwork.addon.labels.trail import LEAST_STEP, MOST_STEP, Trail


def surface(*spans: tuple[float, float]):
    """A surface that lies under these spans of x; its places are those of the screen."""
    return lambda x, y: (x, y) if any(a <= x <= b for a, b in spans) else None


def drawn(width: float, look, *way: tuple[float, float]) -> list[list[tuple[float, float]]]:
    trail = Trail(width)
    for place in way:
        trail.go(*place, look)
    return trail.pieces


def test_a_stroke_begins_where_it_first_meets_the_surface() -> None:
    (piece,) = drawn(12, surface((50, 200)), (0, 5), (40, 5), (120, 5))
    assert 50 <= piece[0][0] < 50 + MOST_STEP
    assert piece[-1] == (120, 5)
    assert drawn(12, surface((50, 200)), (0, 5), (40, 5)) == []


def test_a_hole_parts_a_stroke_and_one_narrower_than_the_brush_does_not() -> None:
    look = surface((0, 50), (90, 200))
    first, second = drawn(30, look, (0, 0), (200, 0))
    assert 50 - MOST_STEP < first[-1][0] <= 50
    assert 90 <= second[0][0] < 90 + MOST_STEP
    (whole,) = drawn(60, look, (0, 0), (200, 0))
    assert whole == first + second
    # It goes on where it comes back near the place that it left.
    assert len(drawn(30, surface((0, 50)), (45, 0), (100, 0), (100, 20), (45, 20))) == 1


def test_a_fast_mouse_leaves_the_same_stroke_as_a_slow_one() -> None:
    look = surface((0, 300))
    (fast,), (slow,) = drawn(12, look, (0, 0), (240, 0)), drawn(12, look, *((x, 0) for x in range(0, 241, 8)))
    assert fast == slow
    assert all(math.dist(a, b) <= MOST_STEP for a, b in zip(fast, fast[1:]))


def test_a_hand_that_trembles_adds_nothing() -> None:
    (piece,) = drawn(12, surface((0, 300)), (5, 0), (5 + LEAST_STEP / 2, 0), (5, 1))
    assert piece == [(5, 0)]
