"""What the user made of a value here, so that an undo is told from old news.

Undo brings back the whole scene of before, with values that since were changed by an engine, a job or another Blender.
Only a way back along the user's own edits is an edit of his.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

MOST = 4000  # values of a chain; dragging a colour makes hundreds


class History:
    """For each value the chain of those it had by the user's edits, from the last that came from elsewhere on."""

    def __init__(self, same: Callable[[Any, Any], bool]) -> None:
        self._same = same
        self._chains: dict[Hashable, tuple[list[Any], int]] = {}  # values, and which of them is the present one

    def give(self, key: Hashable, before: Any, value: Any) -> None:
        """The user makes `value` of `before`."""
        values, at = self._chain(key, before)
        values = [*values[: at + 1], value][-MOST:]
        self._chains[key] = values, len(values) - 1

    def go_back(self, key: Hashable, now: Any, value: Any) -> bool:
        """Whether undo or redo, which made `value` of `now`, went along the user's edits; then `value` is the present
        one."""
        values, at = self._chain(key, now)
        places = [place for place, other in enumerate(values) if self._same(other, value)]
        if not places:
            return False
        self._chains[key] = values, min(places, key=lambda place: abs(place - at))
        return True

    def _chain(self, key: Hashable, now: Any) -> tuple[list[Any], int]:
        values, at = self._chains.get(key, ([now], 0))
        # Somebody else changed it since: what was before that is not to come back.
        return (values, at) if self._same(values[at], now) else ([now], 0)
