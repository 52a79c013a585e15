"""How a long computation reports to its caller, and how the caller stops it."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from .errors import Cancelled

log = logging.getLogger("fieldwork")


class Reporter:
    """Receives progress and answers "go on?". This base class keeps quiet; the CLI and the engine subclass it.

    A computation calls `check()` at least every second or so, which raises `Cancelled` once `cancel()` was called
    (from any thread, or a signal handler).
    """

    def __init__(self) -> None:
        self._cancelled = threading.Event()
        self.warnings: list[str] = []

    def stage(self, name: str) -> None:
        """A named part of the work begins ("Matching features"); progress restarts at 0."""
        self.check()

    def progress(self, fraction: float, message: str = "") -> None:
        """`fraction` in [0, 1] of the current stage is done."""
        self.check()

    def event(self, kind: str, **data: Any) -> None:
        """A measured value or artefact: kind "train" (step, loss, psnr), "preview" (path), …"""

    def watching(self, training: Any) -> AbstractContextManager[Callable[[], None]]:
        """A training (`render.unfinished.Unfinished`) begins and lasts as long as the context; what comes with it is called
        after every step, between which the model does not change, and may raise `Cancelled`."""
        return nullcontext(lambda: None)

    def note(self, message: str) -> None:
        """A line for whoever watches: a plan, what is reused. Nothing needs to be done about it."""
        log.info(message)

    def warn(self, message: str) -> None:
        """Something the user should know of; the work goes on."""
        self.warnings.append(message)
        log.warning(message)

    def cancel(self) -> None:
        self._cancelled.set()

    @property
    def cancelled(self) -> bool:
        return self._cancelled.is_set()

    def check(self) -> None:
        if self._cancelled.is_set():
            raise Cancelled


class Stretch(Reporter):
    """A stretch of the progress of a stage that another reporter hears of: from `begin`, `share` of it."""

    def __init__(self, report: Reporter, begin: float, share: float) -> None:
        super().__init__()
        self.report, self.begin, self.share = report, begin, share

    def progress(self, fraction: float, message: str = "") -> None:
        self.report.progress(self.begin + self.share * fraction, message)

    def check(self) -> None:
        self.report.check()


class Estimate:
    """Remaining seconds of a stage from its recent speed.

    The first fraction that is told of is where the counting begins: a training that goes on has done half of it long ago.
    """

    WINDOW = 30.0  # seconds of history: long enough to be calm, short enough to follow a change of speed

    def __init__(self) -> None:
        self.points: deque[tuple[float, float]] = deque()

    def update(self, now: float, fraction: float) -> float | None:
        """Seconds left at `fraction` of the stage, None while nothing can be said."""
        if self.points and fraction < self.points[-1][1]:
            self.points.clear()
        self.points.append((now, fraction))
        while len(self.points) > 2 and now - self.points[0][0] > self.WINDOW:
            self.points.popleft()
        f0, seconds = self.points[0][1], now - self.points[0][0]
        if fraction <= f0 or seconds < 0.5:
            return None
        return (1.0 - fraction) * seconds / (fraction - f0)


def go_on() -> None:
    """For `check` of whatever asks between its steps whether to go on, where nothing says no."""


def shortened(what: str, items: list[str], most: int = 6) -> str:
    """`what`, and the first of `items` behind it: "2 files were left out: a.jpg (…); b.jpg (…)." """
    more = f"; and {len(items) - most} more" if len(items) > most else ""
    return f"{what}: {'; '.join(items[:most])}{more}."
