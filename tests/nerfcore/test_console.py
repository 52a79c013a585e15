"""What the command line shows: names and messages as they are, whatever they hold."""

from __future__ import annotations

import io
import subprocess
import sys
from typing import Any

import pytest
from fieldwork.nerfcore import console
from fieldwork.nerfcore.console import ConsoleReporter, campaign_table, flattened
from fieldwork.nerfcore.progress import Estimate
from rich.console import Console

ODD = "photos [2024] [/x] :smile: [red]"


@pytest.fixture(params=[False, True], ids=["plain", "terminal"])
def shown(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """What a reporter writes, without a terminal and with one."""
    out = io.StringIO()

    def made(**values: Any) -> Console:
        values.pop("stderr")
        return Console(file=out, force_terminal=request.param, width=200, color_system=None, **values)

    monkeypatch.setattr(console, "Console", made)
    monkeypatch.setattr(console, "PLAIN_EVERY", -1.0)
    return out


@pytest.mark.parametrize("call", ["stage", "progress", "note", "warn"])
def test_text_in_brackets_is_shown(shown: io.StringIO, call: str) -> None:
    with ConsoleReporter(quiet=False) as report:
        if call == "progress":
            report.stage("Reading")
            report.progress(0.5, ODD)
        else:
            getattr(report, call)(ODD)
    assert ODD in shown.getvalue()


def test_time_left_of_work_that_goes_on_is_counted_from_where_it_began(shown: io.StringIO, monkeypatch) -> None:
    estimate = Estimate()
    assert estimate.update(0.0, 0.9) is None
    assert estimate.update(1.0, 0.91) == pytest.approx(9.0)
    clock = iter([100.0, 120.0, 130.0])
    monkeypatch.setattr(console.time, "monotonic", lambda: next(clock))
    report = ConsoleReporter(quiet=False)  # without its bar, which has an estimate of its own
    report.stage("Training")
    report.progress(0.9)
    report.progress(0.91)
    assert "91%, about 90 s left" in shown.getvalue()


def test_the_present_stage_is_shown_in_a_low_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()

    def made(**values: Any) -> Console:
        values.pop("stderr")
        return Console(file=out, force_terminal=True, width=80, height=8, **values)

    monkeypatch.setattr(console, "Console", made)
    with ConsoleReporter(quiet=False) as report:
        for number in range(20):
            report.stage(f"stage {number}")
            out.truncate(0)
            assert report.bar is not None
            report.bar.refresh()
            assert f"stage {number}" in out.getvalue()


def test_terminals_that_draw_nothing_anew_get_plain_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()

    def made(**values: Any) -> Console:
        values.pop("stderr")
        return Console(file=out, force_terminal=True, width=80, _environ={"TERM": "dumb"}, **values)

    monkeypatch.setattr(console, "Console", made)
    with ConsoleReporter(quiet=False) as report:
        report.stage("Reading")
        assert out.getvalue() == "Reading …\n"


def test_results_in_brackets_are_shown() -> None:
    out = io.StringIO()
    ConsoleReporter(quiet=False).table("new", {"file": ODD, "per_class": {"[wood]": 1}}, out)
    assert ODD in out.getvalue()
    assert "per_class.[wood]" in out.getvalue()


def test_what_is_not_known_is_not_said_to_be_unmeasured() -> None:
    """A revision of labels, or a Blender, is nothing that is measured."""
    assert flattened({"label_revision": None, "classes": {"a": None}}) == [("label_revision", "–"), ("classes.a", "–")]


def test_sentences_of_a_result_are_shown_in_full() -> None:
    """What `doctor` finds wrong is no use as a number."""
    problems = [f"{library} is not installed. Repair the engine in the preferences." for library in ("torch", "warp")]
    out = io.StringIO()
    ConsoleReporter(quiet=False).table(
        "doctor", {"problems": problems, "files": ["/a" * 60], "poses": [[1.0] * 9]}, out
    )
    text = out.getvalue()
    assert all(problem in text for problem in problems)
    assert text.count("1 item ") == 1


def test_captures_in_brackets_are_shown() -> None:
    rows = [{"name": "[a]", "state": "failed", "stage": "", "error": ODD, "fraction": 0.0, "eta_s": None}]
    counts = {"done": 0, "failed": 1, "running": 0, "waiting": 0}
    status = {"campaign": "[list]", "counts": counts, "eta_s": None, "workers": 1, "captures": rows}
    drawn = Console(width=200, record=True, file=io.StringIO())
    drawn.print(campaign_table(status))
    text = drawn.export_text()
    assert all(part in text for part in ("[list]", "[a]", ODD))


def test_the_engine_says_how_it_is_called() -> None:
    """`serve` alone is the engine, which speaks JSON on its standard streams."""
    command = [sys.executable, "-m", "fieldwork.nerfcore", "serve", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL, timeout=60)
    assert done.returncode == 0
    assert "Usage" in done.stdout
    assert "JSON-RPC" in done.stdout
    wrong = subprocess.run([*command[:-1], "--wrong"], capture_output=True, text=True, check=False, timeout=60)
    assert wrong.returncode == 2
