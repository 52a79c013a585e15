"""The engine seen from Blender: starting it, talking to it, noticing its death. Standard library only.

A reader thread puts the engine's messages into a queue; `pump` hands them out on the caller's thread (Blender's main
thread, from a timer, or from a blocking loop where there are no timers).
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..errors import EngineError
from .in_use import used
from .place import ROOT, tail

# Lines of a log that say why a process ended.
_TELLING = re.compile(r"error|exception|fatal|abort|terminat|assert|no module|cannot|out of memory", re.IGNORECASE)
LOGS_KEPT = 8  # of earlier engines
EVENT = Callable[[str, dict[str, Any]], None]
DONE = Callable[[dict[str, Any] | None, EngineError | None], None]


def engine_environment(base: dict[str, str] | None = None) -> dict[str, str]:
    """Environment of the engine: its own modules only, idle threads that sleep."""
    env = dict(os.environ if base is None else base)
    for name in ("PYTHONHOME", "PYTHONSTARTUP", "PYTHONEXECUTABLE", "VIRTUAL_ENV"):
        env.pop(name, None)
    env["PYTHONPATH"] = str(ROOT)
    env["PYTHONNOUSERSITE"] = "1"
    # Nothing may be written into the extension's folder.
    env["PYTHONDONTWRITEBYTECODE"] = "1"
    env["PYTHONUTF8"] = "1"
    # What the engine cannot do without Blender it does in a background copy of the one that runs here.
    if "bpy" in sys.modules:
        env.setdefault("FIELDWORK_BLENDER", sys.modules["bpy"].app.binary_path or sys.executable)
    env["OMP_WAIT_POLICY"] = "passive"
    return env


def _prune(log: Path) -> None:
    """Remove logs of earlier processes beside this one, but for the newest few."""
    with contextlib.suppress(OSError):  # another process removes them too
        others = [path for path in log.parent.glob(f"{log.stem.split('-')[0]}-*") if path.stem != log.stem]
        for path in sorted(others, key=os.path.getmtime)[:-LOGS_KEPT]:
            path.unlink(missing_ok=True)


class Link:
    """One engine process. All methods are for one thread; only the reader runs beside it."""

    def __init__(self, python: Path | str, log: Path, command: list[str] | None = None) -> None:
        """`log` receives the engine's stderr (the old one is kept as `<name>.old`); `command` replaces the default
        `python -m nerfcore serve`."""
        self.python, self.log = Path(python), Path(log)
        self.command = command or [str(python), "-s", "-m", "nerfcore", "serve"]
        self.process: subprocess.Popen[bytes] | None = None
        self.last_used = time.monotonic()
        self._messages: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self._waiting: dict[int, tuple[DONE | None, EVENT | None, str | None]] = {}
        self._number = 0

    # Life

    @property
    def alive(self) -> bool:
        return self.process is not None and self.process.poll() is None

    @property
    def busy(self) -> bool:
        return bool(self._waiting)

    def start(self) -> None:
        """Start the engine unless it runs.

        Raises:
            EngineError: there is no Python to run it with, or it cannot be started.
        """
        if self.alive:
            return
        if not self.python.is_file():
            raise EngineError(
                "missing", f"There is no engine at {self.python}.", "Install the engine in the preferences."
            )
        self.log.parent.mkdir(parents=True, exist_ok=True)
        _prune(self.log)
        with contextlib.suppress(OSError):  # no older log, or it is being looked at
            os.replace(self.log, self.log.with_suffix(".old"))
        # A queue of its own: a late message of a dead engine must not reach the new one's requests.
        self._messages = queue.Queue()
        options: dict[str, Any] = {"start_new_session": True}
        if sys.platform == "win32":
            options = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW}
        try:
            with open(self.log, "wb") as log, used(self.python) as held:
                process: Any = subprocess.Popen(  # of bytes, which options by name do not tell a type checker
                    self.command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    env=engine_environment(),
                    cwd=str(self.log.parent),
                    **options,
                    **held,
                )
        except OSError as error:
            raise EngineError(
                "missing", f"The engine cannot be started: {error}.", "Repair it in the preferences."
            ) from error
        self.process = process
        reader = threading.Thread(
            target=_read, args=(process.stdout, self._messages), name="fieldwork-engine", daemon=True
        )
        reader.start()
        self.last_used = time.monotonic()

    def close(self, detach: bool = False, timeout: float | None = 10.0) -> None:
        """Let go of the engine. A running job is cancelled (it leaves a checkpoint) or, with `detach`, goes on.

        Without `detach` this waits up to `timeout` seconds for the end of the process, then kills it; with
        `timeout=None` it does not wait: the engine ends by itself.
        """
        process, self.process = self.process, None
        self._waiting.clear()
        if process is None:
            return
        assert process.stdin is not None
        with contextlib.suppress(OSError):  # it is dead already
            if detach:
                process.stdin.write(_line({"method": "detach"}))
            process.stdin.close()
        if detach or timeout is None:
            return
        try:
            process.wait(timeout)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    # Asking

    def request(
        self,
        method: str,
        params: dict[str, Any] | None = None,
        on_done: DONE | None = None,
        on_event: EVENT | None = None,
    ) -> int:
        """Send a request; `on_done(result, error)` and `on_event(kind, data)` are called from `pump`.

        `on_event` gets the notifications of the job: kinds "progress", "event", "log". Raises EngineError when the
        engine cannot be started.
        """
        self.start()
        assert self.process is not None
        assert self.process.stdin is not None
        self._number += 1
        job = (params or {}).get("job") if on_event else None
        self._waiting[self._number] = (on_done, on_event, job)
        message = {"id": self._number, "method": method, "params": params or {}}
        with contextlib.suppress(OSError):  # a dead engine is noticed by `pump`
            self.process.stdin.write(_line(message))
            self.process.stdin.flush()
        self.last_used = time.monotonic()
        return self._number

    def cancel(self, job: str | None = None) -> None:
        """Ask the running job to stop; its request is answered with a "cancelled" error."""
        if self.alive:
            self.request("cancel", {"job": job} if job else {})

    def pump(self, timeout: float = 0.0) -> int:
        """Hand out what the engine said; returns the number of messages. Waits at most `timeout` s for the first."""
        count = 0
        while True:
            try:
                message = self._messages.get(timeout=timeout) if timeout and not count else self._messages.get_nowait()
            except queue.Empty:
                return count
            count += 1
            self.last_used = time.monotonic()
            if message is None:
                self._died()
                return count
            self._deliver(message)

    def run_blocking(self, verb: str, params: dict[str, Any], on_event: EVENT | None = None) -> dict[str, Any]:
        """Run a verb and wait for its result; Ctrl-C cancels it.

        Raises:
            EngineError: the verb failed, was cancelled, or the engine died.
        """
        outcome: list[tuple[dict[str, Any] | None, EngineError | None]] = []
        self.request(verb, params, lambda result, error: outcome.append((result, error)), on_event)
        while not outcome:
            try:
                self.pump(timeout=0.2)
            except KeyboardInterrupt:
                self.cancel(params.get("job"))
        result, error = outcome[0]
        if error is not None:
            raise error
        return result or {}

    # Inside

    def _deliver(self, message: dict[str, Any]) -> None:
        number = message.get("id")
        if number is not None:
            on_done, _, _ = self._waiting.pop(number, (None, None, None))
            if on_done is not None:
                error = message.get("error")
                on_done(message.get("result"), _engine_error(error) if error else None)
            return
        data = dict(message.get("params") or {})
        job = data.get("job")
        for _, on_event, name in list(self._waiting.values()):
            if on_event is not None and (job is None or name is None or job == name):
                on_event(message.get("method", ""), data)

    def _died(self) -> None:
        """The engine's output ended: answer everything that waits."""
        process, self.process = self.process, None
        status = ""
        if process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(2.0)
            status = _exit_status(process.returncode)
        waiting, self._waiting = list(self._waiting.values()), {}
        lines = self.tail()
        telling = [line for line in lines if _TELLING.search(line)]
        last = f" It last said: {telling[-1]}" if telling else ""
        for on_done, _, _ in waiting:
            if on_done is not None:
                on_done(
                    None,
                    EngineError(
                        "died",
                        f"The engine stopped unexpectedly{status}.{last}",
                        "Run it again; it goes on from what is on disk.",
                        "\n".join(lines),
                    ),
                )

    def tail(self, lines: int = 20) -> list[str]:
        """The last lines of the engine's log."""
        return tail(self.log, lines)


def _line(message: dict[str, Any]) -> bytes:
    return json.dumps({"jsonrpc": "2.0", **message}, default=str).encode() + b"\n"


def _read(stream: Any, messages: queue.Queue[dict[str, Any] | None]) -> None:
    """Body of the reader thread: whole lines of JSON into the queue, None at the end."""
    for line in stream:
        try:
            messages.put(json.loads(line))
        except ValueError:
            # Cannot happen while the engine keeps stdout to itself; a half line is what a killed engine leaves.
            continue
    stream.close()
    messages.put(None)


def _exit_status(code: int | None) -> str:
    if code is None:
        return ""
    if code < 0:
        hint = ", perhaps for want of memory" if code == -9 else ""
        return f" (signal {-code}{hint})"
    return f" (exit status {code})"


def _engine_error(error: dict[str, Any]) -> EngineError:
    data = error.get("data") or {}
    if error.get("code") == -32001:
        return EngineError("cancelled", error.get("message", "Cancelled."))
    detail = "\n".join(data.get("traceback", []))
    if data.get("log"):
        detail = f"log: {data['log']}\n{detail}"
    return EngineError(
        data.get("code", "refused"), data.get("message", error.get("message", "")), data.get("hint", ""), detail
    )
