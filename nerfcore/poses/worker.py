"""The pose process: `python -m …poses.worker` reads a job (one line of JSON) and answers with lines of JSON.

Its parent's death closes stdin, upon which it ends at once. What native libraries print goes to stderr.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import traceback
from pathlib import Path
from typing import IO, Any

from ..errors import FieldworkError, UnexpectedError, explained


class Channel:
    """Messages to the parent process."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream
        self._lock = threading.Lock()

    def send(self, kind: str, **data: Any) -> None:
        with self._lock:
            self._stream.write(json.dumps({"kind": kind, **data}) + "\n")
            self._stream.flush()

    def stage(self, name: str) -> None:
        self.send("stage", name=name)

    def progress(self, fraction: float, message: str = "") -> None:
        self.send("progress", fraction=min(max(fraction, 0.0), 1.0), message=message)

    def watch(self, database: str, table: str, total: int, noun: str) -> None:
        """From now on progress is the number of rows added to a table, of `total`."""
        self.send("watch", database=database, table=table, total=total, noun=noun)

    def watch_end(self) -> None:
        self.send("watch_end")

    def warn(self, message: str) -> None:
        self.send("warn", message=message)


def _private_stdout() -> IO[str]:
    """Keep the real stdout for messages; file descriptor 1 becomes stderr for everything else."""
    messages = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return messages


def _end_with_parent() -> None:
    while sys.stdin.buffer.read(4096):
        continue
    os._exit(0)


def main() -> None:
    channel = Channel(_private_stdout())
    line = sys.stdin.buffer.readline()
    if not line:
        return
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        _answer(json.loads(line), channel)
    finally:
        # An orderly shutdown would wait for the thread that watches stdin.
        sys.stderr.flush()
        os._exit(0)


def _answer(job: dict[str, Any], channel: Channel) -> None:
    try:
        from .pipeline import run

        channel.send("result", value=run(job, channel))
    except Exception as error:  # noqa: BLE001  (the boundary of the process: everything must reach the user)
        if not isinstance(error, FieldworkError):
            traceback.print_exc()
        channel.send("error", **answer_to(error, Path(job["work"])))


def answer_to(error: Exception, work: Path) -> dict[str, str]:
    """Code, message and hint of a failure in the folder `work`."""
    if isinstance(error, (OSError, RuntimeError)) and _is_full(error):
        message, hint = (
            f"No space left on the disk in {work}.",
            "Free some space and run it again: finished work is kept.",
        )
        return {"code": "disk", "message": message, "hint": hint}
    if "database factory" in str(error):  # all that pycolmap says
        message = f"The database of features in {work} cannot be opened or made."
        hint = "Look at the folder's permissions, the free space and the limit of file sizes (ulimit -f), then run it again."
        return {"code": "disk", "message": message, "hint": hint}
    known = explained(error)
    if isinstance(known, UnexpectedError):
        # Native code whose allocation failed returns without saying so.
        hint = "Memory may have run out: close other programs, or use --preset fast. Finished work is kept."
        return {"code": "poses", "message": f"Pose estimation failed: {type(error).__name__}: {error}.", "hint": hint}
    return {"code": known.code, "message": known.message, "hint": known.hint}


def _is_full(error: Exception) -> bool:
    text = str(error).lower()
    return "full" in text or "no space" in text


if __name__ == "__main__":
    main()
