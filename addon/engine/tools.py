"""Running the tools of an installation: what they say, how far they are, and ending them. Standard library only, no
bpy."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

Report = Callable[[float, str], None]
# The last of pip's attempts; uv's words for it.
_UNREACHABLE = re.compile(r"Retry\(total=0|error sending request|dns error|client error \(Connect\)")
# Debian's Python comes without `venv`, and says what to do in the middle of many lines.
_WITHOUT_VENV = re.compile(r"apt install (python\S*-venv)")


class InstallError(Exception):
    """The installation cannot go on; the text says why and what to do."""


class InstallCancelled(Exception):
    """The user asked to stop."""


class Runner:
    """Runs the tools: their words go to the log and, in short, to the user; ends them when cancelled."""

    def __init__(self, log: IO[str], cancelled: threading.Event, report: Report) -> None:
        self.log, self.cancelled, self.report = log, cancelled, report

    def __call__(self, command: list[Any], failure: str, packages: int = 0) -> str:
        """Run to the end and return the output. `packages`: how many are expected, for the progress.

        Raises:
            InstallError: `failure` and the last line the tool said.
            InstallCancelled.
        """
        if self.cancelled.is_set():
            raise InstallCancelled
        words = [str(word) for word in command]
        self.log.write("> " + " ".join(words) + "\n")
        self.log.flush()
        options: dict[str, Any] = {"start_new_session": True}
        if sys.platform == "win32":
            options = {"creationflags": subprocess.CREATE_NO_WINDOW}
        try:
            process = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                encoding="utf-8", errors="replace", env=_environment(self.log), **options,
            )  # fmt: skip
        except OSError as error:
            raise InstallError(f"{failure}: {words[0]} cannot be run: {error}.") from error
        watcher = threading.Thread(target=self._watch, args=(process,), daemon=True)
        watcher.start()
        lines: list[str] = []
        done = 0
        assert process.stdout is not None
        for line in process.stdout:
            self.log.write(line)
            self.log.flush()
            lines.append(line.strip())
            done += bool(re.match(r"\s*(Downloaded|Collecting|Built)\b", line))
            if packages and line.strip():
                # uv names only the large downloads, then what it has prepared.
                share = 0.9 if line.lstrip().startswith(("Prepared", "Installed", "+")) else min(done / packages, 0.85)
                self.report(0.1 + 0.8 * share, line.strip()[:80])
        status = process.wait()
        if self.cancelled.is_set():
            raise InstallCancelled
        if status:
            raise InstallError(
                f"{failure}. {_reason(lines)}. Press Install again to go on; what was loaded is kept. "
                "If it fails again, see the log."
            )
        return "\n".join(lines)

    def _watch(self, process: subprocess.Popen[str]) -> None:
        while process.poll() is None:
            if self.cancelled.wait(0.2):
                _kill_tree(process)
                return


def _reason(lines: list[str]) -> str:
    """Why a tool failed, by what it said, without a full stop."""
    if any(_UNREACHABLE.search(line) for line in lines):  # pip then says that there is no such package
        return (
            "The server of the packages cannot be reached: check the network; behind a proxy, set HTTPS_PROXY and start "
            "Blender again"
        )
    lacking = next(filter(None, map(_WITHOUT_VENV.search, lines)), None)
    if lacking is not None:
        return f"Its Python lacks the package {lacking[1]}: install that, or choose another Base Python"
    told = [line for line in lines if line]
    reason = next((line for line in told if line.lower().startswith("error")), told[-1] if told else "")
    return reason[:300].rstrip(".")


def _kill_tree(process: subprocess.Popen[str]) -> None:
    """End a tool and what it started: pip builds and downloads in processes of its own."""
    if sys.platform == "win32":
        command = ["taskkill", "/F", "/T", "/PID", str(process.pid)]
        subprocess.run(command, capture_output=True, check=False, creationflags=subprocess.CREATE_NO_WINDOW)
        return
    with contextlib.suppress(ProcessLookupError):  # it has just ended
        os.killpg(process.pid, signal.SIGKILL)


def _environment(log: IO[str]) -> dict[str, str]:
    """No user site, no settings of another environment, downloads in the engine's own folder."""
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONHOME", "PYTHONPATH", "VIRTUAL_ENV")}
    env["PYTHONNOUSERSITE"] = "1"
    env["PIP_DISABLE_PIP_VERSION_CHECK"] = "1"
    env["PIP_USER"] = "0"  # where it is a user's habit, an environment refuses it
    env["UV_CACHE_DIR"] = str(Path(log.name).with_name("cache"))
    env["UV_PYTHON_DOWNLOADS"] = "never"
    env["UV_HTTP_TIMEOUT"] = "120"
    return env
