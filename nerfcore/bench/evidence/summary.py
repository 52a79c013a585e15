"""Trials of a record put together: mean and spread over seeds."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import mean
from typing import Any

from .protocol import Trial, protocol

Row = dict[str, Any]
PUBLISHED = Path(__file__).with_name("published.toml")


@dataclass(frozen=True)
class Spread:
    """Mean of a figure over the seeds, and half of its range."""

    value: float
    half: float
    count: int

    def text(self, digits: int) -> str:
        spread = f" ± {self.half:.{digits}f}" if self.count > 1 else ""
        return f"{self.value:.{digits}f}{spread}"


@cache
def published() -> dict[str, dict[str, dict[str, float]]]:
    return tomllib.loads(PUBLISHED.read_text(encoding="utf-8"))


def finished(record: dict[str, Any], table: str) -> list[Row]:
    """The rows of a table that have figures."""
    return [row for row in record["rows"] if row["table"] == table and "error" not in row]


def trial_of(row: Row) -> Trial:
    return Trial.model_validate(row["trial"])


def title_of(variant: str) -> str:
    """Name of a variant for the reader; that of a record may have left the protocol."""
    known = protocol().variants.get(variant)
    return variant if known is None else known.title


def distinct(rows: Sequence[Row], key: str) -> list[Any]:
    """Values of a trial's field: variants in the protocol's order, others in that in which they occur."""
    values = list(dict.fromkeys(row["trial"][key] for row in rows))
    order = list(protocol().variants)
    return sorted(values, key=lambda v: order.index(v) if v in order else len(order)) if key == "variant" else values


def over_seeds(rows: Sequence[Row], key: str, **fields: Any) -> Spread | None:
    """A figure over the seeds of the trials with such fields; None where it was not measured."""
    chosen = [row for row in rows if all(row["trial"][name] == value for name, value in fields.items())]
    values = [row[key] for row in chosen if row.get(key) is not None]
    return Spread(mean(values), (max(values) - min(values)) / 2, len(values)) if values else None
