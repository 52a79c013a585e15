"""Progress and results on a terminal; plain lines where there is none.

Names and messages are shown as they are: square brackets in them are no markup of rich's.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, TextIO

from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from .progress import Estimate, Reporter

PLAIN_EVERY = 10.0  # seconds between plain progress lines


class ConsoleReporter(Reporter):
    """Shows stages with a bar and a time estimate on stderr. Use as a context manager."""

    def __init__(self, quiet: bool) -> None:
        super().__init__()
        self.quiet = quiet
        self.console = Console(stderr=True, highlight=False, markup=False, emoji=False)
        # Where lines cannot be drawn anew (TERM=dumb) rich would show the bar when all is over.
        self.drawn = self.console.is_terminal and not self.console.is_dumb_terminal
        self.bar: Progress | None = None
        self.task: TaskID | None = None
        self.name, self.estimate, self.told = "", Estimate(), 0.0
        self.live: Live | None = None  # the table of a campaign
        self.begun = False  # whether the work has told of anything

    def __enter__(self) -> ConsoleReporter:
        if not self.quiet and self.drawn:
            self.bar = Progress(
                TextColumn("{task.description}", markup=False),
                BarColumn(),
                TextColumn("{task.percentage:>3.0f} %"),
                TimeElapsedColumn(),
                TimeRemainingColumn(),
                TextColumn("{task.fields[message]}", markup=False),
                console=self.console,
            )
            self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Take the bar off the screen, and the table of a campaign."""
        if self.live is not None:
            self.live.stop()
            self.live = None
        if self.bar is not None:
            self.bar.stop()
            self.bar = None

    def stage(self, name: str) -> None:
        super().stage(name)
        self.begun = True
        self.name, self.estimate, self.told = name, Estimate(), time.monotonic()
        if self.bar is not None:
            if self.task is not None:
                self.bar.update(self.task, completed=1.0, message="")
            for earlier in self.bar.task_ids[: max(0, len(self.bar.task_ids) + 2 - self.console.height)]:
                self.bar.remove_task(earlier)  # of what is higher than the terminal rich leaves out the end
            self.task = self.bar.add_task(name, total=1.0, message="")
        elif not self.quiet:
            self.console.print(f"{name} …")

    def progress(self, fraction: float, message: str = "") -> None:
        super().progress(fraction, message)
        if self.bar is not None and self.task is not None:
            self.bar.update(self.task, completed=min(fraction, 1.0), message=message)
        elif not self.quiet and self.live is None:
            now = time.monotonic()
            seconds = self.estimate.update(now, fraction)
            if now - self.told > PLAIN_EVERY:
                self.told = now
                left = "" if seconds is None else f", about {seconds:.0f} s left"
                self.console.print(f"{self.name}: {fraction:.0%}{left}  {message}")

    def event(self, kind: str, **data: Any) -> None:
        if kind != "campaign" or self.quiet or not self.drawn:
            return
        if self.live is None:
            if self.bar is not None:
                self.bar.stop()
                self.bar = None
            self.live = Live(console=self.console, auto_refresh=False, transient=True)
            self.live.start()
        self.live.update(campaign_table(data), refresh=True)

    def watching(self, training: Any) -> AbstractContextManager[Callable[[], None]]:
        from .film.training_view import watched  # loads torch, as the training has done

        return watched(training, self.check)

    def note(self, message: str) -> None:
        if not self.quiet:
            self.console.print(message)

    def warn(self, message: str) -> None:
        self.warnings.append(message)
        self.console.print(Text.assemble(("Warning:", "yellow"), f" {message}"))

    def table(self, verb: str, result: dict[str, Any], stream: TextIO) -> None:
        """Print a result as one table."""
        table = Table(title=f"fieldwork {verb}", show_header=False, title_justify="left")
        for name, value in flattened(result):
            table.add_row(Text(name), Text(value))
        Console(file=stream, highlight=False, width=None if stream.isatty() else 120).print(table)


def campaign_table(status: dict[str, Any]) -> Table:
    """The captures of a campaign, those that failed first, with what is left of each and of all."""
    counts = status["counts"]
    head = ", ".join(f"{counts[state]} {state}" for state in ("done", "failed", "running", "waiting"))
    left = "" if status["eta_s"] is None else f", about {time_text(status['eta_s'])} left"
    workers = "1 worker" if status["workers"] == 1 else f"{status['workers']} workers"
    table = Table(title=Text(f"{status['campaign']}: {head}, {workers}{left}"), title_justify="left")
    for name in ("capture", "state", "stage", "done", "left"):
        table.add_column(name, justify="right" if name in ("done", "left") else "left")
    for row in status["captures"]:
        failed = row["state"] == "failed"
        share = "" if failed or row["state"] == "waiting" else f"{row['fraction']:.0%}"
        stage = row["error"] if failed else row["stage"]
        cells = (row["name"], row["state"], stage, share, time_text(row["eta_s"]))
        table.add_row(*map(Text, cells), style="red" if failed else "")
    return table


def time_text(seconds: float | None) -> str:
    """Seconds as people say them; empty where they are not known."""
    if seconds is None:
        return ""
    minutes = round(seconds / 60)
    return f"{seconds:.0f} s" if seconds < 90 else f"{minutes} min" if minutes < 90 else f"{minutes / 60:.1f} h"


def flattened(value: dict[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """(name, text) rows of a result: nested objects get dotted names, sentences a line each, other long lists their
    length."""
    rows: list[tuple[str, str]] = []
    for key, item in value.items():
        name = f"{prefix}{key}"
        if isinstance(item, dict):
            rows += flattened(item, f"{name}.") if item else [(name, "–")]
        elif isinstance(item, list):
            named = [i.get("name") if isinstance(i, dict) else i for i in item]
            short = ", ".join(map(str, named)) if all(not isinstance(i, dict) and i is not None for i in named) else ""
            counted = f"{len(item)} item{'' if len(item) == 1 else 's'}"
            told = item and all(isinstance(i, str) and i.endswith(".") for i in item)
            rows.append((name, "\n".join(item) if told else short if short and len(short) < 90 else counted))
        else:
            rows.append((name, "–" if item is None else str(item)))
    return rows
