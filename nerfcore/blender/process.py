"""Work that needs Blender, done in a child process with `bpy` (see addon/child/main.py).

This package never imports bpy itself: a crash of Blender is an error message here, and cancelling is killing.
"""

from __future__ import annotations

import importlib.util
import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from ..errors import BlenderError, SettingError
from ..files import atomic_path
from ..progress import Reporter

CHILD = Path(__file__).resolve().parents[2] / "addon" / "child" / "main.py"
ENVIRONMENT = "FIELDWORK_BLENDER"
POLL = 0.1  # seconds


def find_blender() -> list[str]:
    """The command to which the child's script arguments are appended.

    In order: $FIELDWORK_BLENDER (a Blender executable, or a Python that has bpy; the extension sets it to the Blender
    it runs in), this Python if it has bpy, `blender` on the PATH.

    Raises:
        BlenderError: there is none.
    """
    chosen = os.environ.get(ENVIRONMENT)
    if chosen:
        if not shutil.which(chosen):
            raise BlenderError(f"{ENVIRONMENT}={chosen} is not an executable file.", "Set it to a Blender or unset it.")
        return _command(chosen)
    if importlib.util.find_spec("bpy") is not None:
        return _command(sys.executable)
    found = shutil.which("blender")
    if found:
        return _command(found)
    raise BlenderError(
        "This step needs Blender, and none was found.",
        f"Install the bpy package (`pip install 'fieldwork[blender]'`), or set {ENVIRONMENT} to a Blender executable.",
    )


def _command(executable: str) -> list[str]:
    if Path(executable).name.lower().startswith(("python", "pypy")):
        return [executable, str(CHILD)]
    return [executable, "--background", "--factory-startup", "-noaudio", "--python", str(CHILD), "--"]


def run_in_blender(
    task: str, request: dict[str, Any], report: Reporter, on_event: Callable[[dict[str, Any]], None]
) -> dict[str, Any]:
    """Run one task of addon/child/main.py and return its result.

    Args:
        task: a key of `TASKS` there.
        request: JSON-ready arguments of the task.
        report: asked several times a second whether to go on.
        on_event: called in this thread with every event the child tells; stages go to `report` by themselves.
    Raises:
        BlenderError: there is no Blender, it failed or it died; carries the last lines it printed.
        Cancelled: the child was killed because `report` says stop.
    """
    with tempfile.TemporaryDirectory(prefix="fieldwork-") as folder:
        path = Path(folder) / "request.json"
        path.write_text(json.dumps(request), encoding="utf-8")
        # Its own session: Ctrl-C on the terminal goes to this process alone, which then ends the child. The open
        # stdin is its sign that we live.
        child = subprocess.Popen(
            [*find_blender(), task, str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        try:
            return _follow(child, task, report, on_event)
        finally:
            child.kill()
            child.wait()
            for stream in (child.stdin, child.stdout, child.stderr):
                if stream is not None:
                    stream.close()


def check_blend(path: Path) -> None:
    """Raise SettingError unless a file's ending is .blend."""
    if path.suffix != ".blend":
        raise SettingError(f"{path} is no Blender file.", "Name a file that ends in .blend.")


def write_in_blender(package: Path, out: Path, project: Path, split: str, report: Reporter) -> dict[str, Any]:
    """Let Blender write a package folder as the .blend `out`, see addon/child/package.py; returns the task's result."""
    with atomic_path(out) as temporary:
        # Blender writes beside its target and renames; the two names must stay on one disk.
        return run_in_blender(
            "blend",
            {"package": str(package), "out": str(temporary), "project": str(project), "split": split},
            report,
            lambda event: report.progress(event["fraction"], event.get("message", "")),
        )


def _follow(
    child: subprocess.Popen[bytes], task: str, report: Reporter, on_event: Callable[[dict[str, Any]], None]
) -> dict[str, Any]:
    lines: queue.Queue[bytes | None] = queue.Queue()
    tail: deque[str] = deque(maxlen=30)
    assert child.stdout is not None
    assert child.stderr is not None
    readers = [
        threading.Thread(target=_read, args=(child.stdout, lines.put), daemon=True),
        threading.Thread(
            target=_read,
            args=(child.stderr, lambda line: tail.append(line.decode(errors="replace").rstrip()) if line else None),
            daemon=True,
        ),
    ]
    for reader in readers:
        reader.start()
    result: dict[str, Any] | None = None
    error, for_user = "", False
    while True:
        report.check()
        try:
            line = lines.get(timeout=POLL)
        except queue.Empty:
            continue
        if line is None:
            break
        message = _message(line)
        if "event" in message:
            event = message["event"]
            if event.get("kind") == "stage":
                report.stage(event["name"])
            else:
                on_event(event)
        elif "result" in message:
            result = message["result"]
        elif "error" in message:
            error, for_user = message["error"], message["for_user"]
    code = child.wait()
    if result is not None and not error:
        return result
    if for_user:
        raise BlenderError(error)
    readers[1].join(timeout=2)
    if error:
        raise BlenderError(f"Blender failed in {task}: {error}", "\n".join(list(tail)[-8:]))
    raise BlenderError(f"Blender ended with code {code} in {task}. It last said:", "\n".join(tail) or "(nothing)")


def _read(stream: IO[bytes], put: Callable[[bytes | None], Any]) -> None:
    for line in stream:
        put(line)
    put(None)


def _message(line: bytes) -> dict[str, Any]:
    """Blender itself prints on stdout before our script starts: what is not one of our objects is skipped."""
    try:
        value = json.loads(line)
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}
