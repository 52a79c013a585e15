"""The two doors into the engine: one `serve` that many cases share, and commands that run on their own."""

from __future__ import annotations

import json
import os
import queue
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from .outcome import Reply

ROOT = Path(__file__).resolve().parents[2]
COMMAND = [sys.executable, "-m", "fieldwork.nerfcore"]
PATIENCE = 300.0  # seconds after which a request counts as never answered
MOST_ADDRESSES = 16 * 2**30  # bytes, so that a setting that asks for more does not take the whole machine
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT.parent)}


class Engine:
    """One `serve`, begun when first asked and again when it has ended."""

    def __init__(self, folder: Path, command: list[str] | None = None) -> None:
        self.command = command or [*COMMAND, "serve"]
        self.stderr = folder / "engine.stderr"
        self.process: subprocess.Popen[bytes] | None = None
        self.messages: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self.number = 0

    def start(self) -> subprocess.Popen[bytes]:
        if self.process is not None and self.process.poll() is None:
            return self.process
        with open(self.stderr, "ab") as stderr:
            self.process = subprocess.Popen(
                self.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, env=ENVIRONMENT, cwd="/"
            )
        resource.prlimit(self.process.pid, resource.RLIMIT_AS, (MOST_ADDRESSES, MOST_ADDRESSES))
        self.messages = queue.Queue()
        threading.Thread(target=self._read, args=(self.process, self.messages), daemon=True).start()
        return self.process

    @staticmethod
    def _read(process: subprocess.Popen[bytes], messages: queue.Queue[dict[str, Any] | None]) -> None:
        assert process.stdout
        for line in process.stdout:
            messages.put(json.loads(line))
        messages.put(None)

    def write(self, data: bytes) -> None:
        process = self.start()
        assert process.stdin
        process.stdin.write(data)
        process.stdin.flush()

    def send(self, verb: str, **params: Any) -> int:
        self.start()
        self.number += 1
        request = {"jsonrpc": "2.0", "id": self.number, "method": verb, "params": params}
        self.write(json.dumps(request, default=str).encode() + b"\n")
        return self.number

    def next(self, timeout: float) -> dict[str, Any] | None:
        """The next message; None at the end of the process. Raises queue.Empty."""
        return self.messages.get(timeout=timeout)

    def ask(
        self,
        verb: str,
        cancel_after: float | None = None,
        meanwhile: Callable[[], None] | None = None,
        moment: float = 0.0,
        **params: Any,
    ) -> Reply:
        """Ask for a verb and wait for its end.

        cancel_after: seconds until it is cancelled. meanwhile: called `moment` seconds after it began to work.
        """
        number = self.send(verb, **params)
        begun = asked = None
        warnings: list[str] = []
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            now = time.monotonic()
            if begun is not None and cancel_after is not None and asked is None and now - begun >= cancel_after:
                asked = now
                self.send("cancel")
            if begun is not None and meanwhile is not None and now - begun >= moment:
                meanwhile()
                meanwhile = None
            try:
                message = self.next(0.02)
            except queue.Empty:
                continue
            if message is None:
                self.start()
                return Reply("died", "the engine ended", warnings=tuple(warnings))
            if message.get("method") == "progress" and begun is None:
                begun = time.monotonic()
            if message.get("method") == "log" and message["params"]["level"] == "warning":
                warnings.append(message["params"]["text"])
            if "method" not in message and message["id"] == number:
                return _reply(message, warnings, None if asked is None else time.monotonic() - asked)
        self.kill()
        return Reply("silent", f"no answer within {PATIENCE:.0f} s", warnings=tuple(warnings))

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()


def _reply(message: dict[str, Any], warnings: list[str], latency: float | None) -> Reply:
    error = message.get("error")
    if error is None:
        return Reply(result=message["result"], warnings=tuple(warnings), latency=latency)
    data = error.get("data") or {}
    code = {-32001: "cancelled", -32603: "internal"}.get(error["code"]) or data.get("code") or "request"
    return Reply(code, error["message"], warnings=tuple(warnings), latency=latency)


def command(
    *arguments: Any,
    stop: tuple[int, Callable[[float], bool]] | None = None,
    shell: str = "",
    patience: float = PATIENCE,
) -> Reply:
    """Run the command line with --json.

    stop: a signal, and a function of the seconds since the start that says when to send it.
    shell: what bash does before, such as `ulimit -f 100`.
    """
    line = [*COMMAND, *map(str, arguments), "--json"]
    if shell:
        line = ["bash", "-c", f'{shell} && exec "$@"', "bash", *line]
    process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=ENVIRONMENT, cwd="/")
    begin, asked = time.monotonic(), None
    if stop is not None:
        while process.poll() is None and not stop[1](time.monotonic() - begin):
            time.sleep(0.005)
        with suppress(ProcessLookupError):
            process.send_signal(stop[0])
        asked = time.monotonic()
    try:
        out, err = process.communicate(timeout=patience)
    except subprocess.TimeoutExpired:
        process.kill()
        out, err = process.communicate()
        return Reply("silent", f"no end within {patience:.0f} s", output=(out + err).decode(errors="replace"))
    latency = time.monotonic() - asked if asked and stop and stop[0] == signal.SIGINT else None
    return _ended(process.returncode, out, err.decode(errors="replace"), latency)


def _ended(code: int, out: bytes, err: str, latency: float | None) -> Reply:
    output = out.decode(errors="replace") + err
    if code == 130:
        return Reply("cancelled", err.strip(), output=output, latency=latency)
    if code < 0 or code in (137, 139):
        killed = code in (-signal.SIGKILL, 137)
        return Reply("killed" if killed else "died", f"ended by signal {abs(code)}", output=output)
    try:
        value = json.loads(out) if out.strip() else {}
    except ValueError:
        return Reply("died", "its output is no JSON", output=output)
    if code == 0:
        return Reply(result=value, warnings=tuple(value.get("warnings", ())), output=output, latency=latency)
    told = value.get("error", {})
    return Reply(told.get("code", "usage"), told.get("message", err.strip()), output=output, latency=latency)
