"""Fixtures for tests that need Blender: it runs in a process of its own, so that its crash is a failed test."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fieldwork
import pytest
from fieldwork.tests.nerfcore.support.windows_files import each_file_system

__all__ = ["bpy_script", "each_file_system"]


@pytest.fixture(scope="session")
def bpy_script(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Any]:
    """Run Python code in a process with bpy; what it passes to `answer(value)` (JSON-ready) is returned.

    Keyword arguments are the code's global variables; `ENGINE_PYTHON` is the Python of the engine. The Blender is that of
    FIELDWORK_BPY_PYTHON, a Python with bpy, numpy and OpenImageIO, if it is set: `matrix.py --renders` does so.
    """
    python = os.environ.get("FIELDWORK_BPY_PYTHON")
    packages = tmp_path_factory.mktemp("packages")
    if python is None:
        pytest.importorskip("bpy", reason="needs the bpy package")
    else:  # where this checkout is not installed
        (packages / "fieldwork").symlink_to(Path(fieldwork.__file__).parent)

    def run(code: str, **variables: Any) -> Any:
        folder = tmp_path_factory.mktemp("bpy")
        answer = folder / "answer.json"
        prologue = (
            "import json, os, sys, bpy\nfrom pathlib import Path\n"
            f"sys.path.append({str(packages)!r})\n"
            f"ENGINE_PYTHON = {sys.executable!r}\n"
            f"globals().update(json.loads({json.dumps(json.dumps(variables, default=str))}))\n"
            f"def answer(value): Path({str(answer)!r}).write_text(json.dumps(value))\n"
        )
        script = folder / "script.py"
        # Some bpy versions hang while Python shuts down.
        script.write_text(prologue + code + "\nsys.stdout.flush()\nos._exit(0)\n")
        done = subprocess.run([python or sys.executable, str(script)], capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr[-4000:] + done.stdout[-1000:]
        return json.loads(answer.read_text())

    return run
