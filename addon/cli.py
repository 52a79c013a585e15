"""`blender -c fieldwork VERB …`."""

from __future__ import annotations

import subprocess
import sys

from . import preferences
from .link import engine_environment


def main(arguments: list[str]) -> int:
    """Run the command line in the engine's Python; returns its exit status."""
    python = preferences.engine_python()
    if python is None:
        print("The engine is not installed. Install it in the preferences of Fieldwork.", file=sys.stderr)
        return 1
    return subprocess.call([str(python), "-s", "-m", "nerfcore", *arguments], env=engine_environment())
