"""Where the engine's own Python lives, and (see below) how it gets there. Standard library only."""

from __future__ import annotations

import os
import sys
from pathlib import Path

ENVIRONMENT = "FIELDWORK_ENGINE_PYTHON"
COMPLETE = "complete.json"  # written into the engine's folder last, when the doctor was content


def python_in(folder: Path) -> Path:
    """The interpreter of a virtual environment."""
    return folder / "Scripts" / "python.exe" if sys.platform == "win32" else folder / "bin" / "python"


def find_python(chosen: str, engine_folder: Path, root: Path) -> Path | None:
    """The Python that runs the engine: the environment's, the chosen one (a file, or the folder of a virtual
    environment), the installed engine's, or that of a source checkout. None when there is none."""
    from_environment = os.environ.get(ENVIRONMENT)
    if from_environment:
        return Path(from_environment)
    if chosen:
        path = Path(chosen).expanduser()
        return python_in(path) if path.is_dir() else path
    if (engine_folder / COMPLETE).is_file():
        return python_in(engine_folder / "venv")
    checkout = python_in(root / ".venv")
    return checkout if checkout.is_file() else None
