"""Running structure from motion in a process of its own, because native code may abort on bad luck (full disk, …)."""

from __future__ import annotations

import collections
import contextlib
import json
import os
import queue
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from ..errors import DiskError, FieldworkError, InputError, MemoryExhausted, PosesError
from ..progress import Reporter, log

MIN_FREE_BYTES = 20_000_000
ERRORS: dict[str, type[FieldworkError]] = {
    "input": InputError,
    "disk": DiskError,
    "poses": PosesError,
    "memory": MemoryExhausted,
}


def run_worker(job: dict[str, Any], work: Path, report: Reporter) -> dict[str, Any]:
    """Run `worker.py` on a job and return its result; progress and warnings go to `report`.

    Cancelling kills the process: features and matches are committed to a database as they are found, so a later run
    goes on where this one stopped.

    Raises:
        FieldworkError: what the worker reported, or that it died; a full disk is recognised.
        Cancelled: through `report`.
    """
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p), "PYTHONIOENCODING": "utf-8"}
    module = f"{__package__}.worker"
    process = subprocess.Popen(
        [sys.executable, "-m", module],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=environment,
        start_new_session=True,  # Ctrl-C reaches us first; we decide how the worker ends
    )
    messages: queue.Queue[dict[str, Any] | None] = queue.Queue()
    tail: collections.deque[str] = collections.deque(maxlen=60)
    threads = [
        threading.Thread(target=_read_messages, args=(process.stdout, messages, tail), daemon=True),
        threading.Thread(target=_read_log, args=(process.stderr, tail), daemon=True),
    ]
    for thread in threads:
        thread.start()
    try:
        assert process.stdin is not None
        try:
            process.stdin.write(json.dumps(job).encode() + b"\n")
            process.stdin.flush()
        except BrokenPipeError:
            log.info("the pose worker ended before it read its job")
        result = _follow(messages, report)
        process.wait(timeout=30) if result is not None else process.wait()
    except BaseException:
        _kill(process)
        raise
    finally:
        for stream in (process.stdin, process.stdout, process.stderr):
            if stream is not None and not stream.closed and process.poll() is not None:
                try:
                    stream.close()
                except BrokenPipeError:
                    continue  # nobody is left to read what was still buffered
    if result is None:
        raise _death(process.returncode, work, tail)
    return result


class _Watch:
    """Progress as the number of rows that another process adds to a table of a database."""

    def __init__(self, database: str, table: str, total: int, noun: str) -> None:
        self.address, self.total, self.noun = f"{Path(database).absolute().as_uri()}?mode=ro", total, noun
        self.query = f"SELECT COUNT(*) FROM {table}"
        self.before = self._count() or 0
        self.asked = time.monotonic()

    def _count(self) -> int | None:
        try:
            with contextlib.closing(sqlite3.connect(self.address, uri=True, timeout=0.2)) as connection:
                return connection.execute(self.query).fetchone()[0]
        except sqlite3.Error as error:
            log.debug("the pose database is busy: %s", error)
            return None

    def tell(self, report: Reporter) -> None:
        if time.monotonic() - self.asked < 0.5:
            return
        self.asked = time.monotonic()
        count = self._count()
        if count is not None:
            done = min(count - self.before, self.total)
            report.progress(done / max(self.total, 1), f"{done} of {self.total} {self.noun}")


def _follow(messages: queue.Queue[dict[str, Any] | None], report: Reporter) -> dict[str, Any] | None:
    """Pass messages on until the result arrives; None when the worker ends without one."""
    watch: _Watch | None = None
    while True:
        report.check()
        if watch is not None:
            watch.tell(report)
        try:
            message = messages.get(timeout=0.2)
        except queue.Empty:
            continue
        if message is None:
            return None
        match message.get("kind"):
            case "stage":
                report.stage(message["name"])
            case "progress":
                report.progress(message["fraction"], message["message"])
            case "watch":
                watch = _Watch(message["database"], message["table"], message["total"], message["noun"])
            case "watch_end":
                watch = None
            case "warn":
                report.warn(message["message"])
            case "error":
                raise ERRORS.get(message["code"], PosesError)(message["message"], message["hint"])
            case "result":
                return message["value"]


def _read_messages(stream: Any, messages: queue.Queue[dict[str, Any] | None], tail: collections.deque[str]) -> None:
    for line in stream:
        try:
            message = json.loads(line)
        except ValueError:
            tail.append(line.decode("utf-8", "replace").rstrip())
            continue
        messages.put(message)
    messages.put(None)


def _read_log(stream: Any, tail: collections.deque[str]) -> None:
    for line in stream:
        text = line.decode("utf-8", "replace").rstrip()
        tail.append(text)
        log.debug("colmap: %s", text)


def _kill(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.kill()
        process.wait(timeout=10)


def _death(returncode: int, work: Path, tail: collections.deque[str]) -> FieldworkError:
    """Why a worker died without a word."""
    text = "\n".join(tail)
    free = shutil.disk_usage(work).free
    if "disk is full" in text or "No space left" in text or "disk I/O error" in text or free < MIN_FREE_BYTES:
        return DiskError(
            f"No space left on the disk while estimating poses in {work} ({free // 1_000_000} MB free).",
            "Free some space, or raise the limit of file sizes (ulimit -f) if there is one, and run it again: finished work "
            "is kept.",
        )
    if sys.platform != "win32" and returncode == -signal.SIGKILL:
        return PosesError(
            "The pose process was killed, probably because memory ran out.",
            "Close other programs or use --preset fast, then run it again: finished work is kept.",
        )
    fatal = [line for line in tail if line.startswith("F2") or "Check failed" in line or "Error" in line]
    last = (fatal or [line for line in tail if line.strip()] or [""])[-1]
    return PosesError(
        f"The pose process ended unexpectedly (exit status {returncode}). Its last words: {last or 'none'}.",
        "Run it again: finished work is kept. If it ends the same way, use --preset robust.",
    )
