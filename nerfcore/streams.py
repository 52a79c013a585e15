"""Standard streams and signals of the command line: results on stdout alone, Ctrl-C, the log of a failure."""

from __future__ import annotations

import errno
import io
import json
import logging
import os
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

import click

from .console import ConsoleReporter
from .errors import FieldworkError

log = logging.getLogger("fieldwork")

PATIENCE = 1.5  # seconds that loading libraries may go on after Ctrl-C


class NoReader(FieldworkError):
    """Standard output takes no result. The work itself is done."""

    code = "output"


def open_standard_streams() -> None:
    """Lead closed standard streams to nothing; else the next file that is opened takes their number, and what native
    libraries print goes into it. Characters that the terminal's encoding lacks become escapes."""
    for number, name in ((0, "stdin"), (1, "stdout"), (2, "stderr")):
        try:
            os.fstat(number)
        except OSError:
            # Read-only where it is stdout: writing a result tells that nobody takes it.
            opened = os.open(os.devnull, os.O_WRONLY if number == 2 else os.O_RDONLY)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", encoding="utf-8", closefd=False))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def give_up_stdout() -> None:
    """Lead standard output to nothing: what it did not take would be tried again as Python exits, which changes the exit
    code (Python's documentation of SIGPIPE)."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    os.close(nothing)


class _Results:
    """Standard output as results go to it: what is written arrives, or `NoReader` is raised."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        with _told():
            return self.stream.write(text)

    def flush(self) -> None:
        with _told():
            self.stream.flush()


@contextmanager
def _told() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError as error:
        raise NoReader(
            "Nobody reads the result any more.", "The work is done; print it with another command."
        ) from error
    except OSError as error:
        closed = error.errno == errno.EBADF
        why = "there is no standard output" if closed else f"{error.strerror} on standard output"
        raise NoReader(
            f"The result cannot be printed: {why}.", "The work is done; print it again elsewhere."
        ) from error


@contextmanager
def stdout_for_results() -> Iterator[TextIO]:
    """Keep stdout for results: everything else that prints there, native libraries too, goes to stderr."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    # Bytes of names that are no UTF-8 become escapes, which JSON reads again.
    stream = os.fdopen(kept, "w", encoding="utf-8", errors="backslashreplace", closefd=False)
    try:
        yield _Results(stream)  # type: ignore[misc]
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        with suppress(OSError):  # what could not be written has been told of
            stream.close()
        os.close(kept)


def keep_quiet_about_destructors() -> None:
    """Log what fails while objects are thrown away, as archives do whose file could not be written: the error itself has
    been told."""

    def hook(unraisable: Any) -> None:
        log.debug("while %r was thrown away", unraisable.object, exc_info=unraisable.exc_value)

    sys.unraisablehook = hook


def print_json(value: dict[str, Any], stream: TextIO) -> None:
    """One line of JSON, in which numbers that are not finite are null, as the engine answers."""
    from pydantic_core import to_json  # not at the top: signals are caught before libraries load

    finite = json.loads(to_json(value, inf_nan_mode="null"))
    print(json.dumps(finite, ensure_ascii=False, allow_nan=False), file=stream)


def write_log(error: BaseException, verb: str, project: Path | None) -> Path:
    """Write the traceback of a failure to PROJECT/jobs, or where that is not possible to the system's temporary folder."""
    text = "".join(traceback.format_exception(error))
    name = f"{verb}-{os.getpid()}-error.log"
    for folder in ([project / "jobs"] if project and (project / "jobs").is_dir() else []) + [
        Path(tempfile.gettempdir())
    ]:
        path = folder / (name if folder.name == "jobs" else f"fieldwork-{name}")
        try:
            path.write_text(text, encoding="utf-8", errors="backslashreplace")
        except OSError as failure:
            text += f"\n{path}: {failure}\n"
            continue
        return path
    return Path(os.devnull)


@contextmanager
def interruptible(report: ConsoleReporter) -> Iterator[None]:
    """The first Ctrl-C (or SIGTERM) asks the work to stop, the second one ends the process.

    Before the work has begun nobody asks whether to go on: libraries are loading, which is broken off at once.
    """

    def stop(number: int, frame: Any) -> None:
        report.cancel()
        signal.signal(number, signal.SIG_DFL)
        if not report.begun:
            timer = threading.Timer(PATIENCE, _leave, [report])
            timer.daemon = True
            timer.start()
            raise KeyboardInterrupt

    before = {n: signal.signal(n, stop) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _leave(report: ConsoleReporter) -> None:
    """Native code that loads does not come back: nothing has begun that could be left half done."""
    if not report.begun:
        click.echo("Cancelled. Run the same command again to go on.", err=True)
        os._exit(130)
