"""What comes after a training of limited time."""

from __future__ import annotations

import math

import pytest
from fieldwork.nerfcore.evaluate.verb import spread
from fieldwork.nerfcore.workflows import budget
from hypothesis import given
from hypothesis import strategies as st


def test_what_comes_after_training_gets_half_as_long_and_a_minute() -> None:
    assert budget.seconds_after(240) == 180
    assert budget.seconds_after(None) == math.inf
    assert "4.0 minutes of training" in budget.estimate(240)
    assert "about 3.0 minutes for mesh" in budget.estimate(240)


def test_a_stage_gets_less_where_others_took_more() -> None:
    assert budget.share_of(240, 0.2, 100) == pytest.approx(36)
    assert budget.share_of(240, 0.2, 160) == pytest.approx(20)
    assert budget.share_of(240, 0.2, 500) == pytest.approx(13), "the mesh took all: enough for some photos still"
    assert budget.share_of(None, 0.2, 500) == math.inf


@given(
    st.tuples(st.integers(50, 4000), st.integers(50, 4000)),
    st.integers(1, 60),
    st.floats(1e3, 1e8),
    st.floats(1, 1e4),
)
def test_pictures_fit_into_their_time(size: tuple[int, int], count: int, speed: float, seconds: float) -> None:
    (width, height), fewer = budget.fitting_pictures(size, count, speed, seconds)
    assert 1 <= fewer <= count
    assert 1 <= width <= size[0]
    assert 1 <= height <= size[1]
    taken = width * height * fewer / speed
    single = math.ceil(size[0] * budget.SMALLEST) * math.ceil(size[1] * budget.SMALLEST) / speed
    assert taken <= max(1.1 * seconds, single * 1.1)  # sides are whole numbers
    if fewer < count:  # only where they are as small as they get
        assert width == max(1, round(size[0] * budget.SMALLEST))
    if size[0] * size[1] * count / speed <= seconds:
        assert ((width, height), fewer) == (size, count)


def test_without_a_limit_pictures_stay_as_they_are() -> None:
    assert budget.fitting_pictures((800, 600), 8, None, math.inf) == ((800, 600), 8)
    assert budget.fitting_pictures((800, 600), 8, None, 10.0) == ((200, 150), 8)


@given(st.integers(1, 300))
def test_the_first_few_are_spread_over_all(count: int) -> None:
    order = spread(count)
    assert sorted(order) == list(range(count))
    for taken in range(1, count + 1):
        places = sorted(order[:taken])
        gaps = [b - a for a, b in zip([*places], [*places[1:], count])]
        assert max(gaps) <= max(2, 4 * count / taken)


@given(st.integers(3, 300))
def test_the_first_ones_are_not_at_an_end(count: int) -> None:
    order = spread(count)
    assert order[0] == count // 2
    assert not {0, count - 1} & set(order[: (count + 1) // 4])
