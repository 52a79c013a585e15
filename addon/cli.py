"""`blender -c fieldwork VERB …`: the command line of the engine, for the Blender it was called in.

Every verb runs in the engine's Python; what a verb needs of Blender it does in a background copy of this one.
"""

from __future__ import annotations

import signal
import subprocess
import sys

from . import machine
from .engine.in_use import used
from .engine.link import engine_environment

NO_ENGINE = "The engine is not installed. Install it in the preferences of Fieldwork, or set FIELDWORK_ENGINE_PYTHON."


def main(arguments: list[str]) -> int:
    """Run the command line in the engine's Python; returns its exit status (see docs/headless.md)."""
    python = machine.engine_python()
    if python is None:
        print(NO_ENGINE, file=sys.stderr)
        return 1
    # Ctrl-C reaches both processes: the engine's ends its work in order, and this one must wait for it.
    with used(python) as held:
        command = [str(python), "-s", "-m", "nerfcore", *arguments]
        process = subprocess.Popen(command, env=engine_environment(), **held)
    # What ends Blender, as a farm does, must end the engine too.
    handlers = {signal.SIGINT: signal.SIG_IGN, signal.SIGTERM: lambda *_: process.terminate()}
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        return process.wait()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
