"""Measured numbers in words: as many decimals as their uncertainty leaves, and never with an exponent."""

from __future__ import annotations

import math
from decimal import Decimal


def significant(value: float, digits: int = 3) -> str:
    """A number with so many significant digits: “12300”, “0.0123”."""
    return f"{Decimal(f'{value:.{digits}g}'):f}"


def decimals(half: float) -> int:
    """How many decimals a value has whose interval is ± half: two digits of the half; below 0 tens, hundreds, …"""
    return 1 - math.floor(math.log10(float(f"{half:.1e}")))


def rounded(value: float, places: int) -> str:
    """A number with so many decimals, or rounded to tens, hundreds, … where they are below 0."""
    return f"{round(value, places):.{max(0, places)}f}"


def amount(value: float, half: float) -> str:
    """A value with half of its interval: “1235 ± 38”."""
    if not half > 0:
        return f"{significant(value, 4)} ± 0"
    places = decimals(half)
    return f"{rounded(value, places)} ± {rounded(half, places)}"


def interval(value: float, low: float, high: float) -> tuple[str, str]:
    """A value, and its interval, whose low end is never below 0: “1235” and “1197 … 1273”."""
    if not high > value:
        return significant(value, 4), f"{significant(low, 4)} … {significant(high, 4)}"
    places = decimals(high - value)
    return rounded(value, places), f"{rounded(low, places)} … {rounded(high, places)}"
